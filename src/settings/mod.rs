//! The settings of agents, models and planners: the range of every number, declared once, and how one table of settings is
//! put over another.
//!
//! A range is declared beside the settings, checked before anything is made of them, and shown in their documentation. The
//! first field that lies outside is named by its full path:
//!
//! ```
//! use handful::agent::{PetsConfig, Preset};
//! use handful::settings::Ranges;
//!
//! let mut config = PetsConfig::preset("pets")?;
//! config.ensemble.learning_rate = f32::NAN;
//! let problem = config.check_at("pets").unwrap_err().to_string();
//! assert_eq!(problem, "`pets.ensemble.learning_rate` is NaN; it must lie in 0.0..=1.0");
//! # Ok::<(), handful::error::Error>(())
//! ```

mod choices;
mod merge;

use std::fmt::Debug;
use std::ops::RangeInclusive;

pub(crate) use choices::choices;
pub(crate) use merge::{check_choices, merge, value_at};

use crate::error::{Error, Result};

/// Layers that a list of widths may name.
const LAYERS: RangeInclusive<usize> = 1..=16;

/// Numbers that one array may hold: a gigabyte of them.
pub(crate) const MAX_NUMBERS: usize = 1 << 28;

/// Settings of which every number has a range.
pub trait Ranges {
    /// Checks every number, and what numbers have to do with each other. `path` is where the settings stand: `"sac"`.
    ///
    /// # Errors
    /// [`Error::Config`] names the first field outside its range by its full path, with its value and its range.
    fn check_at(&self, path: &str) -> Result<()>;
}

/// What is asked of a field of the type `T`.
pub(crate) trait Rule<T> {
    fn check(&self, path: &str, value: &T) -> Result<()>;
}

/// A field that is not a number: every value of its type is valid.
pub(crate) struct Any;

/// Settings with ranges of their own.
pub(crate) struct Nested;

impl<T> Rule<T> for Any {
    fn check(&self, _path: &str, _value: &T) -> Result<()> {
        Ok(())
    }
}

impl<T: Ranges> Rule<T> for Nested {
    fn check(&self, path: &str, value: &T) -> Result<()> {
        value.check_at(path)
    }
}

impl<T: Ranges> Rule<Option<T>> for Nested {
    fn check(&self, path: &str, value: &Option<T>) -> Result<()> {
        value.as_ref().map_or(Ok(()), |value| value.check_at(path))
    }
}

/// What a range can be of.
pub(crate) trait Number: PartialOrd + Debug {}

impl Number for usize {}
impl Number for u32 {}
impl Number for f32 {}
impl Number for f64 {}

impl<N: Number> Rule<N> for RangeInclusive<N> {
    fn check(&self, path: &str, value: &N) -> Result<()> {
        // NaN lies in no range.
        if self.contains(value) {
            return Ok(());
        }
        Err(Error::Config(format!("`{path}` is {value:?}; it must lie in {self:?}")))
    }
}

impl<N: Number> Rule<Option<N>> for RangeInclusive<N> {
    fn check(&self, path: &str, value: &Option<N>) -> Result<()> {
        value.as_ref().map_or(Ok(()), |value| self.check(path, value))
    }
}

/// The widths of layers.
impl<N: Number> Rule<Vec<N>> for RangeInclusive<N> {
    fn check(&self, path: &str, value: &Vec<N>) -> Result<()> {
        if !LAYERS.contains(&value.len()) {
            return Err(Error::Config(format!("`{path}` has {} layers; it must have {LAYERS:?}", value.len())));
        }
        value.iter().enumerate().try_for_each(|(i, width)| self.check(&format!("{path}[{i}]"), width))
    }
}

/// For constructors that do not return a `Result`.
///
/// # Panics
/// If a setting lies outside its range.
pub(crate) fn must_hold(settings: &impl Ranges, path: &str) {
    settings.check_at(path).unwrap_or_else(|problem| panic!("{problem}"));
}

/// A path one level further down.
pub(crate) fn below(path: &str, field: &str) -> String {
    if path.is_empty() { field.into() } else { format!("{path}.{field}") }
}

/// Whether an array of these sizes fits into memory.
pub(crate) fn fits(sizes: &[usize]) -> bool {
    sizes.iter().fold(1_usize, |product, size| product.saturating_mul(*size)) <= MAX_NUMBERS
}

/// Weights between layers of these widths.
pub(crate) fn weights_between(widths: &[usize]) -> usize {
    widths.windows(2).map(|pair| pair[0] * pair[1]).sum()
}

/// Implements [`Ranges`] from one declaration: a range for each field, then what the fields have to do with each other.
/// For an enum, the range of each variant's content, beside the variant's name in a file.
macro_rules! ranges {
    ($type:ident { $($field:ident: $rule:expr),+ $(,)? } $(require $condition:expr => $says:literal;)*) => {
        /// | field | range |
        /// | --- | --- |
        $(#[doc = concat!("| `", stringify!($field), "` | `", stringify!($rule), "` |")])+
        ///
        $(#[doc = concat!("- ", $says)])*
        impl $crate::settings::Ranges for $type {
            fn check_at(&self, path: &str) -> $crate::error::Result<()> {
                #[allow(unused_imports)]
                use $crate::settings::{Any, Nested, Rule, below};
                let Self { $($field,)+ } = self;
                $(Rule::check(&($rule), &below(path, stringify!($field)), $field)?;)+
                $(let holds = $condition;
                if !holds {
                    return Err($crate::error::Error::Config(format!("`{path}`: {}", $says)));
                })*
                Ok(())
            }
        }
    };
    (enum $type:ident { $($unit:ident,)* $($name:literal $variant:ident: $rule:expr),+ $(,)? }) => {
        /// | variant | range |
        /// | --- | --- |
        $(#[doc = concat!("| `", $name, "` | `", stringify!($rule), "` |")])+
        impl $crate::settings::Ranges for $type {
            fn check_at(&self, path: &str) -> $crate::error::Result<()> {
                #[allow(unused_imports)]
                use $crate::settings::{Nested, Rule, below};
                match self {
                    $(Self::$unit => Ok(()),)*
                    $(Self::$variant(content) => Rule::check(&($rule), &below(path, $name), content),)+
                }
            }
        }
    };
}
pub(crate) use ranges;
