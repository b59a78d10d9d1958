//! Random numbers. Every function that needs them takes a generator as an argument; there is no global generator.
//!
//! A run has one seed. Each purpose within it has a stream of its own, so that drawing more numbers for one purpose does not
//! change any other:
//!
//! ```
//! use handful::rng;
//!
//! let mut exploration = rng::stream(0, "exploration");
//! let x = rng::normal(&mut exploration);
//!
//! // The same seed and purpose give the same numbers; another purpose gives others.
//! assert_eq!(rng::normal(&mut rng::stream(0, "exploration")), x);
//! assert_ne!(rng::normal(&mut rng::stream(0, "evaluation")), x);
//!
//! // The state of a generator can be saved, for instance in a checkpoint, and restored.
//! let mut restored = rng::from_state(&rng::state(&exploration));
//! assert_eq!(rng::normal(&mut restored), rng::normal(&mut exploration));
//! ```
//!
//! The environment variable [`SHAKE`] moves all streams at once. With it every test and chapter becomes an experiment: does
//! its claim hold for other seeds as well?

use std::sync::OnceLock;

use rand::{RngExt, SeedableRng};

use crate::error::{Error, Result};

/// The generator used throughout: xoshiro256++, whose state is four words and can be saved.
#[doc(alias = "seed")]
pub type Rng = rand_xoshiro::Xoshiro256PlusPlus;

/// The environment variable that moves every random stream of the process to other seeds: `HANDFUL_SHAKE=7 cargo test` runs
/// all tests and chapters with other random numbers. Unset or 0, the streams are those of the published results.
pub const SHAKE: &str = "HANDFUL_SHAKE";

/// The value of [`SHAKE`], read once.
///
/// # Panics
/// If it is not a whole number below 2^16; [`read_shake`] returns an error instead.
pub fn shake() -> u64 {
    static VALUE: OnceLock<u64> = OnceLock::new();
    *VALUE.get_or_init(|| read_shake().unwrap_or_else(|problem| panic!("{problem}")))
}

/// The value of [`SHAKE`] in the environment.
///
/// # Errors
/// If it is not a whole number below 2^16.
pub fn read_shake() -> Result<u64> {
    let Some(value) = std::env::var_os(SHAKE) else { return Ok(0) };
    let number = value.to_str().and_then(|value| value.parse::<u16>().ok());
    let problem =
        || Error::Config(format!("{SHAKE} is {value:?}; it must be a whole number from 0 to 65535, or unset"));
    number.map(u64::from).ok_or_else(problem)
}

/// The generator for `purpose` in a run with this `seed`. Different purposes give independent streams. Old checkpoints and
/// published numbers depend on these strings.
pub fn stream(seed: u64, purpose: &str) -> Rng {
    // Seeds of runs and episodes lie below 2^48, so a shake never moves one onto another.
    let seed = seed.wrapping_add(shake() << 48);
    // FNV-1a, because the standard library's hash may change between versions.
    let hash = purpose
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    Rng::seed_from_u64(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ hash)
}

/// A sample from the uniform distribution on `low..high`.
pub fn uniform(rng: &mut Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// A sample from the standard normal distribution.
pub fn normal(rng: &mut Rng) -> f64 {
    rng.sample(rand_distr::StandardNormal)
}

/// `count` samples from the standard normal distribution.
pub fn normals(count: usize, rng: &mut Rng) -> Vec<f32> {
    (0..count).map(|_| normal(rng) as f32).collect()
}

/// A sample from the standard normal distribution truncated to two standard deviations, by rejection.
pub fn truncated_normal(rng: &mut Rng) -> f64 {
    loop {
        let z = normal(rng);
        if z.abs() <= 2.0 {
            return z;
        }
    }
}

/// A new generator, seeded with a number drawn from this one.
pub fn fork(rng: &mut Rng) -> Rng {
    Rng::seed_from_u64(rng.random())
}

/// The state of a generator, for [`from_state`].
pub fn state(rng: &Rng) -> [u64; 4] {
    let bytes = rng.state();
    std::array::from_fn(|i| u64::from_le_bytes(std::array::from_fn(|k| bytes[8 * i + k])))
}

/// A generator that continues from a state saved with [`state`].
///
/// # Panics
/// If `state` does not have length 4.
pub fn from_state(state: &[u64]) -> Rng {
    assert_eq!(state.len(), 4, "the state of a generator has four words");
    Rng::from_seed(std::array::from_fn(|i| state[i / 8].to_le_bytes()[i % 8]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A saved state continues the same stream, and its words mean what they mean in old checkpoints.
    #[test]
    fn a_generator_continues_from_its_state() {
        let mut rng = stream(3, "state");
        rng.random::<u64>();
        assert_eq!(from_state(&state(&rng)), rng);
        // The reference implementation's first number for the state 1, 2, 3, 4.
        assert_eq!(from_state(&[1, 2, 3, 4]).random::<u64>(), 41_943_041);
    }
}
