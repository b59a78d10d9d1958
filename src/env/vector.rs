//! Many worlds at once, stepped in parallel over the cores.

use rayon::prelude::*;

use super::{Env, Step};
use crate::error::Result;

/// A row of environments of the same kind.
pub struct VectorEnv<E> {
    envs: Vec<E>,
}

impl<E: Env> VectorEnv<E> {
    /// `count` environments made by `make`.
    pub fn new(count: usize, make: impl Fn() -> E + Sync) -> Self {
        Self { envs: (0..count).into_par_iter().map(|_| make()).collect() }
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.envs.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.envs.is_empty()
    }

    /// The environments themselves.
    pub fn envs(&self) -> &[E] {
        &self.envs
    }

    /// EvalSeeds an episode in each of the first `seeds.len()` environments.
    pub fn reset(&mut self, seeds: &[u64]) -> Vec<Vec<f32>> {
        self.envs.par_iter_mut().zip(seeds).map(|(env, &seed)| env.reset(seed)).collect()
    }

    /// Steps every environment that has an action; the others rest and answer `None`. The outcome
    /// does not depend on the number of threads.
    ///
    /// # Errors
    /// The first environment's error, if one refuses its action.
    pub fn step(&mut self, actions: &[Option<Vec<f32>>]) -> Result<Vec<Option<Step>>> {
        self.envs
            .par_iter_mut()
            .zip(actions)
            .map(|(env, action)| action.as_ref().map(|action| env.step(action)).transpose())
            .collect()
    }
}
