//! Named parameters of modules, and operations on all of them at once.

use dfdx::shapes::HasShape;

use super::kernels;
use super::ops::{Tensor3, values, values_mut};
use crate::checkpoint::Weights;
use crate::error::Result;

/// A module with named parameters, each `[members, rows, columns]`.
pub trait Parameters {
    /// The parameters, in a fixed order.
    fn parameters(&self) -> Vec<(String, &Tensor3)>;
    /// The same, mutable.
    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)>;
}

/// A part that not every module has.
impl<P: Parameters> Parameters for Option<P> {
    fn parameters(&self) -> Vec<(String, &Tensor3)> {
        self.as_ref().map_or_else(Vec::new, Parameters::parameters)
    }

    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)> {
        self.as_mut().map_or_else(Vec::new, Parameters::parameters_mut)
    }
}

/// Polyak averaging, by which a target network follows its source: `target <- (1 - rate) target + rate source`.
#[doc(alias = "target network")]
#[doc(alias = "EMA")]
#[doc(alias = "soft update")]
pub fn polyak<P: Parameters>(target: &mut P, source: &P, rate: f32) {
    for ((_, target), (_, source)) in target.parameters_mut().into_iter().zip(source.parameters()) {
        kernels::vectorised(|| {
            for (t, s) in values_mut(target).iter_mut().zip(values(source)) {
                *t += rate * (s - *t);
            }
        });
    }
}

/// Gives `target` the parameters of `source`.
pub fn copy_parameters<P: Parameters>(target: &mut P, source: &P) {
    for ((_, target), (_, source)) in target.parameters_mut().into_iter().zip(source.parameters()) {
        values_mut(target).copy_from_slice(values(source));
    }
}

impl Weights {
    /// Adds every parameter of a module, named `prefix.parameter`.
    pub fn insert_module(&mut self, prefix: &str, module: &impl Parameters) {
        for (name, parameter) in module.parameters() {
            self.insert(format!("{prefix}.{name}"), values(parameter).to_vec(), sizes(parameter));
        }
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
}

fn sizes(parameter: &Tensor3) -> [usize; 3] {
    let &(members, rows, columns) = parameter.shape();
    [members, rows, columns]
}

pub(crate) fn under_names<T>(parts: impl IntoIterator<Item = (&'static str, Vec<(String, T)>)>) -> Vec<(String, T)> {
    let under = |(part, all): (&str, Vec<(String, T)>)| -> Vec<(String, T)> {
        all.into_iter().map(|(name, parameter)| (format!("{part}.{name}"), parameter)).collect()
    };
    parts.into_iter().flat_map(under).collect()
}

/// Makes a struct's parameters those of some of its fields, each under the field's name; `field as "name"` keeps another
/// name, under which checkpoints know it.
macro_rules! parameters_of_fields {
    ($type:ty: $($field:ident $(as $name:literal)?),*) => {
        impl $crate::nn::Parameters for $type {
            fn parameters(&self) -> Vec<(String, &$crate::nn::Tensor3)> {
                let parts = [$(($crate::nn::parameters::name_of!($field $($name)?), self.$field.parameters())),*];
                $crate::nn::parameters::under_names(parts)
            }

            fn parameters_mut(&mut self) -> Vec<(String, &mut $crate::nn::Tensor3)> {
                let parts = [$(($crate::nn::parameters::name_of!($field $($name)?), self.$field.parameters_mut())),*];
                $crate::nn::parameters::under_names(parts)
            }
        }
    };
}
pub(crate) use parameters_of_fields;

macro_rules! name_of {
    ($field:ident) => {
        stringify!($field)
    };
    ($field:ident $name:literal) => {
        $name
    };
}
pub(crate) use name_of;
