//! PETS: planning in an ensemble of probabilistic networks.

mod checkpoint;
mod config;
mod controller;
mod diagnostics;
mod objective;

use std::sync::Arc;

use rand::RngExt;
use rayon::prelude::*;

pub use config::PetsConfig;
use controller::{Controller, MakeController};
use objective::PlanningModel;

use super::decision::{Decision, Over, check_decisions};
use super::warm_up::RandomActions;
use super::{Agent, ImaginedTrajectory, Losses, Mode, Slot, Slots};
use crate::env::{KnownReward, Spec};
use crate::error::{Error, Result};
use crate::model::{Dynamics, Ensemble};
use crate::plan::{ActionSequences, Iteration, MakePlanner, spread};
use crate::replay::{ReplayBuffer, Transition};
use crate::rng::{self, Rng};
use crate::settings::Ranges;

/// A known reward, shared between threads.
type DynReward = dyn KnownReward + Send + Sync;

/// Candidates of each iteration that an explanation shows.
const SHOWN: usize = 8;

/// The PETS agent: an ensemble of models, a planner, and a replay buffer.
///
/// PETS: probabilistic ensembles with trajectory sampling (Chua et al. 2018, Algorithm 1).
///
/// ```text
/// act at random for a while                                            warm_up
/// repeat:
///     fit the ensemble of probabilistic networks to all transitions    Pets::update, Pets::fit
///     for each time step until the next fit:                           Pets::act
///         search for action sequences (CEM, or another planner):       RecedingHorizon
///             propagate particles through the ensemble (TS-inf, ...)   Imagination
///             score = mean over particles of summed rewards            EnsembleObjective
///         execute the first action of the best sequence
///         record the transition                                        Pets::observe
/// ```
///
/// This type wires them together: the ensemble and its imagination are in [`crate::model`], the search is in
/// [`crate::plan`].
///
/// Deviations: the default planner is iCEM; fits come every `fit_every` time steps rather than after each episode; the random
/// actions at the beginning are coloured noise; those of the [ensemble](crate::model::ensemble). Risk measures other than the
/// mean, a penalty or a bonus for disagreement, exploration by posterior sampling, a reward for a plan's last state, a learned
/// reward, and a model of decisions that hold an action for several time steps are optional.
///
/// ```
/// use std::sync::Arc;
///
/// use handful::model::EnsembleConfig;
/// use handful::plan::{Cem, CemConfig};
/// use handful::prelude::*;
///
/// // Much too small to be any good.
/// let ensemble = EnsembleConfig { members: 2, elites: 2, hidden: vec![16], first_steps: 50, ..Default::default() };
/// let config = PetsConfig { ensemble, particles: 2, warm_up: 50, ..PetsConfig::default() };
/// let cem = CemConfig { horizon: 5, population: 20, elites: 4, iterations: 2, ..CemConfig::default() };
///
/// let mut env = Task::Pendulum.make();
/// let reward = Arc::new(Task::Pendulum.make());
/// let mut agent = Pets::new(env.spec(), Some(reward), config, 0)?
///     .with_planner(move |action_size| Cem::new(cem.clone(), action_size));
/// let mut obs = env.reset(0);
/// agent.begin_episode();
/// for _ in 0..60 {
///     let action = agent.act(&obs, Mode::Explore);
///     let Step { observation, reward, terminated, truncated, .. } = env.step(&action)?;
///     agent.observe(&Transition { obs, action, reward, next_obs: observation.clone(), terminated, truncated });
///     if let Some(losses) = agent.update() {
///         println!("model loss {}", losses["model_loss"]);
///     }
///     obs = observation;
/// }
/// assert!(agent.dynamics().is_some(), "it plans in a fitted model");
/// # Ok::<(), handful::error::Error>(())
/// ```
#[doc(alias = "PETS")]
pub struct Pets {
    config: PetsConfig,
    spec: Spec,
    /// None if the ensemble learns the reward.
    reward: Option<Arc<DynReward>>,
    ensemble: Ensemble,
    /// The snapshot of the ensemble to plan in; None before the first fit.
    dynamics: Option<Dynamics>,
    replay: ReplayBuffer,
    observed: usize,
    decision: Decision,
    random: RandomActions,
    controllers: MakeController,
    /// Plans in the environment that it learns from.
    controller: Controller,
    /// With posterior sampling, the member that exploration plans in, until the episode ends or a fit orders the members anew.
    sampled: Option<Dynamics>,
    /// Plan in the environments that it is evaluated in.
    slots: Slots<Controller>,
    rng: Rng,
}

impl Pets {
    /// A new agent for an environment. It plans with the known `reward`, unless `config.ensemble.learn_reward` is set: then
    /// the ensemble learns the reward from experience, and `reward` may be `None`.
    ///
    /// # Errors
    /// If a setting cannot be used; [`Error::Unsupported`] if the reward is neither known nor learned.
    pub fn new(spec: &Spec, reward: Option<Arc<DynReward>>, config: PetsConfig, seed: u64) -> Result<Self> {
        config.check_at("pets")?;
        spec.check()?;
        let reward = reward.filter(|reward| reward.is_known());
        if reward.is_none() && !config.ensemble.learn_reward {
            return Err(Error::Unsupported(format!(
                "pets: the reward of `{}` is not known as a function of observations; set `pets.ensemble.learn_reward = true`",
                spec.name
            )));
        }
        check_decisions("pets", spec, config.action_repeat, 1)?;
        let mut rng = rng::stream(seed, "pets");
        let decisions = spec.horizon.div_ceil(config.action_repeat);
        let controllers = MakeController {
            planner: Box::new(config.planner.clone()),
            config: config.control.clone(),
            explore_with_costs: config.explore_with_costs,
            action_size: spec.action_size,
        };
        Ok(Self {
            ensemble: Ensemble::new(spec, config.ensemble.clone(), &mut rng)?,
            dynamics: None,
            replay: ReplayBuffer::new(spec.observation_size(), spec.action_size, config.replay),
            observed: 0,
            decision: Decision::default(),
            random: RandomActions::new(config.warm_up_noise_beta, decisions, spec.action_size),
            controller: controllers.explorer(rng::stream(seed, "pets planner")),
            controllers,
            sampled: None,
            slots: Slots::default(),
            spec: spec.clone(),
            reward,
            rng,
            config,
        })
    }

    /// The same agent with a planner of the caller's own instead of `config.planner`: a [`MakePlanner`], for example a
    /// closure from the dimension of an action to a [`Planner`](crate::plan::Planner).
    #[must_use]
    pub fn with_planner(self, planner: impl MakePlanner + 'static) -> Self {
        let controllers = MakeController { planner: Box::new(planner), ..self.controllers };
        Self { controller: controllers.explorer(self.controller.rng), controllers, slots: Slots::default(), ..self }
    }

    /// The model that it plans in; None before the first fit.
    pub fn dynamics(&self) -> Option<&Dynamics> {
        self.dynamics.as_ref()
    }

    /// Fits the model to the replay buffer, and plans in it from the next action on. Returns `model_loss` (the mean training
    /// loss, comparable only between ensembles with the same `beta`), `model_steps` (gradient steps) and `model_error` (the mean squared
    /// error on held-out transitions, in normalised units) and, with a learned reward, `reward_error` (the same of its networks).
    ///
    /// # Panics
    /// If fewer than two decisions have been observed.
    pub fn fit(&mut self) -> Losses {
        // Inside the thread pool: a parallel section entered from outside hands its work over each time.
        let fit = rayon::scope(|_| self.ensemble.fit(&self.replay, &mut self.rng));
        self.dynamics = Some(self.ensemble.dynamics());
        self.sampled = None;
        let mut losses = Losses::from([("model_loss", fit.loss), ("model_steps", fit.steps as f32)]);
        if !fit.errors.is_empty() {
            let mean = fit.errors.iter().sum::<f64>() / fit.errors.len() as f64;
            losses.insert("model_error", mean as f32);
        }
        if !fit.reward_errors.is_empty() {
            let mean = fit.reward_errors.iter().sum::<f64>() / fit.reward_errors.len() as f64;
            losses.insert("reward_error", mean as f32);
        }
        losses
    }
}

impl Agent for Pets {
    fn begin_episode(&mut self) {
        self.controller.reset();
        self.decision.reset();
        self.random.reset();
        self.sampled = None;
        self.slots.clear(0);
    }

    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        let Self { config, spec, reward, dynamics, random, controllers, controller, sampled, slots, rng, .. } = self;
        match (dynamics, mode) {
            (None, Mode::Explore) => controller.held.next(config.action_repeat, || random.next(rng)),
            (None, Mode::Evaluate) => vec![0.0; spec.action_size],
            (Some(dynamics), Mode::Explore) => {
                let trusted = if config.posterior_sampling {
                    sampled.get_or_insert_with(|| dynamics.member(rng.random_range(0..dynamics.members())))
                } else {
                    dynamics
                };
                let model = PlanningModel::new(config, trusted, reward.as_deref());
                controller.act(&model, obs, config.disagreement_bonus, &mut |_| {})
            }
            (Some(dynamics), Mode::Evaluate) => {
                let model = PlanningModel::new(config, dynamics, reward.as_deref());
                slots.state(0, |i| controllers.of_slot(i)).act(&model, obs, 0.0, &mut |_| {})
            }
        }
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let Self { config, spec, reward, dynamics, controllers, slots: states, .. } = self;
        let Some(dynamics) = dynamics else { return vec![vec![0.0; spec.action_size]; slots.len()] };
        let model = PlanningModel::new(config, dynamics, reward.as_deref());
        let each = states.states(slots, |i| controllers.of_slot(i)).into_par_iter();
        let observations: Vec<&[f32]> = slots.iter().map(|slot| slot.obs).collect();
        each.zip(observations).map(|(controller, obs)| controller.act(&model, obs, 0.0, &mut |_| {})).collect()
    }

    fn act_and_explain(&mut self, slot: &Slot) -> (Vec<f32>, Vec<ImaginedTrajectory>) {
        let Self { config, spec, reward, dynamics, controllers, slots: states, .. } = self;
        let Some(dynamics) = dynamics else { return (vec![0.0; spec.action_size], Vec::new()) };
        let model = PlanningModel::new(config, dynamics, reward.as_deref());
        let controller = states.states(&[*slot], |i| controllers.of_slot(i)).remove(0);
        let mut shown: Option<ActionSequences> = None;
        let mut observer = |iteration: &Iteration| {
            let candidates = iteration.candidates;
            let order = spread(iteration, SHOWN);
            let some = order.iter().flat_map(|&i| candidates.row(i));
            let shown = shown.get_or_insert_with(|| ActionSequences::new(candidates.horizon, candidates.actions));
            // The last iteration, which has the best candidates, comes first.
            shown.values.splice(0..0, some.copied());
        };
        let action = controller.act(&model, slot.obs, 0.0, &mut observer);
        (action, shown.map(|shown| model.imagine_trajectories(slot.obs, &shown)).unwrap_or_default())
    }

    fn observe(&mut self, transition: &Transition) {
        if let Some(Over::Whole(decision)) = self.decision.join(transition, self.config.action_repeat) {
            self.replay.push(&decision);
        }
        self.observed += 1;
        if transition.terminated || transition.truncated {
            self.controller.reset();
            self.random.reset();
            self.sampled = None;
        }
    }

    fn update(&mut self) -> Option<Losses> {
        let since = self.observed.checked_sub(self.config.warm_up)?;
        // A short warm-up of long decisions may leave too few of them for the first fit.
        let due = self.dynamics.is_none() || since.is_multiple_of(self.config.fit_every);
        (due && self.replay.len() >= 2).then(|| self.fit())
    }
}

impl std::fmt::Debug for Pets {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("Pets")
            .field("config", &self.config)
            .field("observed", &self.observed)
            .field("fitted", &self.dynamics.is_some())
            .finish_non_exhaustive()
    }
}
