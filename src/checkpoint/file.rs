//! Checkpoints as files: safetensors, with a checksum.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use half::f16;
use half::slice::HalfFloatSliceExt;
use safetensors::View;
use safetensors::tensor::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

use super::Weights;
use crate::error::{Cause, Error, Result};
use crate::files;

#[cfg(target_endian = "big")]
compile_error!("safetensors files are little-endian, and arrays are read and written as they lie in memory");

/// The one entry of a file's metadata, an [`Envelope`] in JSON. (Several entries would be written in random order, and two
/// equal checkpoints would be two different files.)
const ENVELOPE: &str = "handful";

/// An array as it is stored.
struct Tensor<'a> {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Cow<'a, [u8]>,
}

impl<'a> Tensor<'a> {
    /// In half precision if that is exact.
    fn of_numbers(numbers: &'a [f32], shape: [usize; 3]) -> Self {
        let exact = |x: &f32| f16::from_f32(*x).to_f32().to_bits() == x.to_bits();
        let (dtype, bytes) = if numbers.iter().all(exact) {
            let bytes = numbers.iter().flat_map(|x| f16::from_f32(*x).to_ne_bytes()).collect();
            (Dtype::F16, Cow::Owned(bytes))
        } else {
            (Dtype::F32, Cow::Borrowed(bytemuck::cast_slice(numbers)))
        };
        Self { dtype, shape: shape.to_vec(), bytes }
    }

    fn of_counts(counts: &'a [u64]) -> Self {
        Self { dtype: Dtype::U64, shape: vec![counts.len()], bytes: Cow::Borrowed(bytemuck::cast_slice(counts)) }
    }
}

impl View for Tensor<'_> {
    fn dtype(&self) -> Dtype {
        self.dtype
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }

    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

/// What a file says about its arrays.
#[derive(Serialize, Deserialize)]
struct Envelope {
    /// [`Weights::checksum`].
    checksum: u32,
    notes: BTreeMap<String, String>,
}

impl Weights {
    /// CRC-32 of all names, sizes, numbers and notes, whatever their order and place in a file.
    fn checksum(&self) -> u32 {
        let mut hasher = crc32fast::Hasher::new();
        // Each part with its length, so that nothing can move from one part to the next.
        let mut part = |bytes: &[u8]| {
            hasher.update(&(bytes.len() as u64).to_le_bytes());
            hasher.update(bytes);
        };
        for (name, (numbers, shape)) in &self.arrays {
            part(name.as_bytes());
            shape.iter().for_each(|size| part(&(*size as u64).to_le_bytes()));
            part(bytemuck::cast_slice(numbers));
        }
        part(b"counts");
        for (name, counts) in &self.counts {
            part(name.as_bytes());
            part(bytemuck::cast_slice(counts));
        }
        part(b"notes");
        for (name, text) in &self.notes {
            part(name.as_bytes());
            part(text.as_bytes());
        }
        hasher.finalize()
    }

    /// Writes a safetensors file; an existing one is replaced at once or not at all.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let arrays = self.arrays.iter().map(|(name, (numbers, shape))| (name, Tensor::of_numbers(numbers, *shape)));
        let counts = self.counts.iter().map(|(name, counts)| (name, Tensor::of_counts(counts)));
        let envelope = Envelope { checksum: self.checksum(), notes: self.notes.clone() };
        let envelope = serde_json::to_string(&envelope).expect("numbers and texts are JSON");
        let metadata = HashMap::from([(ENVELOPE.into(), envelope)]);
        let bytes = safetensors::serialize(arrays.chain(counts), Some(metadata)).map_err(|problem| {
            Error::checkpoint(path, format!("cannot be composed: {problem}"), Some(problem.into()))
        })?;
        files::write(path, &bytes)
    }

    /// Reads a safetensors file.
    ///
    /// # Errors
    /// If it cannot be read, is damaged, or holds NaN or anything but f32 and f16 arrays of three dimensions and u64 arrays of one.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
        let damaged = |problem: Cause| {
            let advice = format!("damaged, or no checkpoint of ours ({problem}); restore it or start the run anew");
            Error::checkpoint(path, advice, Some(problem))
        };
        let file = SafeTensors::deserialize(&bytes).map_err(|problem| damaged(problem.into()))?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|problem| damaged(problem.into()))?;
        let mut weights = Self::default();
        for (name, view) in file.tensors() {
            match (view.dtype(), view.shape()) {
                (Dtype::F32, &[members, rows, columns]) => {
                    weights.insert(name, bytemuck::pod_collect_to_vec(view.data()), [members, rows, columns]);
                }
                (Dtype::F16, &[members, rows, columns]) => {
                    let halves: Vec<f16> = bytemuck::pod_collect_to_vec(view.data());
                    weights.insert(name, halves.to_f32_vec(), [members, rows, columns]);
                }
                (Dtype::U64, &[_]) => {
                    weights.counts.insert(name, bytemuck::pod_collect_to_vec(view.data()));
                }
                _ => return Err(damaged(format!("`{name}` has a type or shape that ours never have").into())),
            }
        }
        let mut metadata = header.metadata().clone().unwrap_or_default();
        match metadata.remove(ENVELOPE) {
            Some(envelope) => {
                let Envelope { checksum, notes } =
                    serde_json::from_str(&envelope).map_err(|problem| damaged(problem.into()))?;
                weights.notes = notes;
                if weights.checksum() != checksum {
                    return Err(damaged("its checksum is another".into()));
                }
            }
            // The first edition wrote no checksum, and one note.
            None if metadata.keys().all(|name| name == "progress") => weights.notes.extend(metadata),
            None => return Err(damaged("it has no checksum".into())),
        }
        match weights.with_nan() {
            Some(name) => Err(damaged(format!("`{name}` holds NaN").into())),
            None => Ok(weights),
        }
    }
}

#[cfg(test)]
mod tests {
    use safetensors::tensor::TensorView;

    use super::*;

    /// As the first version wrote it, through a file.
    #[test]
    fn whole_numbers_of_old_checkpoints_are_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("state.safetensors");
        let counts = [u64::MAX, 0, 123_456_789_012_345];
        let parts = counts.iter().flat_map(|count| [0, 16, 32, 48].map(|shift| ((count >> shift) & 0xffff) as f32));
        let parts: Vec<f32> = parts.collect();
        let view =
            TensorView::new(Dtype::F32, vec![1, counts.len(), 4], bytemuck::cast_slice(&parts)).expect("a tensor");
        let metadata = |name: &str| Some(HashMap::from([(name.to_string(), "step = 3".to_string())]));
        let old = |note| safetensors::serialize([("agent.rng", view.clone())], metadata(note));
        std::fs::write(&path, old("progress").expect("a file")).expect("a writable folder");
        let read = Weights::read(&path).expect("what was just written");
        assert_eq!(read.note("progress"), Some("step = 3"));
        let read = read.extract("agent.");
        assert_eq!(read.counts("rng", 3).expect("three"), counts);
        assert!(read.counts("rng", 4).is_err() && read.counts("other", 3).is_err());
        std::fs::write(&path, old("handfvl").expect("a file")).expect("a writable folder");
        assert!(Weights::read(&path).expect_err("a damaged name").to_string().contains("no checksum"));
    }

    /// Whatever is changed in a file, it is refused, or it is not a change of what it holds.
    #[test]
    fn damage_is_found() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("state.safetensors");
        let mut saved = Weights::default();
        saved.insert("policy.bias", vec![0.5, 0.1], [1, 1, 2]);
        saved.insert("policy.half", vec![0.5, -0.25], [1, 2, 1]);
        saved.insert_counts("steps", &[1000]);
        saved.set_note("progress", "step = 1000".into());
        saved.write(&path).expect("a writable folder");
        let whole = std::fs::read(&path).expect("what was just written");
        saved.write(&path).expect("a writable folder");
        assert_eq!(std::fs::read(&path).expect("the same again"), whole);
        for bit in 0..8 * whole.len() {
            let mut bytes = whole.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            std::fs::write(&path, &bytes).expect("a writable folder");
            match Weights::read(&path) {
                Ok(read) => assert_eq!(read, saved, "bit {bit}"),
                Err(problem) => assert!(matches!(problem, Error::Checkpoint { .. }), "{problem}"),
            }
        }
        for length in 0..whole.len() {
            std::fs::write(&path, &whole[..length]).expect("a writable folder");
            Weights::read(&path).expect_err("a part is not the whole");
        }
    }

    /// Every number that is exact in half precision comes back as it was; what is not exact is not stored in it.
    #[test]
    fn half_precision_loses_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("state.safetensors");
        let finite = (0..=u16::MAX).map(f16::from_bits).filter(|x| x.is_finite());
        let halves: Vec<f32> = finite.map(f32::from).collect();
        let shape = [1, halves.len(), 1];
        let mut weights = Weights::default();
        let mut write = |numbers: &[f32]| {
            weights.insert("numbers", numbers.to_vec(), shape);
            weights.write(&path).expect("a writable folder");
            let read = Weights::read(&path).expect("what was just written");
            let bits = |numbers: &[f32]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(read.get("numbers", shape).expect("the numbers")), bits(numbers));
            path.metadata().expect("a file").len()
        };
        let small = write(&halves);
        for inexact in [0.1, 1e-9, 1e6, f32::MIN_POSITIVE] {
            let mut numbers = halves.clone();
            numbers[7] = inexact;
            assert!(write(&numbers) > small + halves.len() as u64, "{inexact}");
        }
    }

    #[test]
    fn nothing_that_is_not_a_number_is_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("state.safetensors");
        let mut weights = Weights::default();
        weights.insert("scale", vec![1.0, f32::NAN], [1, 1, 2]);
        weights.write(&path).expect("a writable folder");
        let problem = Weights::read(&path).expect_err("NaN").to_string();
        assert!(problem.contains("`scale` holds NaN"), "{problem}");
    }
}
