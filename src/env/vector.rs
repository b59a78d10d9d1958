//! Many environments at once, stepped in parallel over the cores, as Gymnasium's vector environments are.
//!
//! ```
//! use handful::prelude::*;
//!
//! let mut envs = VectorEnv::new(3, || Task::Pendulum.make());
//! let observations = envs.reset(&[7, 8, 9])?;
//! assert_eq!((observations.len(), observations[0].len()), (3, 3));
//! // The second environment rests.
//! let steps = envs.step(&[Some(vec![0.5]), None, Some(vec![-0.5])])?;
//! assert!(steps[0].is_some() && steps[1].is_none() && steps[2].is_some());
//! # Ok::<(), Error>(())
//! ```

use rayon::prelude::*;

use super::contract::Checked;
use super::{Env, Step};
use crate::error::{Error, Result};

/// Environments of one kind, side by side; the contract of each is enforced ([`Checked`]).
#[doc(alias = "vectorized environment")]
#[doc(alias = "batched environment")]
#[derive(Clone, Debug)]
pub struct VectorEnv<E> {
    envs: Vec<Checked<E>>,
}

impl<E: Env> VectorEnv<E> {
    /// `count` environments made by `make`.
    pub fn new(count: usize, make: impl Fn() -> E + Sync) -> Self {
        Self { envs: (0..count).into_par_iter().map(|_| Checked::new(make())).collect() }
    }

    /// The same, if making one can fail.
    ///
    /// # Errors
    /// Any error of `make`.
    pub fn try_new(count: usize, make: impl Fn() -> Result<E> + Sync) -> Result<Self> {
        let envs = (0..count).into_par_iter().map(|_| Ok(Checked::new(make()?)));
        Ok(Self { envs: envs.collect::<Result<_>>()? })
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.envs.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.envs.is_empty()
    }

    /// The environments themselves, in order.
    pub fn envs(&self) -> impl ExactSizeIterator<Item = &E> {
        self.envs.iter().map(Checked::env)
    }

    /// One of the environments.
    ///
    /// # Panics
    /// If there are not that many.
    pub fn env(&self, index: usize) -> &E {
        self.envs[index].env()
    }

    /// Starts an episode in each of the first `seeds.len()` environments; returns their first observations.
    ///
    /// # Errors
    /// [`Error::Config`] if there are more seeds than environments; the first environment's error if its spec or its
    /// observation breaks the contract.
    pub fn reset(&mut self, seeds: &[u64]) -> Result<Vec<Vec<f32>>> {
        if seeds.len() > self.envs.len() {
            let (seeds, envs) = (seeds.len(), self.envs.len());
            return Err(Error::Config(format!("reset: {seeds} seeds for {envs} environments")));
        }
        let each: Vec<_> = self.envs.par_iter_mut().zip(seeds).map(|(env, &seed)| env.reset(seed)).collect();
        each.into_iter().collect()
    }

    /// Steps every environment that has an action; the others rest and answer `None`. The result does not depend on the
    /// number of threads.
    ///
    /// # Errors
    /// [`Error::Config`] if `actions` has not one entry for each environment; else the error of the first
    /// environment that refuses its action or breaks the contract. The others have moved then.
    pub fn step(&mut self, actions: &[Option<Vec<f32>>]) -> Result<Vec<Option<Step>>> {
        if actions.len() != self.envs.len() {
            let (actions, envs) = (actions.len(), self.envs.len());
            return Err(Error::Config(format!(
                "step: {actions} actions for {envs} environments; give `None` to those that rest"
            )));
        }
        let step = |(env, action): (&mut Checked<E>, &Option<Vec<f32>>)| action.as_ref().map(|action| env.step(action));
        let each: Vec<Option<Result<Step>>> = self.envs.par_iter_mut().zip(actions).map(step).collect();
        each.into_iter().map(Option::transpose).collect()
    }
}
