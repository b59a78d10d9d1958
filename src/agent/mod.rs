//! Agents: wiring of models, planners and networks behind one small interface.

mod baselines;
pub mod dreamer;
mod oracle;
mod pets;
mod sac;
mod warm_up;

pub use baselines::{Random, Scripted};
pub use dreamer::{Dreamer, DreamerConfig};
pub use oracle::{Oracle, OracleConfig};
pub use pets::{Pets, PetsConfig};
pub use sac::{Sac, SacConfig};

use std::collections::BTreeMap;

use crate::env::World;
use crate::error::Result;
use crate::model::open_loop::{Episode, OpenLoop};
use crate::nn::Weights;
use crate::replay::Transition;

/// Why an agent is asked to act.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// To learn: it may explore.
    Explore,
    /// To be judged: it does its best, deterministically.
    Evaluate,
}

/// Named numbers that an update reports: losses, entropies, norms.
pub type Losses = BTreeMap<&'static str, f32>;

/// A place from which an agent acts in an evaluation: one of several worlds side by side.
#[derive(Clone, Copy)]
pub struct Slot<'a> {
    /// Its number; it stays the same through an episode.
    pub index: usize,
    /// Whether this is the first step of an episode.
    pub first: bool,
    /// What is observed.
    pub obs: &'a [f32],
    /// The world itself. Only an oracle looks at it.
    pub world: &'a World,
}

/// A future that an agent imagined.
#[derive(Clone, Debug, PartialEq)]
pub struct ImaginedTrajectory {
    /// What it expected to observe, from the present on.
    pub observations: Vec<Vec<f32>>,
    /// The return that it expected.
    pub value: f32,
    /// How far its models disagree about it.
    pub disagreement: f32,
}

/// What an agent expected of a moment, and what came of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Expectation {
    /// The value that it gave the moment: the discounted rewards from there on.
    pub expected: f32,
    /// The discounted rewards that came. What would come after an episode that the clock ended is taken from the value of
    /// its last moment.
    pub realised: f32,
}

impl Expectation {
    /// Of each moment of an episode but the last, from the values of all its moments.
    pub fn of_episode(values: &[f32], episode: &Episode, discount: f32) -> Vec<Self> {
        let mut realised = if episode.terminated { 0.0 } else { *values.last().expect("a value for each moment") };
        let moments = episode.rewards.iter().zip(values).rev();
        let mut all: Vec<Self> = moments
            .map(|(reward, expected)| {
                realised = reward + discount * realised;
                Self { expected: *expected, realised }
            })
            .collect();
        all.reverse();
        all
    }
}

/// Something that acts and learns.
pub trait Agent: Send {
    /// Chooses an action, each number in [-1, 1].
    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32>;

    /// Actions in many worlds at once, in [`Mode::Evaluate`]. Networks answer for all of them in one
    /// pass; agents with a memory keep one for each slot.
    fn act_all(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        slots.iter().map(|slot| self.act(slot.obs, Mode::Evaluate)).collect()
    }

    /// Acts from one slot as [`Agent::act_all`] does, and shows some of the futures that were weighed up for it: nothing
    /// for agents that do not plan in a model.
    fn act_and_show(&mut self, slot: &Slot) -> (Vec<f32>, Vec<ImaginedTrajectory>) {
        (self.act_all(&[*slot]).remove(0), Vec::new())
    }

    /// Takes in one step of experience.
    fn observe(&mut self, transition: &Transition);

    /// Learns from what was observed; called once after every step. `None` while it only collects.
    fn update(&mut self) -> Option<Losses>;

    /// How well its model foresees episodes that it has not learned from; nothing for agents without a model.
    fn judge_model(&self, _traces: &[Episode]) -> Vec<OpenLoop> {
        Vec::new()
    }

    /// What it expects of each moment of episodes, beside what came; nothing for agents that expect nothing.
    fn judge_values(&self, _traces: &[Episode]) -> Vec<Expectation> {
        Vec::new()
    }

    /// What the agent has learned, enough to act.
    fn weights(&self) -> Weights;

    /// Takes over learned weights.
    ///
    /// # Errors
    /// If they are not those of an agent of this kind and these sizes.
    fn load_weights(&mut self, weights: &Weights) -> Result<()>;

    /// Everything else that training needs to go on as if it had never stopped: optimisers,
    /// experience, random numbers.
    fn training_state(&self) -> Weights;

    /// Takes over what [`Agent::training_state`] has given.
    ///
    /// # Errors
    /// If it is not that of an agent of this kind and these sizes.
    fn load_training_state(&mut self, state: &Weights) -> Result<()>;
}
