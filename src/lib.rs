//! Model-based reinforcement learning in Rust, on a robot arm that has to move things with its hand.
//!
//! A map of the house. A floor uses only the floors below it.
//!
//! | floor | module | what lives there |
//! | --- | --- | --- |
//! | 3 | [`study`] | runs, the protocol by which agents are judged, tables, figures, reports |
//! | 3 | [`watch`] | an episode as a 3D replay in one HTML file |
//! | 3 | `chart` | charts for chapters and examples (feature `figures`) |
//! | 2 | [`agent`] | agents: the wiring of what stands below |
//! | 1 | [`plan`] | random shooting, CEM, iCEM, MPPI, gradients: optimisers of a closure over action sequences |
//! | 1 | [`model`] | what was learned of the world: probabilistic ensembles, latent worlds, and imagination in both |
//! | 1 | [`replay`] | what was experienced |
//! | 0 | [`nn`] | networks, distributions, optimisers, on dfdx |
//! | 0 | [`env`](mod@env) | worlds to act in: the arm at its table, pendulum, cart-pole |
//! | 0 | [`diff`] | simulators that can be differentiated, and trajectories optimised with their gradients |
//! | 0 | [`rng`], [`files`], [`error`] | random numbers, files that are written whole, what can go wrong |
//!
//! What holds everywhere:
//! - Agents know an environment by the trait [`env::Env`] alone; so does the study. The one exception is the
//!   oracle, which plans on the true world and says so.
//! - A planner never sees an environment: it maximises a closure.
//! - No global state: every random number comes from a generator that was passed in, and one seed
//!   fixes a run bit for bit on one machine.
//! - Lengths are metres, angles radians, times seconds, unless a name says otherwise.
//! - Libraries return [`error::Error`]s; a panic is a bug.
//!
//! # An agent on an environment of your own
//!
//! ```
//! use handful::prelude::*;
//!
//! /// A point on a line that has to come to zero.
//! struct Line { spec: Spec, x: f32, elapsed: usize }
//!
//! impl Env for Line {
//!     fn spec(&self) -> &Spec { &self.spec }
//!     fn reset(&mut self, seed: u64) -> Vec<f32> {
//!         (self.x, self.elapsed) = (seed as f32 % 3.0 - 1.0, 0);
//!         vec![self.x]
//!     }
//!     fn step(&mut self, action: &[f32]) -> Result<Step> {
//!         self.spec.check_action(action)?;
//!         self.x += 0.2 * action[0].clamp(-1.0, 1.0);
//!         self.elapsed += 1;
//!         let success = self.x.abs() < 0.1;
//!         let truncated = self.elapsed >= self.spec.horizon;
//!         Ok(Step::new(vec![self.x], -self.x.abs()).truncated(truncated).success(success))
//!     }
//! }
//!
//! let spec = Spec::new("line", [Feature::new("x")], 1, 20, 0.1);
//! let mut env = Line { spec, x: 0.0, elapsed: 0 };
//! let config = SacConfig { hidden: vec![32], warm_up: 100, ..SacConfig::default() };
//! let mut agent = Sac::new(env.spec(), config, 0)?;
//! let mut obs = env.reset(0);
//! for i in 1..=300 {
//!     let action = agent.act(&obs, Mode::Explore);
//!     let Step { observation, reward, terminated, truncated, .. } = env.step(&action)?;
//!     agent.observe(&Transition { obs, action, reward, next_obs: observation.clone(), terminated, truncated });
//!     agent.update();
//!     obs = if terminated || truncated { env.reset(i) } else { observation };
//! }
//! # Ok::<(), handful::error::Error>(())
//! ```
#![warn(missing_docs)]

pub mod agent;
#[cfg(feature = "figures")]
pub mod chart;
pub mod diff;
pub mod env;
pub mod error;
pub mod files;
pub mod model;
pub mod nn;
pub mod plan;
pub mod replay;
pub mod rng;
pub mod study;
pub mod watch;

/// Vectors, matrices and rotations: the crate that poses, Jacobians and differentiable systems here are made of.
pub use nalgebra;

/// What most programs that use this crate need.
pub mod prelude {
    pub use crate::agent::{
        Agent, Losses, Mode, Oracle, OracleConfig, Pets, PetsConfig, Random, Sac, SacConfig, Scripted, Slot,
    };
    pub use crate::env::tabletop::TableOptions;
    pub use crate::env::vector::VectorEnv;
    pub use crate::env::{Env, Feature, KnownReward, Snapshot, Spec, Step, Task, World};
    pub use crate::error::{Error, Result};
    pub use crate::replay::{ReplayBuffer, Transition};
    pub use crate::study::evaluate::{EvalSeeds, Evaluator};
}
