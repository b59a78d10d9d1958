//! Checkpoints as files: safetensors, with a checksum.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::Weights;
use crate::error::{Cause, Error, Result};
use crate::files;

/// The one entry of a file's metadata, an [`Envelope`] in JSON. (Several entries would be written in random order, and two
/// equal checkpoints would be two different files.)
const ENVELOPE: &str = "handful";

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
        let arrays = self.arrays.iter().map(|(name, (numbers, shape))| {
            let view = TensorView::new(Dtype::F32, shape.to_vec(), bytemuck::cast_slice(numbers));
            (name, view.expect("shapes were checked when the array came in"))
        });
        let counts = self.counts.iter().map(|(name, counts)| {
            let view = TensorView::new(Dtype::U64, vec![counts.len()], bytemuck::cast_slice(counts));
            (name, view.expect("one number each"))
        });
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
    /// If it cannot be read, is damaged, or holds NaN or anything but f32 arrays of three dimensions and u64 arrays of one.
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
        saved.insert("policy.bias", vec![0.5, -0.5], [1, 1, 2]);
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
