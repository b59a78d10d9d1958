//! Checkpoints: named arrays in safetensors files, written so that a crash never leaves half a file.
//!
//! A checkpoint holds f32 arrays (weights, optimiser moments, replayed experience), u64 arrays (step counts, the states of
//! random number generators), and notes in the file's metadata.
//!
//! ```
//! use handful::checkpoint::Weights;
//! use handful::rng;
//!
//! let generator = rng::stream(0, "example");
//! let mut saved = Weights::default();
//! saved.insert("policy.0.bias", vec![0.5, -0.5], [1, 1, 2]);
//! saved.insert_counts("rng", &rng::state(&generator));
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("state.safetensors");
//! saved.write(&path)?;
//! let read = Weights::read(&path)?;
//! assert_eq!(read.get("policy.0.bias", [1, 1, 2])?, [0.5, -0.5]);
//! assert_eq!(rng::from_state(&read.counts("rng", 4)?), generator);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::collections::BTreeMap;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use crate::error::{Error, Result};
use crate::files;

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
    /// Adds an array in row-major order.
    ///
    /// # Panics
    /// If `shape` does not hold as many numbers.
    pub fn insert(&mut self, name: impl Into<String>, numbers: Vec<f32>, shape: [usize; 3]) {
        assert_eq!(numbers.len(), shape.iter().product::<usize>());
        self.arrays.insert(name.into(), (numbers, shape));
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

    /// The name of an array that holds NaN, if there is one.
    pub fn with_nan(&self) -> Option<&str> {
        let found = self.arrays.iter().find(|(_, (numbers, _))| numbers.iter().any(|x| x.is_nan()));
        found.map(|(name, _)| name.as_str())
    }

    /// Adds whole numbers, stored as a U64 tensor.
    pub fn insert_counts(&mut self, name: impl Into<String>, counts: &[u64]) {
        self.counts.insert(name.into(), counts.to_vec());
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

    /// Adds all arrays and whole numbers of `other`, with `prefix` before their names. Notes stay behind.
    pub fn absorb(&mut self, prefix: &str, other: &Self) {
        self.arrays.extend(other.arrays.iter().map(|(name, array)| (format!("{prefix}{name}"), array.clone())));
        self.counts.extend(other.counts.iter().map(|(name, counts)| (format!("{prefix}{name}"), counts.clone())));
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

    /// Writes a safetensors file; an existing one is replaced at once or not at all.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let arrays = self.arrays.iter().map(|(name, (numbers, shape))| {
            let view = TensorView::new(Dtype::F32, shape.to_vec(), bytemuck::cast_slice(numbers));
            (name, view.expect("shapes were checked when the array came in"))
        });
        let counts = self.counts.iter().map(|(name, counts)| {
            let view = TensorView::new(Dtype::U64, vec![counts.len()], bytemuck::cast_slice(counts));
            (name, view.expect("one number each"))
        });
        let bytes = safetensors::serialize(arrays.chain(counts), Some(self.notes.clone().into_iter().collect()))
            .map_err(|problem| {
                Error::checkpoint(path, format!("cannot be composed: {problem}"), Some(problem.into()))
            })?;
        files::write(path, &bytes)
    }

    /// Reads a safetensors file.
    ///
    /// # Errors
    /// If it cannot be read, is damaged, or holds anything but f32 arrays of three dimensions and u64 arrays of one.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
        let damaged = |problem: safetensors::SafeTensorError| {
            let advice = format!("damaged, or no safetensors file ({problem}); restore it or start the run anew");
            Error::checkpoint(path, advice, Some(problem.into()))
        };
        let file = SafeTensors::deserialize(&bytes).map_err(damaged)?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
        let notes = header.metadata().clone().unwrap_or_default().into_iter().collect();
        let mut weights = Self { notes, ..Self::default() };
        for (name, view) in file.tensors() {
            match (view.dtype(), view.shape()) {
                (Dtype::F32, &[members, rows, columns]) => {
                    weights.insert(name, bytemuck::pod_collect_to_vec(view.data()), [members, rows, columns]);
                }
                (Dtype::U64, &[_]) => {
                    weights.counts.insert(name, bytemuck::pod_collect_to_vec(view.data()));
                }
                _ => {
                    let advice = format!("`{name}` is not one of our arrays; is this file from another program?");
                    return Err(Error::checkpoint(path, advice, None));
                }
            }
        }
        Ok(weights)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As the first version wrote it, through a file.
    #[test]
    fn whole_numbers_of_old_checkpoints_are_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("state.safetensors");
        let counts = [u64::MAX, 0, 123_456_789_012_345];
        let parts = counts.iter().flat_map(|count| [0, 16, 32, 48].map(|shift| ((count >> shift) & 0xffff) as f32));
        let mut old = Weights::default();
        old.insert("agent.rng", parts.collect(), [1, counts.len(), 4]);
        old.write(&path).expect("a writable folder");
        let read = Weights::read(&path).expect("what was just written").extract("agent.");
        assert_eq!(read.counts("rng", 3).expect("three"), counts);
        assert!(read.counts("rng", 4).is_err() && read.counts("other", 3).is_err());
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
