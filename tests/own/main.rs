//! What a reader brings: environments, tasks for the arm, agents and planners written outside the crate enter everything, and
//! what breaks the contract is named.

mod agent;
mod contract;
mod mistakes;
mod task;
mod world;
