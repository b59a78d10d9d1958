//! PETS (Chua et al. 2018): learn an ensemble of models, plan in it at every step, learn again from what happened.
//!
//! Only wiring: the ensemble and its imagination are in [`crate::model`], the search is in [`crate::plan`].

use std::sync::Arc;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::warm_up::RandomActions;
use super::{Agent, Checkpoint, Diagnostics, ImaginedTrajectory, Losses, Mode, Slot, Slots};
use crate::checkpoint::Weights;
use crate::env::{KnownReward, Spec};
use crate::error::{Error, Result};
use crate::model::open_loop::{Episode, OpenLoop, open_loop};
use crate::model::uncertainty::Risk;
use crate::model::{
    Differentiable, Dynamics, Ensemble, EnsembleConfig, Imagination, ImaginedReturns, Propagation, Reward, Value,
};
use crate::plan::{
    ActionSequences, ControlConfig, IcemConfig, Iteration, Objective, PlanObserver, PlannerConfig, RecedingHorizon,
};
use crate::replay::{ReplayBuffer, Transition};
use crate::rng::{self, Rng};

/// A known reward, shared between threads.
type DynReward = dyn KnownReward + Send + Sync;

/// Of each iteration of a planner that is watched, so many sequences are shown.
const SHOWN: usize = 8;

/// Settings of [`Pets`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PetsConfig {
    /// The model.
    pub ensemble: EnsembleConfig,
    /// The planner and its settings.
    pub planner: PlannerConfig,
    /// How plans become control.
    pub control: ControlConfig,
    /// Steps that the last state of a plan is taken to last: its reward counts so many times more. Lets a short plan
    /// prefer to end well.
    pub terminal_weight: f32,
    /// How uncertainty is carried along imagined futures.
    pub propagation: Propagation,
    /// EnsembleObjective futures of each candidate: a multiple of the ensemble's elites.
    pub particles: usize,
    /// What to make of different futures.
    pub risk: Risk,
    /// Return given up for each unit of disagreement between the members.
    pub disagreement_penalty: f32,
    /// Return that a unit of disagreement is worth while exploring.
    pub disagreement_bonus: f32,
    /// Random steps before the first plan.
    pub warm_up: usize,
    /// Exponent of the noise of which random actions are made: 0 is white, and barely moves an arm.
    pub warm_up_noise_beta: f64,
    /// Steps between two fits of the model.
    pub fit_every: usize,
    /// Transitions remembered.
    pub replay: usize,
}

impl Default for PetsConfig {
    fn default() -> Self {
        Self {
            ensemble: EnsembleConfig::default(),
            planner: PlannerConfig::Icem(IcemConfig::default()),
            control: ControlConfig::default(),
            terminal_weight: 0.0,
            propagation: Propagation::TsInf,
            particles: 5,
            risk: Risk::Neutral,
            disagreement_penalty: 0.0,
            disagreement_bonus: 0.0,
            warm_up: 500,
            warm_up_noise_beta: 2.0,
            fit_every: 200,
            replay: 1_000_000,
        }
    }
}

impl PetsConfig {
    fn check(&self) -> Result<()> {
        self.control.check(&self.planner)?;
        if !self.particles.is_multiple_of(self.ensemble.elites) || self.particles == 0 {
            return Err(Error::BadSetting(format!(
                "pets: `particles` must be a multiple of the {} elites of the ensemble",
                self.ensemble.elites
            )));
        }
        if self.warm_up < 2 || self.fit_every == 0 {
            return Err(Error::BadSetting("pets: `warm_up` must be at least 2, `fit_every` at least 1".into()));
        }
        Ok(())
    }
}

/// Model, planner, and the experience that the model learns from.
pub struct Pets {
    config: PetsConfig,
    spec: Spec,
    /// None if the ensemble learns the reward.
    reward: Option<Arc<DynReward>>,
    ensemble: Ensemble,
    /// The snapshot to plan in, once there is something to plan in.
    dynamics: Option<Dynamics>,
    replay: ReplayBuffer,
    observed: usize,
    random: RandomActions,
    /// Plans where it learns.
    controller: Controller,
    /// Plan where it is evaluated.
    slots: Slots<Controller>,
    rng: Rng,
}

/// A controller in one world, with its own random numbers.
struct Controller {
    control: RecedingHorizon,
    rng: Rng,
}

impl Pets {
    /// A new agent for an environment. It plans with the known `reward`, unless `config.ensemble.learn_reward` is set:
    /// then it learns the reward from experience, and none needs to be known.
    ///
    /// # Errors
    /// If a setting cannot be used, or the reward is neither known nor learned.
    pub fn new(spec: &Spec, reward: Option<Arc<DynReward>>, config: PetsConfig, seed: u64) -> Result<Self> {
        config.check()?;
        spec.check()?;
        if reward.is_none() && !config.ensemble.learn_reward {
            return Err(Error::BadSetting(format!(
                "pets: the reward of `{}` is not known as a function of observations; set `ensemble.learn_reward = true`",
                spec.name
            )));
        }
        let mut rng = rng::stream(seed, "pets");
        Ok(Self {
            ensemble: Ensemble::new(spec, config.ensemble.clone(), &mut rng)?,
            dynamics: None,
            replay: ReplayBuffer::new(spec.observation_size(), spec.action_size, config.replay),
            observed: 0,
            random: RandomActions::new(config.warm_up_noise_beta, spec.horizon, spec.action_size),
            controller: Controller::new(&config, spec, rng::stream(seed, "pets planner")),
            slots: Slots::default(),
            spec: spec.clone(),
            reward,
            rng,
            config,
        })
    }

    /// The model that it plans in, once it has one.
    pub fn dynamics(&self) -> Option<&Dynamics> {
        self.dynamics.as_ref()
    }

    /// Fits the model to all experience now, and plans in the new one from here on.
    pub fn fit(&mut self) -> Losses {
        // Inside the thread pool, or every parallel piece of the fit would be handed over to it anew.
        let fit = rayon::scope(|_| self.ensemble.fit(&self.replay, &mut self.rng));
        self.dynamics = Some(self.ensemble.dynamics());
        let mut losses = Losses::from([("model_loss", fit.loss), ("model_steps", fit.steps as f32)]);
        if !fit.errors.is_empty() {
            let mean = fit.errors.iter().sum::<f64>() / fit.errors.len() as f64;
            losses.insert("model_error", mean as f32);
        }
        losses
    }
}

/// What action sequences are worth in imagination.
struct EnsembleObjective<'a> {
    imagination: Imagination<'a>,
    obs: &'a [f32],
    risk: Risk,
    /// What a unit of disagreement is worth.
    disagreement: f32,
    rng: Rng,
    /// Made when the first gradient is asked for.
    differentiable: Option<Differentiable>,
}

impl Objective for EnsembleObjective<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        let ImaginedReturns { particles, returns, disagreement } =
            self.imagination.imagined_returns(self.obs, &sequences.values, sequences.horizon, &mut self.rng);
        let scores = returns.chunks_exact(particles).zip(disagreement);
        scores.map(|(returns, apart)| self.risk.of(returns) + self.disagreement * apart).collect()
    }

    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        let Imagination { dynamics, reward, .. } = self.imagination;
        let model = self.differentiable.get_or_insert_with(|| Differentiable::new(dynamics));
        let disagreement_penalty = if let Risk::Deviation(weight) = self.risk { weight } else { -self.disagreement };
        model.gradients(reward, self.obs, &sequences.values, sequences.horizon, disagreement_penalty)
    }
}

impl Controller {
    /// The controller of a slot, which depends on nothing but the slot's index.
    fn of_slot(config: &PetsConfig, spec: &Spec, index: usize) -> Self {
        Self::new(config, spec, rng::stream(index as u64, "pets seat"))
    }

    fn new(config: &PetsConfig, spec: &Spec, rng: Rng) -> Self {
        Self {
            control: RecedingHorizon::new(config.planner.build(spec.action_size), spec.action_size, &config.control),
            rng,
        }
    }

    fn act(
        &mut self,
        model: &PlanningModel,
        obs: &[f32],
        disagreement_bonus: f32,
        observer: &mut PlanObserver,
    ) -> Vec<f32> {
        let mut objective = EnsembleObjective {
            imagination: model.imagination(),
            obs,
            risk: model.config.risk,
            disagreement: disagreement_bonus - model.config.disagreement_penalty,
            rng: rng::fork(&mut self.rng),
            differentiable: None,
        };
        self.control.act(&mut objective, observer, &mut self.rng)
    }
}

/// All that planning needs of an agent.
struct PlanningModel<'a> {
    config: &'a PetsConfig,
    dynamics: &'a Dynamics,
    reward: Option<&'a DynReward>,
    /// What the last state of a plan is worth.
    terminal: Option<Box<Value<'a>>>,
}

impl<'a> PlanningModel<'a> {
    fn new(config: &'a PetsConfig, dynamics: &'a Dynamics, reward: Option<&'a DynReward>) -> Self {
        let reward = reward.filter(|_| !config.ensemble.learn_reward);
        let rest = vec![0.0; dynamics.action_size()];
        let terminal = reward.filter(|_| config.terminal_weight > 0.0).map(|reward| -> Box<Value<'a>> {
            Box::new(move |state: &[f32]| config.terminal_weight * reward.reward(state, &rest, state))
        });
        Self { config, dynamics, reward, terminal }
    }

    fn imagination(&self) -> Imagination<'_> {
        Imagination {
            dynamics: self.dynamics,
            reward: self.reward.map_or(Reward::Learned, |reward| Reward::Known(reward)),
            propagation: self.config.propagation,
            particles: self.config.particles,
            value: self.terminal.as_deref(),
        }
    }

    /// What the agent thinks of some action sequences from `obs`, one future each; of the first also each particle's.
    fn imagine_trajectories(&self, obs: &[f32], tried: &ActionSequences) -> Vec<ImaginedTrajectory> {
        let imagination = self.imagination();
        let (states, futures) =
            imagination.trajectories(obs, &tried.values, tried.horizon, &mut rng::stream(0, "pets foresight"));
        let (width, count, particles) = (obs.len(), tried.count(), futures.particles);
        let at = |t: usize, p: usize, c: usize| &states[t][(p * count + c) * width..][..width];
        let mean = |t: usize, c: usize| -> Vec<f32> {
            let sum = |i: usize| (0..particles).map(|p| at(t, p, c)[i]).sum::<f32>();
            (0..width).map(|i| sum(i) / particles as f32).collect()
        };
        let returns = |c: usize| &futures.returns[c * particles..][..particles];
        let expected = (0..count).map(|c| ImaginedTrajectory {
            observations: (0..=tried.horizon).map(|t| mean(t, c)).collect(),
            value: Risk::Neutral.of(returns(c)),
            disagreement: futures.disagreement[c],
        });
        let possible = (0..particles).map(|p| ImaginedTrajectory {
            observations: (0..=tried.horizon).map(|t| at(t, p, 0).to_vec()).collect(),
            value: returns(0)[p],
            disagreement: futures.disagreement[0],
        });
        expected.chain(possible).collect()
    }
}

impl Agent for Pets {
    fn begin_episode(&mut self) {
        self.controller.control.reset();
        self.random.reset();
        self.slots.clear(0);
    }

    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        let Self { config, spec, reward, dynamics, random, controller, slots, rng, .. } = self;
        match (dynamics, mode) {
            (None, Mode::Explore) => random.next(rng),
            (None, Mode::Evaluate) => vec![0.0; spec.action_size],
            (Some(dynamics), Mode::Explore) => {
                let model = PlanningModel::new(config, dynamics, reward.as_deref());
                controller.act(&model, obs, config.disagreement_bonus, &mut |_| {})
            }
            (Some(dynamics), Mode::Evaluate) => {
                let model = PlanningModel::new(config, dynamics, reward.as_deref());
                slots.state(0, |i| Controller::of_slot(config, spec, i)).act(&model, obs, 0.0, &mut |_| {})
            }
        }
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let Self { config, spec, reward, dynamics, slots: controllers, .. } = self;
        let Some(dynamics) = dynamics else { return vec![vec![0.0; spec.action_size]; slots.len()] };
        let model = PlanningModel::new(config, dynamics, reward.as_deref());
        let controllers = controllers.states(slots, |i| Controller::of_slot(config, spec, i));
        let observations: Vec<&[f32]> = slots.iter().map(|slot| slot.obs).collect();
        let each = controllers.into_par_iter().zip(observations);
        each.map(|(controller, obs)| controller.act(&model, obs, 0.0, &mut |_| {})).collect()
    }

    fn act_and_explain(&mut self, slot: &Slot) -> (Vec<f32>, Vec<ImaginedTrajectory>) {
        let Self { config, spec, reward, dynamics, slots: controllers, .. } = self;
        let Some(dynamics) = dynamics else { return (vec![0.0; spec.action_size], Vec::new()) };
        let model = PlanningModel::new(config, dynamics, reward.as_deref());
        let controller = controllers.states(&[*slot], |i| Controller::of_slot(config, spec, i)).remove(0);
        // A few of each iteration's candidates, from the best to the worst.
        let mut shown: Option<ActionSequences> = None;
        let mut observer = |iteration: &Iteration| {
            let candidates = iteration.candidates;
            let mut order: Vec<usize> = (0..candidates.count()).collect();
            order.sort_by(|a, b| iteration.returns[*b].total_cmp(&iteration.returns[*a]));
            let some = order.iter().step_by((candidates.count() / SHOWN).max(1)).flat_map(|&i| candidates.row(i));
            let shown = shown.get_or_insert_with(|| ActionSequences::new(candidates.horizon, candidates.actions));
            // The last iteration, which has the best candidates, comes first.
            shown.values.splice(0..0, some.copied());
        };
        let action = controller.act(&model, slot.obs, 0.0, &mut observer);
        (action, shown.map(|shown| model.imagine_trajectories(slot.obs, &shown)).unwrap_or_default())
    }

    fn observe(&mut self, transition: &Transition) {
        self.replay.push(transition);
        self.observed += 1;
        if transition.terminated || transition.truncated {
            self.controller.control.reset();
            self.random.reset();
        }
    }

    fn update(&mut self) -> Option<Losses> {
        let since = self.observed.checked_sub(self.config.warm_up)?;
        since.is_multiple_of(self.config.fit_every).then(|| self.fit())
    }
}

impl Diagnostics for Pets {
    fn open_loop(&self, episodes: &[Episode]) -> Vec<OpenLoop> {
        let measure = |dynamics| open_loop(dynamics, episodes, &mut rng::stream(0, "open loop"));
        self.dynamics.as_ref().map(measure).unwrap_or_default()
    }
}

impl Checkpoint for Pets {
    fn weights(&self) -> Weights {
        self.ensemble.weights()
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        self.ensemble.load_weights(weights)?;
        self.dynamics = self.ensemble.is_fitted().then(|| self.ensemble.dynamics());
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        self.ensemble.save_training_state(&mut state);
        self.replay.save(&mut state, "replay");
        state.insert_counts("counts", &[self.observed as u64]);
        state.insert_counts("rng", &rng::state(&self.rng));
        state.insert_counts("planner rng", &rng::state(&self.controller.rng));
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let counts = state.counts("counts", 1)?;
        let (own, planner) = (state.counts("rng", 4)?, state.counts("planner rng", 4)?);
        self.ensemble.load_training_state(state)?;
        self.replay.load(state, "replay")?;
        self.observed = counts[0] as usize;
        self.rng = rng::from_state(&own);
        self.controller = Controller::new(&self.config, &self.spec, rng::from_state(&planner));
        self.random.reset();
        Ok(())
    }
}
