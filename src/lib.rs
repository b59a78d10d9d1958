pub mod env;
pub mod error;
pub mod rng;
