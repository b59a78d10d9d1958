//! Agents that do not learn: the floor, and what a person would write.

use super::{Agent, Mode};
use crate::env::tabletop::{ObservationKind, TableOptions};
use crate::env::{Spec, Task};
use crate::error::{Error, Result};
use crate::rng::{self, Rng};

/// Uniform random actions.
pub struct Random {
    actions: usize,
    rng: Rng,
}

impl Random {
    /// Random actions for an environment.
    pub fn new(spec: &Spec, seed: u64) -> Self {
        Self { actions: spec.action_size, rng: rng::stream(seed, "random agent") }
    }
}

/// From a compact observation to an action.
type Policy = dyn Fn(&[f32]) -> Vec<f32> + Send;

/// The hand-written policy of one of the arm's tasks.
pub struct Scripted {
    policy: Box<Policy>,
}

impl Scripted {
    /// The policy of `task`.
    ///
    /// # Errors
    /// If the task has none, or observations are not compact.
    pub fn new(task: Task, options: TableOptions) -> Result<Self> {
        if options.observation != ObservationKind::Compact {
            return Err(Error::BadSetting("the scripted policies read compact observations".into()));
        }
        let policy = task
            .scripted_policy(options)
            .ok_or_else(|| Error::BadSetting(format!("{task} has no scripted policy; the arm's tasks do")))?;
        Ok(Self { policy: Box::new(policy) })
    }
}

/// What there is to say of an agent that never learns. If it draws random numbers, from a field that is named here, it goes
/// on with them after a stop.
macro_rules! never_learns {
    ($($rng:ident)?) => {
        fn observe(&mut self, _transition: &crate::replay::Transition) {}

        fn update(&mut self) -> Option<crate::agent::Losses> {
            None
        }

        fn weights(&self) -> crate::nn::Weights {
            crate::nn::Weights::default()
        }

        fn load_weights(&mut self, _weights: &crate::nn::Weights) -> crate::error::Result<()> {
            Ok(())
        }

        #[allow(unused_mut)]
        fn training_state(&self) -> crate::nn::Weights {
            let mut state = crate::nn::Weights::default();
            $(state.insert_counts("rng", &crate::rng::state(&self.$rng));)?
            state
        }

        #[allow(unused_variables)]
        fn load_training_state(&mut self, state: &crate::nn::Weights) -> crate::error::Result<()> {
            $(self.$rng = crate::rng::from_state(&state.counts("rng", 4)?);)?
            Ok(())
        }
    };
}

pub(super) use never_learns;

impl Agent for Random {
    fn act(&mut self, _obs: &[f32], _mode: Mode) -> Vec<f32> {
        (0..self.actions).map(|_| rng::uniform(&mut self.rng, -1.0, 1.0) as f32).collect()
    }

    never_learns!(rng);
}

impl Agent for Scripted {
    fn act(&mut self, obs: &[f32], _mode: Mode) -> Vec<f32> {
        (self.policy)(obs)
    }

    never_learns!();
}
