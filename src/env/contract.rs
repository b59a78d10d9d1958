//! The contract of an environment, and a wrapper that enforces it.
//!
//! [`Checked`] wraps any [`Env`] and refuses, with an [`Error::Contract`] that names the environment, the step and the
//! rule, whatever would otherwise surface much later as a NaN loss or an index out of bounds:
//!
//! - the [`Spec`](super::Spec) makes sense ([`Spec::check`](super::Spec::check), asked at every reset);
//! - observations have [`Spec::observation_size`](super::Spec::observation_size) numbers, all of them finite;
//! - features are what their [`Role`] says: constant throughout an episode, or a difference of two others;
//! - actions have [`Spec::action_size`](super::Spec::action_size) numbers, all of them finite;
//! - rewards are finite;
//! - the stage is at most the number of [`Spec::stages`](super::Spec::stages);
//! - episodes end within [`Spec::horizon`](super::Spec::horizon) steps, terminated or truncated;
//! - a step follows a reset, and none follows the end of an episode.
//!
//! ```
//! use handful::env::contract::Checked;
//! use handful::prelude::*;
//!
//! /// Its observation is one number longer than its spec says.
//! struct Wrong(Spec);
//!
//! impl Env for Wrong {
//!     fn spec(&self) -> &Spec { &self.0 }
//!     fn reset(&mut self, _seed: u64) -> Vec<f32> { vec![0.0, 1.0] }
//!     fn step(&mut self, _action: &[f32]) -> Result<Step> { Ok(Step::new(vec![0.0, 1.0], 0.0)) }
//! }
//!
//! let mut env = Checked::new(Wrong(Spec::new("wrong", [Feature::new("x")], 1, 10, 0.1)));
//! let error = env.reset(0).unwrap_err().to_string();
//! assert!(error.contains("the observation at the reset has 2 numbers, the spec names 1"), "{error}");
//! ```

use super::{Env, Role, Step};
use crate::error::{Error, Result};

/// An environment whose contract is enforced. See the [module](self) for the rules.
#[derive(Clone, Debug)]
pub struct Checked<E> {
    env: E,
    /// Steps in this episode; None before the first reset and after the end of an episode.
    elapsed: Option<usize>,
    /// The seed of the last reset.
    seed: u64,
    /// The features whose values follow from their roles, by index; looked up at every reset.
    determined: Vec<(usize, Value)>,
}

/// What a feature has to be, by its role.
#[derive(Clone, Debug)]
enum Value {
    /// What it was at the reset.
    Constant(f32),
    /// The difference of two other features, by index.
    Difference { minuend: usize, subtrahend: usize },
}

impl Value {
    /// What the feature has to be in an observation, and how far rounding may take it from there.
    fn expected(&self, obs: &[f32]) -> (f32, f32) {
        match self {
            Self::Constant(first) => (*first, 0.0),
            Self::Difference { minuend, subtrahend } => {
                let [a, b] = [obs[*minuend], obs[*subtrahend]];
                (a - b, 2.0 * f32::EPSILON * (a.abs() + b.abs()))
            }
        }
    }
}

/// How far a feature may be from what its role says, as a fraction of its scale: less than what would mislead a model that relies on
/// the role.
const TOLERANCE: f32 = 1e-3;

impl<E: Env> Checked<E> {
    /// The environment, its contract enforced from the next reset on.
    pub fn new(env: E) -> Self {
        Self { env, elapsed: None, seed: 0, determined: Vec::new() }
    }

    /// The environment.
    pub fn env(&self) -> &E {
        &self.env
    }

    /// The environment itself. Its resets and steps are neither checked nor counted.
    pub fn env_mut(&mut self) -> &mut E {
        &mut self.env
    }

    /// The environment, unwrapped.
    pub fn into_inner(self) -> E {
        self.env
    }

    /// [`Env::reset`].
    ///
    /// # Errors
    /// [`Error::Config`] if the spec makes no sense, [`Error::Contract`] if the first observation breaks a rule.
    pub fn reset(&mut self, seed: u64) -> Result<Vec<f32>> {
        (self.elapsed, self.seed) = (None, seed);
        self.env.spec().check()?;
        let obs = self.env.reset(seed);
        self.check_observation(&obs, "the reset")?;
        self.determined = self.by_role(&obs);
        self.check_roles(&obs, "the reset")?;
        self.elapsed = Some(0);
        Ok(obs)
    }

    /// [`Env::step`]. Steps are counted from 1 in every episode.
    ///
    /// # Errors
    /// [`Error::Action`] and any error of [`Env::step`], after which the episode goes on; [`Error::Contract`] if the environment
    /// breaks a rule, after which only a reset helps.
    pub fn step(&mut self, action: &[f32]) -> Result<Step> {
        let Some(elapsed) = self.elapsed else {
            let rule = "a step before the first reset, or after the end of an episode; reset first".into();
            return Err(Error::Contract { env: self.env.spec().name.clone(), rule });
        };
        self.env.spec().check_action(action)?;
        let step = self.env.step(action)?;
        self.elapsed = None;
        let (count, spec) = (elapsed + 1, self.env.spec());
        let at = format!("step {count}");
        self.check_observation(&step.observation, &at)?;
        self.check_roles(&step.observation, &at)?;
        if !step.reward.is_finite() {
            return self.broken(format!("the reward at step {count} is {}", step.reward));
        }
        if step.stage > spec.stages.len() {
            let (stage, stages) = (step.stage, spec.stages.len());
            return self.broken(format!("the stage at step {count} is {stage}, the spec names {stages} stages"));
        }
        if !step.done() {
            if count >= spec.horizon {
                let horizon = spec.horizon;
                return self.broken(format!(
                    "step {count} neither terminated nor truncated the episode, the spec's horizon is {horizon} steps"
                ));
            }
            self.elapsed = Some(count);
        }
        Ok(step)
    }

    fn check_observation(&self, obs: &[f32], at: &str) -> Result<()> {
        let features = &self.env.spec().observation;
        if obs.len() != features.len() {
            let (has, named) = (obs.len(), features.len());
            return self.broken(format!("the observation at {at} has {has} numbers, the spec names {named}"));
        }
        match obs.iter().zip(features).find(|(x, _)| !x.is_finite()) {
            Some((x, feature)) => self.broken(format!("`{}` in the observation at {at} is {x}", feature.name)),
            None => Ok(()),
        }
    }

    /// What the features of an episode that begins with this observation have to be.
    fn by_role(&self, obs: &[f32]) -> Vec<(usize, Value)> {
        let features = &self.env.spec().observation;
        let index_of = |name: &str| self.env.spec().index_of(name).expect("a checked spec");
        let value = |i: usize| match &features[i].role {
            Role::Dynamic => None,
            Role::Constant => Some(Value::Constant(obs[i])),
            Role::Difference { minuend, subtrahend } => {
                Some(Value::Difference { minuend: index_of(minuend), subtrahend: index_of(subtrahend) })
            }
        };
        (0..features.len()).filter_map(|i| Some((i, value(i)?))).collect()
    }

    fn check_roles(&self, obs: &[f32], at: &str) -> Result<()> {
        let features = &self.env.spec().observation;
        for (i, value) in &self.determined {
            let (x, feature) = (obs[*i], &features[*i]);
            let (expected, rounding) = value.expected(obs);
            if (x - expected).abs() > TOLERANCE * feature.scale + rounding {
                let why = match value {
                    Value::Constant(_) => "at the reset, and its role is constant".into(),
                    Value::Difference { minuend, subtrahend } => {
                        let [a, b] = [minuend, subtrahend].map(|part| &features[*part].name);
                        format!("as `{a}` minus `{b}`, which its role says it is")
                    }
                };
                let name = &feature.name;
                return self.broken(format!("`{name}` in the observation at {at} is {x}, but {expected} {why}"));
            }
        }
        Ok(())
    }

    fn broken<T>(&self, rule: String) -> Result<T> {
        let rule = format!("{rule} (in the episode of `reset({})`)", self.seed);
        Err(Error::Contract { env: self.env.spec().name.clone(), rule })
    }
}
