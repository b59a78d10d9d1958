//! Weights in and out: safetensors files, written so that a crash never leaves half a file.

use std::collections::BTreeMap;
use std::path::Path;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use super::{Parameters, Tensor3, values};
use crate::error::{Error, Result};
use crate::files;

/// Named arrays of f32 with three sizes each, and named notes beside them.
#[derive(Clone, Debug, Default)]
pub struct Weights {
    arrays: BTreeMap<String, (Vec<f32>, [usize; 3])>,
    notes: BTreeMap<String, String>,
}

impl Weights {
    /// Adds an array.
    pub fn insert(&mut self, name: impl Into<String>, numbers: Vec<f32>, shape: [usize; 3]) {
        assert_eq!(numbers.len(), shape.iter().product::<usize>());
        self.arrays.insert(name.into(), (numbers, shape));
    }

    /// Adds every parameter of a module, under `prefix`.
    pub fn insert_module(&mut self, prefix: &str, module: &impl Parameters) {
        for (name, parameter) in module.parameters() {
            self.insert(format!("{prefix}.{name}"), values(parameter).to_vec(), sizes(parameter));
        }
    }

    /// The array of that name and shape.
    ///
    /// # Errors
    /// If it is missing or has another shape.
    pub fn get(&self, name: &str, shape: [usize; 3]) -> Result<&[f32]> {
        match self.arrays.get(name) {
            None => Err(Error::BadSetting(format!("the weights have no `{name}`"))),
            Some((_, other)) if *other != shape => {
                Err(Error::BadSetting(format!("`{name}` has the sizes {other:?} where {shape:?} are expected")))
            }
            Some((numbers, _)) => Ok(numbers),
        }
    }

    /// The sizes of an array.
    ///
    /// # Errors
    /// If there is none of that name.
    pub fn shape(&self, name: &str) -> Result<[usize; 3]> {
        let found = self.arrays.get(name).map(|(_, shape)| *shape);
        found.ok_or_else(|| Error::BadSetting(format!("the weights have no `{name}`")))
    }

    /// Adds all arrays of `other`, with `prefix` before their names.
    pub fn absorb(&mut self, prefix: &str, other: &Self) {
        let arrays = other.arrays.iter();
        self.arrays.extend(arrays.map(|(name, array)| (format!("{prefix}{name}"), array.clone())));
    }

    /// The arrays whose names begin with `prefix`, without it.
    pub fn extract(&self, prefix: &str) -> Self {
        let arrays = self.arrays.iter();
        let arrays = arrays.filter_map(|(name, array)| Some((name.strip_prefix(prefix)?.into(), array.clone())));
        Self { arrays: arrays.collect(), ..Self::default() }
    }

    /// Adds a note.
    pub fn set_note(&mut self, name: impl Into<String>, text: String) {
        self.notes.insert(name.into(), text);
    }

    /// The note of that name.
    pub fn note(&self, name: &str) -> Option<&str> {
        self.notes.get(name).map(String::as_str)
    }

    /// Adds whole numbers, kept exactly: 16 bits in each f32.
    pub fn insert_counts(&mut self, name: impl Into<String>, counts: &[u64]) {
        let parts = counts.iter().flat_map(|count| [0, 16, 32, 48].map(|shift| ((count >> shift) & 0xffff) as f32));
        self.insert(name, parts.collect(), [1, counts.len(), 4]);
    }

    /// Reads what [`Weights::insert_counts`] wrote.
    ///
    /// # Errors
    /// If it is missing or not so many numbers.
    pub fn counts(&self, name: &str, how_many: usize) -> Result<Vec<u64>> {
        let parts = self.get(name, [1, how_many, 4])?;
        let joined = parts.chunks(4).map(|p| (0..4).map(|i| (p[i] as u64) << (16 * i)).sum());
        Ok(joined.collect())
    }

    /// Gives a module the parameters stored under `prefix`. On an error nothing has changed.
    ///
    /// # Errors
    /// If a parameter is missing or has another shape.
    pub fn load_module(&self, prefix: &str, module: &mut impl Parameters) -> Result<()> {
        for (name, parameter) in module.parameters() {
            self.get(&format!("{prefix}.{name}"), sizes(parameter))?;
        }
        for (name, parameter) in module.parameters_mut() {
            let shape = sizes(parameter);
            parameter.copy_from(self.get(&format!("{prefix}.{name}"), shape)?);
        }
        Ok(())
    }

    /// Writes a safetensors file; an existing one is replaced at once or not at all.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        let views = self.arrays.iter().map(|(name, (numbers, shape))| {
            let view = TensorView::new(Dtype::F32, shape.to_vec(), bytemuck::cast_slice(numbers));
            (name, view.expect("sizes were checked when the array came in"))
        });
        let bytes = safetensors::serialize(views, Some(self.notes.clone().into_iter().collect()))
            .map_err(|problem| Error::bad_file(path, format!("cannot be composed: {problem}")))?;
        files::write(path, &bytes)
    }

    /// Reads a safetensors file.
    ///
    /// # Errors
    /// If it cannot be read, is damaged, or holds anything but f32 arrays of three sizes.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
        let file = SafeTensors::deserialize(&bytes).map_err(|problem| {
            Error::bad_file(
                path,
                format!("damaged, or no safetensors file ({problem}); restore it or start the run anew"),
            )
        })?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|problem| Error::bad_file(path, problem))?;
        let notes = header.metadata().clone().unwrap_or_default().into_iter().collect();
        let mut weights = Self { notes, ..Self::default() };
        for (name, view) in file.tensors() {
            let shape: [usize; 3] = match (view.dtype(), view.shape().try_into()) {
                (Dtype::F32, Ok(shape)) => shape,
                _ => {
                    return Err(Error::bad_file(
                        path,
                        format!("`{name}` is not one of our arrays; is this file from another program?"),
                    ));
                }
            };
            weights.insert(name, bytemuck::pod_collect_to_vec(view.data()), shape);
        }
        Ok(weights)
    }
}

fn sizes(parameter: &Tensor3) -> [usize; 3] {
    use dfdx::shapes::HasShape;
    let &(members, rows, columns) = parameter.shape();
    [members, rows, columns]
}
