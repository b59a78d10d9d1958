//! Agents: the wiring of models, planners and networks behind one small interface.
//!
//! [`Agent`] is what a reader of the papers expects: act, observe, update. [`Checkpoint`] and [`Diagnostics`] are traits
//! beside it, all of whose methods have defaults, so that a policy of one's own is a few lines:
//!
//! ```
//! use handful::prelude::*;
//!
//! /// Pushes as hard as it can, always in the same direction.
//! struct FullThrottle;
//!
//! impl Agent for FullThrottle {
//!     fn act(&mut self, _obs: &[f32], _mode: Mode) -> Vec<f32> {
//!         vec![1.0]
//!     }
//! }
//!
//! let mut evaluator = Evaluator::new(|| Ok(Task::Pendulum.make()))?;
//! let summary = evaluator.evaluate(&mut FullThrottle, 5, EvalSeeds::Test)?.summary();
//! assert_eq!(summary.success, 0.0);
//! # Ok::<(), handful::error::Error>(())
//! ```
//!
//! [`Policy`] is what the evaluator needs: actions for several environments side by side. Every agent is a policy; the
//! [`Oracle`] is a policy only, because it needs the environment itself.

mod baselines;
mod decision;
pub mod dreamer;
mod oracle;
mod percentile;
mod pets;
mod presets;
mod sac;
mod slots;
mod tdmpc2;
mod temperature;
mod warm_up;

pub use baselines::{Random, Scripted};
pub use dreamer::{Dreamer, DreamerConfig};
pub use oracle::{Oracle, OracleConfig};
pub use pets::{Pets, PetsConfig};
pub(crate) use presets::{PRESETS, preset_table, specialise};
pub use presets::{Preset, method_names};
pub use sac::{Sac, SacConfig};
pub use slots::{Slot, Slots};
pub use tdmpc2::{RunningScale, TdMpc2, TdMpc2Config};

use std::any::Any;
use std::collections::BTreeMap;

use crate::checkpoint::Weights;
use crate::error::{Error, Result};
use crate::model::open_loop::OpenLoop;
use crate::replay::Episode;
use crate::replay::Transition;

/// Why an agent is asked to act.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// To collect experience: the agent may explore.
    Explore,
    /// To be evaluated: the agent acts as well as it can, without exploration noise, and what it learns from is untouched.
    Evaluate,
}

/// Named numbers that an update reports: losses, entropies, gradient norms.
pub type Losses = BTreeMap<&'static str, f32>;

/// An imagined trajectory: one rollout of a learned model.
#[derive(Clone, Debug, PartialEq)]
pub struct ImaginedTrajectory {
    /// Predicted observations, `[horizon + 1][observation]`; the first is the present one, or a latent model's reconstruction of it.
    pub observations: Vec<Vec<f32>>,
    /// The predicted return.
    pub value: f32,
    /// How far the members of the ensemble disagree along the way.
    pub disagreement: f32,
}

/// An estimate of the return from one time step of an episode on, beside the return that followed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ValueEstimate {
    /// The estimate: of the discounted sum of rewards from this time step on, or of their sum over the horizon of a plan. SAC's is a soft
    /// value, which also contains the entropies of later actions.
    pub expected: f32,
    /// The same sum of the rewards that followed. After a truncation, the discounted sum is bootstrapped from the estimate at
    /// the last time step.
    pub realised: f32,
}

impl ValueEstimate {
    /// One for each time step of an episode but the last, from the estimates at all of its time steps.
    ///
    /// # Panics
    /// If there is no estimate.
    pub fn of_episode(values: &[f32], episode: &Episode, discount: f32) -> Vec<Self> {
        let mut realised = if episode.terminated { 0.0 } else { *values.last().expect("a value for each time step") };
        let steps = episode.rewards.iter().zip(values).rev();
        let mut all: Vec<Self> = steps
            .map(|(reward, expected)| {
                realised = reward + discount * realised;
                Self { expected: *expected, realised }
            })
            .collect();
        all.reverse();
        all
    }
}

/// An agent: it acts, observes what came of it, and updates itself.
///
/// One step of training is `act`, a step of the environment, `observe`, `update`; `begin_episode` comes after each
/// reset of the environment.
pub trait Agent: Send {
    /// A new episode begins, both in the environment that it learns in and in the one that [`Agent::act`] evaluates in: clears what the
    /// agent remembers of the one before (a recurrent state, a plan, a held action). [`Agent::act_batch`] evaluates in the middle of a
    /// training episode without touching it.
    fn begin_episode(&mut self) {}

    /// Chooses an action, each component in [-1, 1].
    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32>;

    /// Takes in one transition of experience.
    fn observe(&mut self, _transition: &Transition) {}

    /// Learns from what was observed; called once after every step. `None` while it only collects.
    fn update(&mut self) -> Option<Losses> {
        None
    }

    /// One action for each of several environments side by side, in [`Mode::Evaluate`]. The default asks [`Agent::act`] for each.
    /// Override it to answer in one forward pass, and always if the agent has a memory: it needs one for each slot
    /// ([`Slots`]).
    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        slots.iter().map(|slot| self.act(slot.obs, Mode::Evaluate)).collect()
    }

    /// The action that [`Agent::act_batch`] would choose in one slot, with some of the imagined trajectories behind it;
    /// none for agents that do not imagine.
    fn act_and_explain(&mut self, slot: &Slot) -> (Vec<f32>, Vec<ImaginedTrajectory>) {
        // Without an action, an empty one, which every environment refuses.
        (self.act_batch(&[*slot]).pop().unwrap_or_default(), Vec::new())
    }
}

/// Chooses actions in evaluations. Every [`Agent`] is a policy; a policy that needs the environment itself, as the
/// [`Oracle`] does, is a policy only.
pub trait Policy: Send {
    /// One action for each slot.
    ///
    /// # Errors
    /// If the policy cannot act in such an environment.
    fn actions(&mut self, slots: &[Slot]) -> Result<Vec<Vec<f32>>>;

    /// The action for one slot, with some of the imagined trajectories behind it.
    ///
    /// # Errors
    /// As [`Policy::actions`].
    fn explained_action(&mut self, slot: &Slot) -> Result<(Vec<f32>, Vec<ImaginedTrajectory>)> {
        let action = self.actions(&[*slot])?.pop();
        Ok((action.ok_or_else(|| Error::Config("the policy gave no action for one slot".into()))?, Vec::new()))
    }
}

impl<A: Agent + ?Sized> Policy for A {
    fn actions(&mut self, slots: &[Slot]) -> Result<Vec<Vec<f32>>> {
        Ok(self.act_batch(slots))
    }

    fn explained_action(&mut self, slot: &Slot) -> Result<(Vec<f32>, Vec<ImaginedTrajectory>)> {
        Ok(self.act_and_explain(slot))
    }
}

/// What is saved of an agent. No array may hold NaN. The defaults save nothing, which will do for a policy without state; the run of
/// an agent that learns and saves nothing can neither be resumed nor used.
pub trait Checkpoint {
    /// What it has learned, enough to act.
    fn weights(&self) -> Weights {
        Weights::default()
    }

    /// Takes over what [`Checkpoint::weights`] has given.
    ///
    /// # Errors
    /// If they are not those of an agent of this kind and these sizes.
    fn load_weights(&mut self, _weights: &Weights) -> Result<()> {
        Ok(())
    }

    /// Everything else that a resumed training needs: optimiser states, the replay buffer, random number generators.
    fn training_state(&self) -> Weights {
        Weights::default()
    }

    /// Takes over what [`Checkpoint::training_state`] has given.
    ///
    /// # Errors
    /// If it is not that of an agent of this kind and these sizes.
    fn load_training_state(&mut self, _state: &Weights) -> Result<()> {
        Ok(())
    }
}

/// How good an agent's model and critic are, measured on recorded episodes that it has not learned from, and how much it has
/// computed to learn them. The defaults have nothing to measure.
pub trait Diagnostics {
    /// Gradient steps so far: of the model if it has one, of the critics otherwise.
    #[doc(alias = "gradient updates")]
    fn updates(&self) -> u64 {
        0
    }

    /// The open-loop prediction error of its model, for several horizons.
    fn open_loop(&self, _episodes: &[Episode]) -> Vec<OpenLoop> {
        Vec::new()
    }

    /// Its value estimates, beside the returns that followed; of an agent that plans without values, the returns that its plans
    /// predicted for their horizon.
    fn value_estimates(&self, _episodes: &[Episode]) -> Vec<ValueEstimate> {
        Vec::new()
    }
}

/// TD-MPC2's rule for the discount factor of episodes of this many decisions (Hansen et al. 2024): (f - 1) / f with f = decisions /
/// 5, clipped to [0.95, 0.995].
pub fn discount_for(decisions: f32) -> f32 {
    let fifth = decisions / 5.0;
    ((fifth - 1.0) / fifth).clamp(0.95, 0.995)
}

/// An agent that a run can train, save and diagnose.
pub trait Learner: Agent + Checkpoint + Diagnostics + Any {}

impl<A: Agent + Checkpoint + Diagnostics + Any> Learner for A {}

/// A policy that does not learn, but may have a state to save.
pub trait FixedPolicy: Policy + Checkpoint + Any {}

impl<P: Policy + Checkpoint + Any> FixedPolicy for P {}

/// What a run carries out and a study compares.
pub enum Method {
    /// An agent that learns.
    Learner(Box<dyn Learner>),
    /// A policy that does not: it is only tested.
    Fixed(Box<dyn FixedPolicy>),
}

impl Method {
    /// An agent that learns.
    pub fn learner(agent: impl Learner + 'static) -> Self {
        Self::Learner(Box::new(agent))
    }

    /// A policy that does not learn.
    pub fn fixed(policy: impl FixedPolicy + 'static) -> Self {
        Self::Fixed(Box::new(policy))
    }

    /// The agent, if it learns.
    pub fn as_learner(&mut self) -> Option<&mut dyn Learner> {
        match self {
            Self::Learner(agent) => Some(agent.as_mut()),
            Self::Fixed(_) => None,
        }
    }

    /// The agent or the policy itself, if it is an `A`.
    pub fn downcast_ref<A: Any>(&self) -> Option<&A> {
        let any: &dyn Any = match self {
            Self::Learner(agent) => agent.as_ref(),
            Self::Fixed(policy) => policy.as_ref(),
        };
        any.downcast_ref()
    }

    /// What is saved of it.
    pub fn checkpoint(&self) -> &dyn Checkpoint {
        match self {
            Self::Learner(agent) => agent.as_ref(),
            Self::Fixed(policy) => policy.as_ref(),
        }
    }

    /// The same, to be loaded into.
    pub fn checkpoint_mut(&mut self) -> &mut dyn Checkpoint {
        match self {
            Self::Learner(agent) => agent.as_mut(),
            Self::Fixed(policy) => policy.as_mut(),
        }
    }
}

impl std::fmt::Debug for Method {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str(match self {
            Self::Learner(_) => "Method::Learner",
            Self::Fixed(_) => "Method::Fixed",
        })
    }
}

impl Policy for Method {
    fn actions(&mut self, slots: &[Slot]) -> Result<Vec<Vec<f32>>> {
        match self {
            Self::Learner(agent) => Ok(agent.act_batch(slots)),
            Self::Fixed(policy) => policy.actions(slots),
        }
    }

    fn explained_action(&mut self, slot: &Slot) -> Result<(Vec<f32>, Vec<ImaginedTrajectory>)> {
        match self {
            Self::Learner(agent) => Ok(agent.act_and_explain(slot)),
            Self::Fixed(policy) => policy.explained_action(slot),
        }
    }
}
