//! Worlds to act in.
//!
//! [`Env`] is all that an agent asks of a world; implement it and every agent here trains on it.
//! [`KnownReward`] and [`Snapshot`] are what planners ask beyond that. [`World`] is any of the
//! worlds of this crate, by name.

pub mod arm;
pub mod cartpole;
pub mod contract;
pub mod kinematics;
pub mod osc;
pub mod pendulum;
pub mod physics;
pub mod scene;
pub mod tabletop;
pub mod vector;
mod world;

pub use world::{Task, World, WorldState};

use crate::error::{Error, Result};

/// The names, sizes and units of an environment's observations and actions.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Spec {
    /// The environment's name.
    pub name: String,
    /// What each number of an observation is.
    pub observation: Vec<Feature>,
    /// Numbers in an action; each lies in [-1, 1].
    pub action_size: usize,
    /// Control steps in an episode; its end by the clock is a truncation, not a termination.
    pub horizon: usize,
    /// Seconds from one action to the next.
    pub dt: f64,
    /// The stages on the way to success, in order, for reports.
    pub stages: Vec<String>,
}

/// One number of an observation.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Feature {
    /// Its name, with its unit where it has one.
    pub name: String,
    /// A typical value.
    pub centre: f32,
    /// A typical distance from `centre`: networks are fed (value - centre) / scale.
    pub scale: f32,
    /// Its part in the course of events: models predict only what has a course of its own.
    pub role: Role,
    /// The cube to whose axes it belongs, if it does. Of each cube six features say how it lies: the directions of its
    /// x-axis and of its z-axis, in this order. Nobody can tell a cube's sides apart, and models need not.
    pub cube: Option<String>,
}

/// What part a number has in the course of events.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Role {
    /// It has a course of its own.
    #[default]
    Dynamic,
    /// It stays as it is through an episode: a goal.
    Constant,
    /// It is the difference of two others, which are named.
    Difference {
        /// From this
        minuend: String,
        /// this is subtracted.
        subtrahend: String,
    },
}

impl Feature {
    /// A feature around zero of size one.
    pub fn new(name: impl Into<String>) -> Self {
        Self { name: name.into(), centre: 0.0, scale: 1.0, role: Role::Dynamic, cube: None }
    }

    /// The same feature, which stays as it is through an episode.
    pub fn constant(self) -> Self {
        Self { role: Role::Constant, ..self }
    }

    /// The same feature, which is the difference of two others.
    pub fn difference(self, minuend: impl Into<String>, subtrahend: impl Into<String>) -> Self {
        Self { role: Role::Difference { minuend: minuend.into(), subtrahend: subtrahend.into() }, ..self }
    }

    /// The same feature, if it says how a cube lies.
    pub fn axis_of_cube(self, cube: &str) -> Self {
        Self { cube: Some(cube.into()), ..self }
    }

    /// The same feature around another centre and of another size.
    pub fn around(self, centre: f32, scale: f32) -> Self {
        Self { centre, scale, ..self }
    }
}

impl Spec {
    /// An environment with these numbers in its observations, `action_size` numbers in [-1, 1] as its action, episodes of
    /// at most `horizon` control steps, and `dt` seconds from one action to the next.
    pub fn new(
        name: impl Into<String>,
        observation: impl IntoIterator<Item = Feature>,
        action_size: usize,
        horizon: usize,
        dt: f64,
    ) -> Self {
        let observation = observation.into_iter().collect();
        Self { name: name.into(), observation, action_size, horizon, dt, stages: Vec::new() }
    }

    /// The same with the stages on the way to success, in order.
    pub fn stages(self, stages: impl IntoIterator<Item = impl Into<String>>) -> Self {
        Self { stages: stages.into_iter().map(Into::into).collect(), ..self }
    }

    /// Whether the specification makes sense: every agent asks this before it is built.
    ///
    /// # Errors
    /// [`Error::BadSetting`] names the environment, the feature and the rule: at least one feature, one number in the
    /// action and one step in the horizon; `dt` positive and finite; names neither empty nor given twice; centres finite,
    /// scales positive and finite; a [`Role::Difference`] names two features that are no differences themselves.
    pub fn check(&self) -> Result<()> {
        let refuse = |problem: String| Err(Error::BadSetting(format!("{}: {problem}", self.name)));
        if self.observation.is_empty() {
            return refuse("an observation needs at least one feature".into());
        }
        for (name, value) in [("action_size", self.action_size), ("horizon", self.horizon)] {
            if value == 0 {
                return refuse(format!("`{name}` must be at least 1"));
            }
        }
        if !(self.dt > 0.0 && self.dt.is_finite()) {
            return refuse(format!("`dt` must be positive and finite, it is {}", self.dt));
        }
        let mut names = std::collections::HashSet::new();
        for (i, Feature { name, centre, scale, .. }) in self.observation.iter().enumerate() {
            if name.is_empty() {
                return refuse(format!("feature {i} has no name"));
            }
            if !names.insert(name) {
                return refuse(format!("two features are called `{name}`"));
            }
            if !centre.is_finite() {
                return refuse(format!("the centre of feature `{name}` must be finite, it is {centre}"));
            }
            if !(*scale > 0.0 && scale.is_finite()) {
                return refuse(format!("the scale of feature `{name}` must be positive and finite, it is {scale}"));
            }
        }
        for Feature { name, role, .. } in &self.observation {
            let Role::Difference { minuend, subtrahend } = role else { continue };
            for part in [minuend, subtrahend] {
                match self.observation.iter().find(|feature| feature.name == *part) {
                    None => {
                        return refuse(format!("feature `{name}` is a difference of `{part}`, which is no feature"));
                    }
                    Some(Feature { role: Role::Difference { .. }, .. }) => {
                        return refuse(format!("feature `{name}` is a difference of `{part}`, itself a difference"));
                    }
                    Some(_) => {}
                }
            }
        }
        Ok(())
    }

    /// Numbers in an observation.
    pub fn observation_size(&self) -> usize {
        self.observation.len()
    }

    /// Whether `action` can be taken: the right length, and every number finite.
    ///
    /// # Errors
    /// [`Error::BadAction`] names the length or the number that is wrong.
    pub fn check_action(&self, action: &[f32]) -> Result<()> {
        if action.len() != self.action_size {
            return Err(Error::bad_action(
                &self.name,
                format!("an action has {} numbers, this one has {}", self.action_size, action.len()),
            ));
        }
        match action.iter().position(|a| !a.is_finite()) {
            Some(i) => Err(Error::bad_action(&self.name, format!("action[{i}] is {}", action[i]))),
            None => Ok(()),
        }
    }
}

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
pub trait Env: std::any::Any + Send {
    /// The names, sizes and units of observations and actions. It does not change.
    fn spec(&self) -> &Spec;

    /// Starts an episode; the seed fixes everything that is drawn at random in it. Returns the first observation,
    /// [`Spec::observation_size`] numbers.
    fn reset(&mut self, seed: u64) -> Vec<f32>;

    /// Acts for one control step. Numbers outside [-1, 1] count as the nearest bound.
    ///
    /// # Errors
    /// [`Error::BadAction`] if the action has the wrong length or is not finite; nothing has moved then.
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

/// A reward that can be computed from observations alone, as planners need it.
pub trait KnownReward {
    /// Whether observations determine the reward at all. True by default; false for an environment that can be set to
    /// observe too little, whose [`KnownReward::reward`] then panics.
    fn is_known(&self) -> bool {
        true
    }

    /// The reward of reaching `next_obs` from `obs` by `action`.
    fn reward(&self, obs: &[f32], action: &[f32], next_obs: &[f32]) -> f32;

    /// Whether reaching `next_obs` ends the task itself. Most tasks here never do.
    fn terminated(&self, _next_obs: &[f32]) -> bool {
        false
    }

    /// [`KnownReward::reward`] for a batch: `obs` and `next_obs` hold `rewards.len()` rows, one after the other, as
    /// does `actions`. Rewards are written into `rewards`.
    ///
    /// # Panics
    /// If the lengths do not fit together.
    fn rewards(&self, obs: &[f32], actions: &[f32], next_obs: &[f32], rewards: &mut [f32]) {
        let n = rewards.len().max(1);
        assert!(obs.len() == next_obs.len() && obs.len().is_multiple_of(n) && actions.len().is_multiple_of(n));
        let rows = obs.chunks(obs.len() / n).zip(actions.chunks(actions.len() / n)).zip(next_obs.chunks(obs.len() / n));
        for (reward, ((obs, action), next)) in rewards.iter_mut().zip(rows) {
            *reward = self.reward(obs, action, next);
        }
    }
}

/// A world that can be put back to where it was, and then steps on bit for bit as it did.
pub trait Snapshot {
    /// All that the future depends on.
    type State: Clone + Send + Sync;

    /// The present state.
    fn snapshot(&self) -> Self::State;

    /// Back to a state that [`Snapshot::snapshot`] of this world, or one made alike, has given.
    fn restore(&mut self, state: &Self::State);
}
