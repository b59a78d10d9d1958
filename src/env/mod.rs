//! Environments: what an agent acts in, after Gymnasium's `reset` and `step`.
//!
//! [`Env`] is all that training requires; implement it, and every agent here trains on it. Two more traits open more doors:
//! [`KnownReward`] for planners that compute rewards from predicted observations, [`Snapshot`] for those that plan on the
//! true dynamics. [`contract`] enforces the rules of [`Env`], [`vector`] steps many environments in parallel.
//!
//! [`World`] is any of this crate's environments, made by name ([`Task`]): five tasks for a robot arm ([`tabletop`]), the
//! [`pendulum`] and the [`cartpole`].
//!
//! ```
//! use handful::prelude::*;
//!
//! let mut env = Task::Pendulum.make();
//! let mut obs = env.reset(0);
//! let mut total = 0.0;
//! loop {
//!     // A brake: torque against the angular velocity, in [-1, 1].
//!     let step = env.step(&[-obs[2]])?;
//!     total += step.reward;
//!     if step.done() {
//!         break;
//!     }
//!     obs = step.observation;
//! }
//! assert!(total < 0.0);
//! # Ok::<(), Error>(())
//! ```

pub mod arm;
pub mod cartpole;
pub mod contract;
mod inertia;
pub mod kinematics;
pub mod osc;
pub mod pendulum;
pub mod physics;
pub mod scene;
mod spec;
pub mod tabletop;
pub mod vector;
mod world;

pub use spec::{Feature, Role, Spec};
pub use world::{Task, World, WorldState};

use crate::error::Result;

/// The result of one control step, in Gymnasium's terms.
///
/// ```
/// use handful::env::Step;
///
/// let step = Step::new(vec![0.3], -0.3).truncated(true);
/// assert!(step.done() && !step.terminated && !step.success);
/// ```
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Step {
    /// The observation after the step.
    pub observation: Vec<f32>,
    /// The reward of the step.
    pub reward: f32,
    /// The task itself ended the episode: the value of what follows is zero.
    pub terminated: bool,
    /// The time limit ended the episode: the state that was reached still has a value.
    pub truncated: bool,
    /// Whether the task is solved at this time step.
    pub success: bool,
    /// How many of the [`Spec::stages`] are reached at this time step.
    pub stage: usize,
}

impl Step {
    /// A step that ends nothing, without success, at stage 0.
    pub fn new(observation: Vec<f32>, reward: f32) -> Self {
        Self { observation, reward, terminated: false, truncated: false, success: false, stage: 0 }
    }

    /// The same step; `terminated` says whether the task itself ended the episode.
    pub fn terminated(self, terminated: bool) -> Self {
        Self { terminated, ..self }
    }

    /// The same step; `truncated` says whether the time limit ended the episode.
    pub fn truncated(self, truncated: bool) -> Self {
        Self { truncated, ..self }
    }

    /// The same step; `success` says whether the task is solved at this time step.
    pub fn success(self, success: bool) -> Self {
        Self { success, ..self }
    }

    /// The same step with `stage` of the [`Spec::stages`] reached.
    pub fn stage(self, stage: usize) -> Self {
        Self { stage, ..self }
    }

    /// Whether the episode is over.
    pub fn done(&self) -> bool {
        self.terminated || self.truncated
    }
}

/// An environment: everything that training an agent requires of it.
///
/// Drawing is optional: an environment that gives [`Env::scene`] and [`Env::poses`] can be watched as a 3D replay,
/// [`Env::position_of`] draws what an agent imagined into it, [`Env::camera`] says from where it is seen.
///
/// `Box<dyn Env>` is an environment too, so that code generic over `E: Env` also takes one that is chosen at run time;
/// `<dyn Env>::downcast_ref` gets the concrete type back.
#[doc(alias = "Gymnasium")]
#[doc(alias = "gym")]
pub trait Env: std::any::Any + Send {
    /// The names, sizes and units of observations and actions. It does not change.
    fn spec(&self) -> &Spec;

    /// Starts an episode; the seed fixes everything that is drawn at random in it. Returns the first observation,
    /// [`Spec::observation_size`] numbers.
    ///
    /// It cannot fail: where it would, return finite numbers, and let the next [`Env::step`] say what went wrong.
    ///
    /// Use all 64 bits of the seed, for example by [`rng::stream`](crate::rng::stream): seeds of training, evaluations and the test
    /// differ in their upper bits, and as a `u32` or an `f32` some of them would be equal.
    fn reset(&mut self, seed: u64) -> Vec<f32>;

    /// Acts for one control step. Numbers outside [-1, 1] count as the nearest bound.
    ///
    /// # Errors
    /// [`crate::error::Error::Action`] if the action has the wrong length or is not finite; nothing has moved then.
    /// [`crate::error::Error::Environment`] if the environment itself fails.
    fn step(&mut self, action: &[f32]) -> Result<Step>;

    /// Position (m) of the tracked point, a robot's hand for example; the smoothness of motion is measured there. None
    /// (the default) if there is no such point.
    fn hand(&self) -> Option<[f64; 3]> {
        None
    }

    /// The bodies to draw. Empty by default.
    fn scene(&self) -> Vec<scene::Body> {
        Vec::new()
    }

    /// The pose of each body of [`Env::scene`] at this time step, in the same order (position in m).
    fn poses(&self) -> Vec<arm::Pose> {
        Vec::new()
    }

    /// The camera of the 3D replay. By default it looks at the origin from about four metres.
    fn camera(&self) -> scene::Camera {
        scene::Camera::default()
    }

    /// The point (m) at which an imagined observation is drawn: the hand, the tip of a pole. None (the default) if
    /// observations do not tell.
    fn position_of(&self, _obs: &[f32]) -> Option<[f64; 3]> {
        None
    }
}

impl Env for Box<dyn Env> {
    fn spec(&self) -> &Spec {
        (**self).spec()
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        (**self).reset(seed)
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        (**self).step(action)
    }

    fn hand(&self) -> Option<[f64; 3]> {
        (**self).hand()
    }

    fn scene(&self) -> Vec<scene::Body> {
        (**self).scene()
    }

    fn poses(&self) -> Vec<arm::Pose> {
        (**self).poses()
    }

    fn camera(&self) -> scene::Camera {
        (**self).camera()
    }

    fn position_of(&self, obs: &[f32]) -> Option<[f64; 3]> {
        (**self).position_of(obs)
    }
}

impl dyn Env {
    /// The environment as the type that it is, also from inside a `Box<dyn Env>`. None if it is another type.
    pub fn downcast_ref<E: Env>(&self) -> Option<&E> {
        let any: &dyn std::any::Any = self;
        any.downcast_ref::<E>().or_else(|| any.downcast_ref::<Box<dyn Env>>()?.as_ref().downcast_ref::<E>())
    }
}

/// A reward that can be computed from observations alone, as planners need it that imagine observations.
///
/// ```
/// use handful::prelude::*;
///
/// let mut env = Task::Reach.make();
/// let obs = env.reset(0);
/// let action = [0.5, 0.0, -0.5, 0.0];
/// let step = env.step(&action)?;
/// assert_eq!(env.reward(&obs, &action, &step.observation), step.reward);
/// # Ok::<(), Error>(())
/// ```
#[doc(alias = "reward function")]
#[doc(alias = "termination function")]
pub trait KnownReward {
    /// Whether observations determine the reward at all. True by default; false for an environment that can be set to
    /// observe too little, whose [`KnownReward::reward`] then panics.
    fn is_known(&self) -> bool {
        true
    }

    /// The reward of reaching `next_obs` from `obs` by `action`. It is also asked of environments that were never reset.
    fn reward(&self, obs: &[f32], action: &[f32], next_obs: &[f32]) -> f32;

    /// Whether reaching `next_obs` terminates the episode. False by default: most tasks here end by truncation alone. If the task
    /// can end earlier, say when, or plans go on beyond the end.
    fn terminated(&self, _next_obs: &[f32]) -> bool {
        false
    }

    /// [`KnownReward::reward`] for a batch: `obs` and `next_obs` hold `rewards.len()` rows, one after the other, as
    /// does `actions`. Rewards are written into `rewards`.
    ///
    /// # Panics
    /// If the lengths do not fit together.
    fn rewards(&self, obs: &[f32], actions: &[f32], next_obs: &[f32], rewards: &mut [f32]) {
        let n = rewards.len();
        if n == 0 {
            assert!(obs.is_empty() && actions.is_empty() && next_obs.is_empty());
            return;
        }
        assert!(obs.len() == next_obs.len() && obs.len().is_multiple_of(n) && actions.len().is_multiple_of(n));
        let rows = obs.chunks(obs.len() / n).zip(actions.chunks(actions.len() / n)).zip(next_obs.chunks(obs.len() / n));
        for (reward, ((obs, action), next)) in rewards.iter_mut().zip(rows) {
            *reward = self.reward(obs, action, next);
        }
    }
}

/// A known reward, shared between threads.
pub type SharedReward = std::sync::Arc<dyn KnownReward + Send + Sync>;

/// An environment whose state can be saved and restored: from a restored state it steps on bit for bit as it did before.
///
/// ```
/// use handful::prelude::*;
///
/// let mut env = Task::Push.make();
/// env.reset(0);
/// let state = env.snapshot();
/// let first = env.step(&[1.0, 0.0, 0.0, 0.0])?;
/// env.restore(&state);
/// assert_eq!(env.step(&[1.0, 0.0, 0.0, 0.0])?, first);
/// # Ok::<(), Error>(())
/// ```
#[doc(alias = "save state")]
#[doc(alias = "set_state")]
pub trait Snapshot {
    /// Everything that the rest of an episode depends on.
    type State: Clone + Send + Sync;

    /// The current state.
    fn snapshot(&self) -> Self::State;

    /// Goes back to a state that [`Snapshot::snapshot`] of this environment, or of one made alike, has returned. This environment
    /// may never have been reset. It must be possible to step on from there beyond the time limit: plans of the oracle do.
    fn restore(&mut self, state: &Self::State);
}
