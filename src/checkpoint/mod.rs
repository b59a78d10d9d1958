//! Checkpoints: named arrays in safetensors files, written so that a crash never leaves half a file.
//!
//! A checkpoint holds f32 arrays (weights, optimiser moments, replayed experience), u64 arrays (step counts, the states of
//! random number generators), and notes. The file's metadata have the notes and a checksum of everything in the file, so that
//! damage is found when it is read. An array whose numbers are all exact in half precision is stored as f16.
//!
//! ```
//! use handful::checkpoint::Weights;
//! use handful::rng;
//!
//! let generator = rng::stream(0, "example");
//! let mut saved = Weights::default();
//! saved.insert("policy.0.bias", vec![0.5, -0.5], [1, 1, 2]);
//! saved.insert_rng("rng", &generator);
//! saved.insert_counts("steps", &[1000]);
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("state.safetensors");
//! saved.write(&path)?;
//! let read = Weights::read(&path)?;
//! assert_eq!(read.get("policy.0.bias", [1, 1, 2])?, [0.5, -0.5]);
//! assert_eq!(read.rng("rng")?, generator);
//! assert_eq!(read.count("steps", 0..=2000)?, 1000);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod file;

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use half::f16;
use half::slice::HalfFloatSliceExt;

use crate::error::{Error, Result};
use crate::rng::{self, Rng};

/// No number of steps, updates or the like in a checkpoint is larger, so that adding a few of them never overflows.
pub const MAX_COUNT: u64 = 1 << 48;

/// The contents of a checkpoint: named f32 arrays of three dimensions, named lists of whole numbers, and named notes.
///
/// Modules go in and out through [`Weights::insert_module`] and [`Weights::load_module`].
#[doc(alias = "checkpoint")]
#[doc(alias = "state_dict")]
#[doc(alias = "safetensors")]
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Weights {
    arrays: BTreeMap<String, (Vec<f32>, [usize; 3])>,
    counts: BTreeMap<String, Vec<u64>>,
    notes: BTreeMap<String, String>,
}

impl Weights {
    /// Adds an array in row-major order. It replaces any entry of that name.
    ///
    /// # Panics
    /// If `shape` does not hold as many numbers.
    pub fn insert(&mut self, name: impl Into<String>, numbers: Vec<f32>, shape: [usize; 3]) {
        assert_eq!(numbers.len(), shape.iter().product::<usize>());
        let name = name.into();
        self.counts.remove(&name);
        self.arrays.insert(name, (numbers, shape));
    }

    /// Whether there are neither arrays nor whole numbers.
    pub fn is_empty(&self) -> bool {
        self.arrays.is_empty() && self.counts.is_empty()
    }

    /// The array of that name and shape.
    ///
    /// # Errors
    /// If it is missing or has another shape.
    pub fn get(&self, name: &str, shape: [usize; 3]) -> Result<&[f32]> {
        match self.arrays.get(name) {
            None => Err(Error::Config(format!("the weights have no `{name}`"))),
            Some((_, other)) if *other != shape => {
                Err(Error::Config(format!("`{name}` has the sizes {other:?} where {shape:?} are expected")))
            }
            Some((numbers, _)) => Ok(numbers),
        }
    }

    /// The shape of an array.
    ///
    /// # Errors
    /// If there is none of that name.
    pub fn shape(&self, name: &str) -> Result<[usize; 3]> {
        let found = self.arrays.get(name).map(|(_, shape)| *shape);
        found.ok_or_else(|| Error::Config(format!("the weights have no `{name}`")))
    }

    /// Rounds matrices (arrays of more than one row) to half precision, so that their file is about half as large. Numbers below
    /// 6e-5 lose precision, and below 3e-8 become zero. Arrays of one row (biases, the constants of a normalisation) stay as they
    /// are, and so do matrices with a number beyond the range of f16 (65,504).
    pub fn round_to_half(&mut self) {
        for (numbers, _) in self.arrays.values_mut().filter(|(_, [_, rows, _])| *rows > 1) {
            let halves: Vec<f16> = numbers.iter().map(|x| f16::from_f32(*x)).collect();
            if halves.iter().all(|x| x.is_finite()) {
                *numbers = halves.to_f32_vec();
            }
        }
    }

    /// Whether [`Weights::round_to_half`] would change nothing.
    pub fn is_rounded(&self) -> bool {
        let mut rounded = self.clone();
        rounded.round_to_half();
        rounded == *self
    }

    /// The name of an array that holds NaN, if there is one.
    pub fn with_nan(&self) -> Option<&str> {
        let found = self.arrays.iter().find(|(_, (numbers, _))| numbers.iter().any(|x| x.is_nan()));
        found.map(|(name, _)| name.as_str())
    }

    /// Adds whole numbers, stored as a U64 tensor. They replace any entry of that name.
    pub fn insert_counts(&mut self, name: impl Into<String>, counts: &[u64]) {
        let name = name.into();
        self.arrays.remove(&name);
        self.counts.insert(name, counts.to_vec());
    }

    /// Reads what [`Weights::insert_counts`] wrote. Also reads older checkpoints, which kept 16 bits of
    /// a whole number in each of four f32: an array `[1, count, 4]`.
    ///
    /// # Errors
    /// If there are no whole numbers of that name, or more or fewer than `count`.
    pub fn counts(&self, name: &str, count: usize) -> Result<Vec<u64>> {
        match self.counts.get(name) {
            Some(counts) if counts.len() == count => Ok(counts.clone()),
            Some(counts) => {
                Err(Error::Config(format!("`{name}` holds {} whole numbers where {count} are expected", counts.len())))
            }
            None => {
                let parts = self.get(name, [1, count, 4])?;
                let joined = parts.chunks(4).map(|p| (0..4).map(|i| (p[i] as u64) << (16 * i)).sum());
                Ok(joined.collect())
            }
        }
    }

    /// Whether there are whole numbers of that name.
    pub fn has_counts(&self, name: &str) -> bool {
        self.counts.contains_key(name)
    }

    /// As many whole numbers as there are ranges, each in its range.
    ///
    /// # Errors
    /// As [`Weights::counts`], and if a number lies outside.
    pub fn counts_within(&self, name: &str, ranges: &[RangeInclusive<u64>]) -> Result<Vec<u64>> {
        let counts = self.counts(name, ranges.len())?;
        match counts.iter().zip(ranges).find(|(count, range)| !range.contains(count)) {
            None => Ok(counts),
            Some((count, range)) => Err(outside(name, count, range)),
        }
    }

    /// One whole number that lies in `range`.
    ///
    /// # Errors
    /// As [`Weights::counts_within`].
    pub fn count(&self, name: &str, range: RangeInclusive<u64>) -> Result<u64> {
        Ok(self.counts_within(name, &[range])?[0])
    }

    /// The array of that name and shape, all of whose numbers lie in `range`.
    ///
    /// # Errors
    /// As [`Weights::get`], and if a number lies outside.
    pub fn get_within(&self, name: &str, shape: [usize; 3], range: RangeInclusive<f32>) -> Result<&[f32]> {
        let numbers = self.get(name, shape)?;
        match numbers.iter().find(|number| !range.contains(number)) {
            None => Ok(numbers),
            Some(number) => Err(outside(name, number, &range)),
        }
    }

    /// Adds the state of a random number generator.
    pub fn insert_rng(&mut self, name: impl Into<String>, rng: &Rng) {
        self.insert_counts(name, &rng::state(rng));
    }

    /// A generator that continues from the state saved with [`Weights::insert_rng`].
    ///
    /// # Errors
    /// If there is none, or it is zero, which no generator ever is.
    pub fn rng(&self, name: &str) -> Result<Rng> {
        let state = self.counts(name, 4)?;
        if state == [0; 4] {
            return Err(Error::Config(format!("`{name}` is zero, which is no state of a generator")));
        }
        Ok(rng::from_state(&state))
    }

    /// Adds all arrays and whole numbers of `other`, with `prefix` before their names. Notes stay behind.
    pub fn absorb(&mut self, prefix: &str, other: &Self) {
        for (name, (numbers, shape)) in &other.arrays {
            self.insert(format!("{prefix}{name}"), numbers.clone(), *shape);
        }
        for (name, counts) in &other.counts {
            self.insert_counts(format!("{prefix}{name}"), counts);
        }
    }

    /// The arrays and whole numbers whose names begin with `prefix`, without it.
    pub fn extract(&self, prefix: &str) -> Self {
        fn under<T: Clone>(all: &BTreeMap<String, T>, prefix: &str) -> BTreeMap<String, T> {
            let found = all.iter().filter_map(|(name, x)| Some((name.strip_prefix(prefix)?.into(), x.clone())));
            found.collect()
        }
        Self { arrays: under(&self.arrays, prefix), counts: under(&self.counts, prefix), ..Self::default() }
    }

    /// Adds a note, stored in the file's metadata.
    pub fn set_note(&mut self, name: impl Into<String>, text: String) {
        self.notes.insert(name.into(), text);
    }

    /// The note of that name.
    pub fn note(&self, name: &str) -> Option<&str> {
        self.notes.get(name).map(String::as_str)
    }
}

fn outside<T: std::fmt::Debug>(name: &str, value: &T, range: &RangeInclusive<T>) -> Error {
    Error::Config(format!("`{name}` is {value:?}; it must lie in {range:?}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file cannot hold two tensors of one name.
    #[test]
    fn a_name_is_given_once() {
        let mut weights = Weights::default();
        assert!(weights.is_empty());
        weights.insert("steps", vec![0.5], [1, 1, 1]);
        weights.insert_counts("steps", &[7]);
        assert!(weights.get("steps", [1, 1, 1]).is_err() && weights.count("steps", 0..=9).expect("a count") == 7);
        let mut other = Weights::default();
        other.insert("steps", vec![0.25], [1, 1, 1]);
        weights.absorb("", &other);
        assert!(weights == other && !weights.is_empty());
    }

    #[test]
    fn only_matrices_are_rounded() {
        let mut weights = Weights::default();
        weights.insert("weight", vec![0.1, 1e-9, -3.0, 0.0], [1, 2, 2]);
        weights.insert("bias", vec![0.1, 1e-9], [2, 1, 1]);
        weights.insert("large", vec![0.1, 1e6], [1, 2, 1]);
        weights.round_to_half();
        let rounded = weights.get("weight", [1, 2, 2]).expect("the matrix");
        assert!((rounded[0] - 0.1).abs() < 0.1 / 2048.0 && rounded[0] != 0.1, "{rounded:?}");
        assert_eq!(rounded[1..], [0.0, -3.0, 0.0]);
        assert_eq!(weights.get("bias", [2, 1, 1]).expect("the bias"), [0.1, 1e-9]);
        assert_eq!(weights.get("large", [1, 2, 1]).expect("the matrix"), [0.1, 1e6]);
    }

    #[test]
    fn what_is_read_lies_in_its_range() {
        let mut weights = Weights::default();
        weights.insert_counts("steps", &[5]);
        weights.insert_counts("rng", &[0; 4]);
        weights.insert("scale", vec![1.0, 0.0], [1, 1, 2]);
        assert_eq!(weights.count("steps", 0..=5).expect("in range"), 5);
        let problem = weights.count("steps", 0..=4).expect_err("too large").to_string();
        assert_eq!(problem, "`steps` is 5; it must lie in 0..=4");
        assert!(weights.rng("rng").is_err());
        assert!(weights.get_within("scale", [1, 1, 2], 0.0..=1.0).is_ok());
        let problem = weights.get_within("scale", [1, 1, 2], 0.5..=1.0).expect_err("too small").to_string();
        assert_eq!(problem, "`scale` is 0.0; it must lie in 0.5..=1.0");
        // NaN is in no range.
        weights.insert("scale", vec![f32::NAN], [1, 1, 1]);
        assert!(weights.get_within("scale", [1, 1, 1], f32::MIN..=f32::MAX).is_err());
    }

    #[test]
    fn whole_numbers_move_with_their_prefix() {
        let mut agent = Weights::default();
        agent.insert_counts("rng", &[1, 2, 3, u64::MAX]);
        let mut all = Weights::default();
        all.absorb("agent.", &agent);
        assert_eq!(all.extract("agent."), agent);
        let problem = all.counts("agent.rng", 3).expect_err("four numbers").to_string();
        assert!(problem.contains("agent.rng") && problem.contains('4'), "{problem}");
    }
}
