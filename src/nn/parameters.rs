//! What learns: named parameters, and what is done with all of them at once.

use super::kernels;
use super::ops::{Tensor3, values, values_mut};

/// Something with named parameters, each `[members, rows, columns]`.
pub trait Parameters {
    /// The parameters, in a fixed order.
    fn parameters(&self) -> Vec<(String, &Tensor3)>;
    /// The same, to be changed.
    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)>;
}

/// Moves `target` towards `source`: `target <- (1 - rate) target + rate source`.
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
    polyak(target, source, 1.0);
}

pub(crate) fn under_names<T>(parts: impl IntoIterator<Item = (&'static str, Vec<(String, T)>)>) -> Vec<(String, T)> {
    let under = |(part, all): (&str, Vec<(String, T)>)| -> Vec<(String, T)> {
        all.into_iter().map(|(name, parameter)| (format!("{part}.{name}"), parameter)).collect()
    };
    parts.into_iter().flat_map(under).collect()
}

/// Makes a struct's parameters those of some of its fields, each under the field's name.
macro_rules! parameters_of_fields {
    ($type:ty: $($field:ident),*) => {
        impl $crate::nn::Parameters for $type {
            fn parameters(&self) -> Vec<(String, &$crate::nn::Tensor3)> {
                let parts = [$((stringify!($field), self.$field.parameters())),*];
                $crate::nn::parameters::under_names(parts)
            }

            fn parameters_mut(&mut self) -> Vec<(String, &mut $crate::nn::Tensor3)> {
                let parts = [$((stringify!($field), self.$field.parameters_mut())),*];
                $crate::nn::parameters::under_names(parts)
            }
        }
    };
}
pub(crate) use parameters_of_fields;
