//! The oracle: a planner on the true simulator.
//!
//! It is not an agent that anyone could have (it tries things out in the very world in which it acts, and puts the
//! world back), but the upper bound for all that plan in a world that they have learned: what remains between
//! such an agent and the oracle is the model's fault, not the planner's.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::baselines::never_learns;
use super::{Agent, Mode, Slot};
use crate::env::tabletop::TableOptions;
use crate::env::{Env, Snapshot, Task, World, WorldState};
use crate::error::Result;
use crate::plan::{ActionSequences, ControlConfig, IcemConfig, PlannerConfig, RecedingHorizon};
use crate::rng::{self, Rng};

/// Settings of [`Oracle`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OracleConfig {
    /// The planner and its settings.
    pub planner: PlannerConfig,
    /// How plans become control.
    pub control: ControlConfig,
    /// Steps that the last state of a plan is taken to last: its reward counts so many times more.
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

/// A controller for each slot, and worlds to try things out in.
pub struct Oracle {
    config: OracleConfig,
    actions: usize,
    controllers: BTreeMap<usize, RecedingHorizon>,
    /// One for each thread.
    worlds: Vec<World>,
    rng: Rng,
}

impl Oracle {
    /// An oracle for a task.
    ///
    /// # Errors
    /// If a setting cannot be used.
    pub fn new(task: Task, options: TableOptions, config: OracleConfig, seed: u64) -> Result<Self> {
        config.control.check(&config.planner)?;
        let worlds = (0..rayon::current_num_threads()).map(|_| task.make_with(options)).collect::<Result<Vec<_>>>()?;
        let actions = worlds[0].spec().action_size;
        Ok(Self { config, actions, controllers: BTreeMap::new(), worlds, rng: rng::stream(seed, "oracle") })
    }

    fn plan(&mut self, slot: &Slot) -> Vec<f32> {
        let Self { config, actions, controllers, worlds, rng } = self;
        let new = || RecedingHorizon::new(&config.planner, *actions, &config.control);
        let controller = controllers.entry(slot.index).or_insert_with(new);
        if slot.first {
            controller.reset();
        }
        let state = slot.world.snapshot();
        let mut objective = |candidates: &ActionSequences| returns(worlds, &state, candidates, config.terminal_weight);
        controller.act(&mut objective, &mut |_| {}, rng)
    }
}

/// The return of each sequence, tried out from `state`, the work shared out over the worlds.
fn returns(worlds: &mut [World], state: &WorldState, candidates: &ActionSequences, terminal_weight: f32) -> Vec<f32> {
    let share = candidates.count().div_ceil(worlds.len());
    let mut returns = vec![0.0; candidates.count()];
    let shares = returns.par_chunks_mut(share).zip(worlds).enumerate();
    shares.for_each(|(part, (returns, world))| {
        for (i, total) in returns.iter_mut().enumerate() {
            world.restore(state);
            let mut last = 0.0;
            for action in candidates.row(part * share + i).chunks(candidates.actions) {
                let Ok(step) = world.step(action) else {
                    *total = f32::NAN;
                    break;
                };
                *total += step.reward;
                last = step.reward;
                if step.terminated {
                    last = 0.0;
                    break;
                }
            }
            *total += terminal_weight * last;
        }
    });
    returns
}

impl Agent for Oracle {
    /// # Panics
    /// Always: an oracle needs the world, which [`Agent::act_all`] shows it.
    fn act(&mut self, _obs: &[f32], _mode: Mode) -> Vec<f32> {
        panic!("an oracle acts from a seat in a world, not on an observation")
    }

    fn act_all(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        slots.iter().map(|slot| self.plan(slot)).collect()
    }

    never_learns!(rng);
}
