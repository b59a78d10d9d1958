//! Policies that do not learn: the lower bound, and what a person would write.

use super::{Agent, Checkpoint, Mode, Slot, Slots};
use crate::checkpoint::Weights;
use crate::env::tabletop::{ObservationKind, TableOptions};
use crate::env::{Spec, Task};
use crate::error::{Error, Result};
use crate::rng::{self, Rng};

/// Uniform random actions.
#[derive(Debug)]
pub struct Random {
    action_size: usize,
    seed: u64,
    rng: Rng,
    slots: Slots<Rng>,
}

impl Random {
    /// Random actions for an environment.
    pub fn new(spec: &Spec, seed: u64) -> Self {
        Self { action_size: spec.action_size, seed, rng: rng::stream(seed, "random agent"), slots: Slots::default() }
    }
}

fn random_action(size: usize, rng: &mut Rng) -> Vec<f32> {
    (0..size).map(|_| rng::uniform(rng, -1.0, 1.0) as f32).collect()
}

/// A function from observations to actions.
type PolicyFunction = dyn Fn(&[f32]) -> Vec<f32> + Send;

/// A hand-written policy.
pub struct Scripted {
    policy: Box<PolicyFunction>,
}

impl Scripted {
    /// The policy that is a function from observations to actions, each component in [-1, 1].
    pub fn new(policy: impl Fn(&[f32]) -> Vec<f32> + Send + 'static) -> Self {
        Self { policy: Box::new(policy) }
    }

    /// The policy of one of this crate's tasks for the arm.
    ///
    /// # Errors
    /// If the task has none, or observations are not compact.
    pub fn of_task(task: Task, options: TableOptions) -> Result<Self> {
        if options.observation != ObservationKind::Compact {
            return Err(Error::Unsupported("the scripted policies need compact observations".into()));
        }
        let policy = task.scripted_policy(options);
        policy.map(Self::new).ok_or_else(|| Error::Unsupported(format!("{task} has no scripted policy")))
    }
}

impl std::fmt::Debug for Scripted {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str("Scripted")
    }
}

impl Agent for Random {
    fn act(&mut self, _obs: &[f32], _mode: Mode) -> Vec<f32> {
        random_action(self.action_size, &mut self.rng)
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let Self { action_size, seed, slots: states, .. } = self;
        // By the initial observation, since episodes that are evaluated one after the other share slots.
        let start = |index: usize| {
            let slot = slots.iter().find(|slot| slot.index == index).expect("a state is made for one of these slots");
            crc32fast::hash(bytemuck::cast_slice(slot.obs))
        };
        let fresh = |index| rng::stream(*seed, &format!("random agent, slot {index}, start {:08x}", start(index)));
        states.states(slots, fresh).into_iter().map(|rng| random_action(*action_size, rng)).collect()
    }
}

impl Checkpoint for Random {
    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        state.insert_rng("rng", &self.rng);
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        self.rng = state.rng("rng")?;
        Ok(())
    }
}

impl Agent for Scripted {
    fn act(&mut self, obs: &[f32], _mode: Mode) -> Vec<f32> {
        (self.policy)(obs)
    }
}

impl Checkpoint for Scripted {}
