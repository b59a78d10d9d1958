//! Which initial states an episode has. Five sets of reset seeds share no element: training episodes, evaluations during
//! training, the test, development (what presets and settings are chosen on), and seeds of the user's.
//!
//! ```
//! use handful::prelude::*;
//!
//! let mut env = Task::Reach.make();
//! let first_of_the_test = env.reset(EvalSeeds::Test.seed(0)?);
//! assert_ne!(first_of_the_test, env.reset(EvalSeeds::Development.seed(0)?));
//! # Ok::<(), Error>(())
//! ```

use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// The seeds of runs, the seeds that a user gives an evaluation, and the episodes under one of them lie below this.
pub const LIMIT: u64 = 1 << 20;

const TRAINING: u64 = 0;
const CURVE: u64 = 1;
const TEST: u64 = 2;
const USER: u64 = 3;
const DEVELOPMENT: u64 = 4;

/// Set, seed and episode have bits of their own: two reset seeds are equal only if all three are.
fn reset_seed(set: u64, seed: u64, episode: usize) -> Result<u64> {
    check_below("seed", seed, LIMIT)?;
    check_below("episode", episode as u64, LIMIT)?;
    Ok((set << 40) | (seed << 20) | episode as u64)
}

/// # Errors
/// If the value of a field is `limit` or more.
pub(crate) fn check_below(field: &str, value: u64, limit: u64) -> Result<()> {
    if value < limit {
        return Ok(());
    }
    Err(Error::Config(format!("`{field}` is {value}; it must lie in 0..{limit}")))
}

/// The reset seed of an episode, counted from 0, that a run with seed `run` trains on.
///
/// # Errors
/// If either is not below [`LIMIT`].
pub fn training_seed(run: u64, episode: usize) -> Result<u64> {
    reset_seed(TRAINING, run, episode)
}

/// Which seeds, and so which initial states, an evaluation has. Training episodes share none of them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvalSeeds {
    /// Those of the evaluations during training, which the learning curve shows.
    Curve,
    /// Those of the test at the end, which nothing else uses.
    Test,
    /// Those on which presets and settings are chosen.
    Development,
    /// Those derived from a seed of the user's, below [`LIMIT`].
    Seed(u64),
}

impl EvalSeeds {
    /// The seed of an episode, counted from 0: what [`Env::reset`](crate::env::Env::reset) is given.
    ///
    /// # Errors
    /// If the episode, or the user's seed, is not below [`LIMIT`].
    pub fn seed(self, episode: usize) -> Result<u64> {
        match self {
            EvalSeeds::Curve => reset_seed(CURVE, 0, episode),
            EvalSeeds::Test => reset_seed(TEST, 0, episode),
            EvalSeeds::Development => reset_seed(DEVELOPMENT, 0, episode),
            EvalSeeds::Seed(seed) => reset_seed(USER, seed, episode),
        }
    }
}

/// On which initial states a run is measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Starts {
    /// A run whose results are reported: [`EvalSeeds::Curve`] during training, [`EvalSeeds::Test`] at the end.
    #[default]
    Test,
    /// A run that helps to choose a preset or a setting: [`EvalSeeds::Development`] both times, so that the choice has
    /// seen neither the curve's starts nor the test's.
    Development,
}

impl Starts {
    /// The initial states of the evaluations during training.
    pub fn curve(self) -> EvalSeeds {
        match self {
            Starts::Test => EvalSeeds::Curve,
            Starts::Development => EvalSeeds::Development,
        }
    }

    /// The initial states of the test at the end.
    pub fn test(self) -> EvalSeeds {
        match self {
            Starts::Test => EvalSeeds::Test,
            Starts::Development => EvalSeeds::Development,
        }
    }

    /// As it stands in `config.toml` and in tables.
    pub fn name(self) -> &'static str {
        match self {
            Starts::Test => "test",
            Starts::Development => "development",
        }
    }
}

impl FromStr for Starts {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let known = [Starts::Test, Starts::Development];
        let found = known.into_iter().find(|starts| starts.name() == name);
        found.ok_or_else(|| Error::unknown("starts", name, known.map(Starts::name)))
    }
}
