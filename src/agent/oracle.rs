//! The oracle: a planner on the true simulator.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Checkpoint, Policy, Slot, Slots};
use crate::env::{Env, Snapshot};
use crate::error::{Error, Result};
use crate::plan::{ActionSequences, ControlConfig, IcemConfig, MakePlanner, PlannerConfig, RecedingHorizon};
use crate::rng::{self, Rng};
use crate::settings::{Ranges, fits, ranges};

/// Settings of [`Oracle`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OracleConfig {
    /// The planner and its settings.
    pub planner: PlannerConfig,
    /// How plans become control.
    pub control: ControlConfig,
    /// Weight of the terminal reward: the reward of a plan's last step counts 1 + `terminal_weight` times,
    /// unless the plan ends the task.
    pub terminal_weight: f32,
}

impl Default for OracleConfig {
    fn default() -> Self {
        Self {
            planner: PlannerConfig::Icem(IcemConfig::default()),
            control: ControlConfig::default(),
            terminal_weight: 0.0,
        }
    }
}

ranges!(OracleConfig { planner: Nested, control: Nested, terminal_weight: 0.0..=1e6, }
require control.suits(planner) => "`control.replan_every` must not exceed the planner's `horizon`";
require fits(&[planner.candidates(), planner.horizon(), control.action_repeat]) =>
    "the planner's candidates times `horizon` times `control.action_repeat` do not fit into memory";
);

/// Receding-horizon control with the true environment as the model, in any environment that can be restored.
///
/// It is not available to a real agent: it simulates action sequences in a copy of the environment in which it acts. An agent that plans
/// in a learned model with the same planner and objective differs from it by the model's error alone. It is no upper bound on what agents
/// can achieve: another planner or a longer horizon may do better.
///
/// ```
/// use handful::prelude::*;
///
/// let mut oracle = Oracle::new(|| Ok(Task::Pendulum.make()), OracleConfig::default(), 0)?;
/// let mut env = Task::Pendulum.make();
/// env.reset(0);
/// let action = oracle.plan(0, &env.snapshot())?;
/// assert_eq!(action.len(), 1);
/// # Ok::<(), handful::error::Error>(())
/// ```
pub struct Oracle<E: Env + Snapshot> {
    config: OracleConfig,
    planner: Box<dyn MakePlanner>,
    action_size: usize,
    /// The controller of each slot, with its random numbers.
    controllers: Slots<(RecedingHorizon, Rng)>,
    /// Environments to try action sequences in, one for each thread.
    simulators: Vec<E>,
    seed: u64,
}

impl<E: Env + Snapshot> Oracle<E> {
    /// An oracle for the environments that `make` makes.
    ///
    /// # Errors
    /// If a setting cannot be used, or any error of `make`.
    pub fn new(make: impl Fn() -> Result<E>, config: OracleConfig, seed: u64) -> Result<Self> {
        config.check_at("oracle")?;
        let simulators = (0..rayon::current_num_threads()).map(|_| make()).collect::<Result<Vec<_>>>()?;
        simulators[0].spec().check()?;
        Ok(Self {
            action_size: simulators[0].spec().action_size,
            planner: Box::new(config.planner.clone()),
            config,
            controllers: Slots::default(),
            simulators,
            seed,
        })
    }

    /// The same oracle with a planner of the caller's own instead of `config.planner`.
    #[must_use]
    pub fn with_planner(self, planner: impl MakePlanner + 'static) -> Self {
        Self { planner: Box::new(planner), controllers: Slots::default(), ..self }
    }

    /// A new episode begins in the slot `index`: its plan is dropped, and its random numbers begin anew.
    pub fn begin_episode(&mut self, index: usize) {
        self.controllers.clear(index);
    }

    /// The action to take in `state`, in the slot `index` (0 if there is one environment only).
    ///
    /// # Errors
    /// If a step of the environment fails, for example one beyond its time limit.
    pub fn plan(&mut self, index: usize, state: &E::State) -> Result<Vec<f32>> {
        let Self { config, planner, action_size, controllers, simulators, seed } = self;
        let (controller, rng) = controllers.state(index, |index| {
            let controller = RecedingHorizon::new(planner.make(*action_size), *action_size, &config.control);
            (controller, rng::stream(*seed, &format!("oracle, slot {index}")))
        });
        let mut refused = None;
        let mut objective = |candidates: &ActionSequences| {
            let returns = returns(simulators, state, candidates, config.terminal_weight);
            returns.unwrap_or_else(|problem| {
                refused.get_or_insert(problem);
                vec![f32::NAN; candidates.count()]
            })
        };
        let action = controller.act(&mut objective, &mut |_| {}, rng);
        refused.map_or(Ok(action), Err)
    }
}

impl<E: Env + Snapshot> std::fmt::Debug for Oracle<E> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("Oracle").field("config", &self.config).finish_non_exhaustive()
    }
}

/// The return of each sequence from `state` on, the work shared out over the simulators.
///
/// # Errors
/// Any error of a step.
fn returns<E: Env + Snapshot>(
    simulators: &mut [E],
    state: &E::State,
    candidates: &ActionSequences,
    terminal_weight: f32,
) -> Result<Vec<f32>> {
    let share = candidates.count().div_ceil(simulators.len());
    let mut returns = vec![0.0; candidates.count()];
    let shares = returns.par_chunks_mut(share).zip(simulators).enumerate();
    shares.try_for_each(|(part, (returns, env))| {
        for (i, total) in returns.iter_mut().enumerate() {
            env.restore(state);
            let mut last = 0.0;
            for action in candidates.row(part * share + i).chunks(candidates.actions) {
                let step = env.step(action)?;
                *total += step.reward;
                last = step.reward;
                if step.terminated {
                    last = 0.0;
                    break;
                }
            }
            *total += terminal_weight * last;
        }
        Ok(())
    })?;
    Ok(returns)
}

impl<E: Env + Snapshot> Policy for Oracle<E> {
    /// # Errors
    /// If a slot's environment is not an `E`, or a step of a plan fails in it.
    fn actions(&mut self, slots: &[Slot]) -> Result<Vec<Vec<f32>>> {
        let plan = |slot: &Slot| {
            let env = slot.env.downcast_ref::<E>().ok_or_else(|| {
                let wanted = &self.simulators[0].spec().name;
                Error::Config(format!("an oracle for `{wanted}` cannot plan in `{}`", slot.env.spec().name))
            })?;
            if slot.first {
                self.begin_episode(slot.index);
            }
            self.plan(slot.index, &env.snapshot())
        };
        slots.iter().map(plan).collect()
    }
}

impl<E: Env + Snapshot> Checkpoint for Oracle<E> {}
