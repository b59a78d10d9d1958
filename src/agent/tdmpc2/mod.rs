//! TD-MPC2: planning in a latent space, with a learned value at the end.

mod checkpoint;
mod config;
mod planning;
mod scale;
mod update;

use rayon::prelude::*;

pub use config::TdMpc2Config;
use planning::{Controller, Imagined};
pub use scale::RunningScale;

use super::decision::{Decision, Over, check_decisions};
use super::warm_up::RandomActions;
use super::{Agent, ImaginedTrajectory, Losses, Mode, Slot, Slots};
use crate::env::Spec;
use crate::error::Result;
use crate::model::implicit::FrozenModel;
use crate::model::{ImplicitModel, PolicyPrior, Probe};
use crate::nn::{Adam, AdamConfig, Mlp, copy_parameters, parameters_of_fields};
use crate::plan::{Iteration, spread};
use crate::replay::{SequenceReplay, Transition};
use crate::rng::{self, Rng};
use crate::settings::Ranges;

/// Candidates of each iteration that an explanation shows.
const SHOWN: usize = 8;
/// Step size of the probe.
const PROBE_RATE: f32 = 1e-3;

/// The agent: model, policy, target critics, planners, and the replay buffer that it learns from.
///
/// TD-MPC2 (Hansen et al. 2024, "TD-MPC2: Scalable, Robust World Models for Continuous Control"): model predictive control in
/// the latent space of a model without a decoder, with a learned value at the plan's end.
///
/// ```text
/// act at random for a while                                               warm_up
/// repeat at each time step:
///     z = h(o); search for action sequences by MPPI over elites,          Controller, GuidedMppi
///         among candidates proposed by the policy,                        LatentReturns
///         scored by predicted rewards and the value of the last state
///     execute the first action of an elite; record the transition         TdMpc2::observe
///     learn latent dynamics, rewards, values and policy from slices       TdMpc2::learn
/// ```
///
/// The model is in [`crate::model::implicit`], the planner in [`crate::plan`]. Deviations: no
/// dropout in the first layer of Q; slices are drawn uniformly over their starts, those of the running episode included;
/// observations enter as [`LatentFeatures`](crate::model::LatentFeatures); NaN is the worst return, not 0; the rewards of a held
/// action are averaged, not summed; sizes for two cores. Optional: a group lasso on the encoder's inputs, another unit of rewards,
/// n-step targets, coloured noise for exploration, executing the mean of a plan, always or in evaluations, and costs of actions in
/// evaluations.
///
/// ```
/// use handful::prelude::*;
///
/// let mut env = Task::Pendulum.make();
/// let model = ImplicitConfig { latent: 16, encoder: 16, units: 16, ..ImplicitConfig::default() };
/// let planner = GuidedConfig { population: 32, proposals: 8, elites: 8, iterations: 2, ..GuidedConfig::default() };
/// let config = TdMpc2Config { model, planner, batch: 8, warm_up: 30, updates_per_step: 0.1, ..TdMpc2Config::default() };
/// let mut agent = TdMpc2::new(env.spec(), config, 0)?;
/// let mut obs = env.reset(0);
/// agent.begin_episode();
/// for _ in 0..40 {
///     let action = agent.act(&obs, Mode::Explore);
///     let Step { observation, reward, terminated, truncated, .. } = env.step(&action)?;
///     agent.observe(&Transition { obs, action, reward, next_obs: observation.clone(), terminated, truncated });
///     if let Some(losses) = agent.update() {
///         assert!(losses["consistency_loss"].is_finite() && losses["value_loss"].is_finite());
///     }
///     obs = observation;
/// }
/// assert_eq!(agent.act(&obs, Mode::Evaluate).len(), 1);
/// # Ok::<(), handful::error::Error>(())
/// ```
#[doc(alias = "TD-MPC2")]
#[doc(alias = "TD-MPC")]
#[doc(alias = "temporal difference learning for model predictive control")]
pub struct TdMpc2 {
    config: TdMpc2Config,
    spec: Spec,
    discount: f32,
    networks: Networks,
    model_optimiser: Adam,
    policy_optimiser: Adam,
    probe_optimiser: Adam,
    scale: RunningScale,
    replay: SequenceReplay,
    observed: usize,
    /// Updates that are due.
    update_credit: f32,
    random: RandomActions,
    /// What has happened so far of the present one.
    decision: Decision,
    /// The weights to plan with; None after an update.
    frozen: Option<FrozenModel>,
    /// Plans in the environment that it learns from.
    controller: Controller,
    /// Plan in the environments that it is evaluated in.
    slots: Slots<Controller>,
    rng: Rng,
}

/// All networks.
#[derive(Clone, Debug)]
struct Networks {
    model: ImplicitModel,
    policy: PolicyPrior,
    /// The target network: follows the critics slowly.
    target: Mlp,
    probe: Probe,
    /// Dimension of an action.
    actions: usize,
}

parameters_of_fields!(Networks: model, policy, probe);

impl Networks {
    fn new(spec: &Spec, config: &TdMpc2Config, rng: &mut Rng) -> Self {
        let model = ImplicitModel::new(spec, &config.model, rng);
        let (latent, units, actions) = (config.model.latent, config.model.units, spec.action_size);
        // A copy with tensors of its own.
        let mut target = model.critics().clone();
        copy_parameters(&mut target, model.critics());
        Self {
            policy: PolicyPrior::new(model.device(), latent, units, actions, rng),
            probe: Probe::new(&model, rng),
            target,
            actions,
            model,
        }
    }
}

impl TdMpc2 {
    /// A new agent for an environment.
    ///
    /// # Errors
    /// If a setting or the spec cannot be used.
    pub fn new(spec: &Spec, config: TdMpc2Config, seed: u64) -> Result<Self> {
        config.check_at("tdmpc2")?;
        spec.check()?;
        check_decisions("tdmpc2", spec, config.action_repeat, config.horizon)?;
        let mut rng = rng::stream(seed, "tdmpc2");
        let optimiser =
            AdamConfig { max_norm: Some(config.max_gradient_norm), ..AdamConfig::new(config.learning_rate) };
        Ok(Self {
            discount: config.discount_for(spec.horizon),
            networks: Networks::new(spec, &config, &mut rng),
            model_optimiser: Adam::new(optimiser).with_slower("encoder.", config.encoder_rate),
            policy_optimiser: Adam::new(AdamConfig { epsilon: 1e-5, ..optimiser }),
            probe_optimiser: Adam::new(AdamConfig::new(PROBE_RATE)),
            scale: RunningScale::default(),
            replay: SequenceReplay::new(spec.observation_size(), spec.action_size, config.replay),
            observed: 0,
            update_credit: 0.0,
            random: RandomActions::new(config.warm_up_noise_beta, spec.horizon, spec.action_size),
            decision: Decision::default(),
            frozen: None,
            controller: Controller::explorer(&config, spec, rng::stream(seed, "tdmpc2 planner")),
            slots: Slots::default(),
            spec: spec.clone(),
            rng,
            config,
        })
    }

    /// The world model.
    pub fn model(&self) -> &ImplicitModel {
        &self.networks.model
    }

    /// The policy prior, which proposes actions to the planner.
    pub fn policy(&self) -> &PolicyPrior {
        &self.networks.policy
    }

    /// The discount factor in use.
    pub fn discount(&self) -> f32 {
        self.discount
    }

    /// What the planners plan in, the planner that learns, those of the slots, and how one of the latter is made.
    fn imagined(&mut self) -> (Imagined<'_>, &mut Controller, &mut Slots<Controller>, impl Fn(usize) -> Controller) {
        let Self { config, spec, networks, frozen, discount, controller, slots, .. } = self;
        let Networks { model, policy, .. } = networks;
        let frozen = frozen.get_or_insert_with(|| FrozenModel::new(model, policy));
        (Imagined { model, frozen, discount: *discount }, controller, slots, |i| Controller::of_slot(config, spec, i))
    }
}

impl Agent for TdMpc2 {
    fn begin_episode(&mut self) {
        self.replay.abandon();
        self.forget_episode();
        self.slots.clear(0);
    }

    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        if mode == Mode::Explore && self.observed < self.config.warm_up {
            let Self { random, rng, controller, config, .. } = self;
            return controller.held.next(config.action_repeat, || random.next(rng));
        }
        let (world, controller, slots, fresh) = self.imagined();
        match mode {
            Mode::Explore => controller.act(world, obs, &mut |_| {}),
            Mode::Evaluate => slots.state(0, fresh).act(world, obs, &mut |_| {}),
        }
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let (world, _, controllers, fresh) = self.imagined();
        let controllers = controllers.states(slots, fresh).into_par_iter();
        let observations: Vec<&[f32]> = slots.iter().map(|slot| slot.obs).collect();
        controllers.zip(observations).map(|(controller, obs)| controller.act(world, obs, &mut |_| {})).collect()
    }

    fn act_and_explain(&mut self, slot: &Slot) -> (Vec<f32>, Vec<ImaginedTrajectory>) {
        let (world, _, controllers, fresh) = self.imagined();
        let controller = controllers.states(&[*slot], fresh).remove(0);
        // The last iteration, which has the best candidates, comes first.
        let (mut sequences, mut returns) = (Vec::new(), Vec::new());
        let mut observer = |iteration: &Iteration| {
            let order = spread(iteration, SHOWN);
            sequences.splice(0..0, order.iter().flat_map(|&i| iteration.candidates.row(i)).copied());
            returns.splice(0..0, order.iter().map(|&i| iteration.returns[i]));
        };
        let action = controller.act(world, slot.obs, &mut observer);
        if returns.is_empty() {
            // An action is held; nothing was planned.
            return (action, Vec::new());
        }
        let Networks { model, probe, .. } = &self.networks;
        let start = model.encode(&slot.obs.repeat(returns.len()));
        let futures = probe.rollout(model, &start, &sequences, self.config.planner.horizon);
        let width = slot.obs.len();
        let trajectories = returns.iter().enumerate().map(|(i, value)| ImaginedTrajectory {
            observations: futures.iter().map(|rows| rows[i * width..][..width].to_vec()).collect(),
            value: *value * self.config.reward_unit,
            disagreement: 0.0,
        });
        (action, trajectories.collect())
    }

    fn observe(&mut self, transition: &Transition) {
        match self.decision.join(transition, self.config.action_repeat) {
            Some(Over::Whole(mut decision)) => {
                decision.reward /= self.config.reward_unit;
                self.replay.push(&decision);
            }
            Some(Over::Short(obs)) => self.replay.close(&obs, false),
            None => {}
        }
        self.observed += 1;
        if transition.terminated || transition.truncated {
            self.forget_episode();
        }
    }

    fn update(&mut self) -> Option<Losses> {
        self.update_credit += self.config.updates_per_step;
        if self.observed < self.config.warm_up {
            return None;
        }
        let due = self.update_credit.floor() as usize;
        // What cannot be made yet, because no episode is long enough, stays due.
        let update = |_| self.learn().inspect(|_| self.update_credit -= 1.0);
        // Inside the thread pool: a parallel section entered from outside hands its work over each time.
        rayon::scope(|_| (0..due).map_while(update).last())
    }
}

impl TdMpc2 {
    fn forget_episode(&mut self) {
        self.controller.reset();
        self.decision.reset();
        self.random.reset();
    }
}

impl std::fmt::Debug for TdMpc2 {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("TdMpc2")
            .field("config", &self.config)
            .field("observed", &self.observed)
            .field("scale", &self.scale)
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests;
