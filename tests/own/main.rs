//! What a reader brings: environments, tasks for the arm, agents and planners written outside the crate enter everything, and
//! what breaks the contract is named.

mod contract;
mod task;
mod world;
