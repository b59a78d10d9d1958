//! Model-based reinforcement learning in Rust, on a robot arm that has to move things with its hand.
//!
//! # Train and evaluate
//!
//! An [`agent::Agent`] acts, observes and updates; an [`env::Env`] is reset and stepped; an
//! [`study::evaluate::Evaluator`] measures any agent in any environment by one protocol.
//!
//! ```
//! use handful::prelude::*;
//!
//! let mut env = Task::Pendulum.make();
//! let config = SacConfig { hidden: vec![32], warm_up: 100, ..SacConfig::preset("sac")? };
//! let mut agent = Sac::new(env.spec(), config, 0)?;
//! let mut obs = env.reset(0);
//! agent.begin_episode();
//! for seed in 1..=300 {
//!     let action = agent.act(&obs, Mode::Explore);
//!     let Step { observation, reward, terminated, truncated, .. } = env.step(&action)?;
//!     let next_obs = observation.clone();
//!     agent.observe(&Transition { obs, action, reward, next_obs, terminated, truncated });
//!     agent.update();
//!     obs = observation;
//!     if terminated || truncated {
//!         obs = env.reset(seed);
//!         agent.begin_episode();
//!     }
//! }
//! let mut evaluator = Evaluator::new(|| Ok(Task::Pendulum.make()))?;
//! let summary = evaluator.evaluate(&mut agent, 10, EvalSeeds::Test)?.summary();
//! assert!(summary.return_mean < 0.0 && summary.episodes == 10);
//! # Ok::<(), handful::error::Error>(())
//! ```
//!
//! # Bring an environment of your own
//!
//! Implement [`env::Env`]; every agent trains on it and the evaluator measures it. With [`env::KnownReward`] PETS need
//! not learn the reward, with [`env::Snapshot`] the oracle plans in it, and with a [`study::registry::Registry`] it
//! enters the command line: train, resume, evaluate, study, report, watch. `examples/own_world.rs` shows all of it.
//!
//! ```
//! use handful::{prelude::*, rng};
//!
//! /// A point on a line that has to come to zero.
//! struct Line { spec: Spec, x: f32, elapsed: usize }
//!
//! impl Env for Line {
//!     fn spec(&self) -> &Spec { &self.spec }
//!     fn reset(&mut self, seed: u64) -> Vec<f32> {
//!         (self.x, self.elapsed) = (rng::uniform(&mut rng::stream(seed, "line"), -1.0, 1.0) as f32, 0);
//!         vec![self.x]
//!     }
//!     fn step(&mut self, action: &[f32]) -> Result<Step> {
//!         self.spec.check_action(action)?;
//!         self.x += 0.2 * action[0].clamp(-1.0, 1.0);
//!         self.elapsed += 1;
//!         let step = Step::new(vec![self.x], -self.x.abs());
//!         Ok(step.success(self.x.abs() < 0.1).truncated(self.elapsed >= self.spec.horizon))
//!     }
//! }
//!
//! let spec = Spec::new("line", [Feature::new("x")], 1, 20, 0.1);
//! let make = || Ok(Line { spec: spec.clone(), x: 0.0, elapsed: 0 });
//! let mut homing = Scripted::new(|obs| vec![(-5.0 * obs[0]).clamp(-1.0, 1.0)]);
//! let summary = Evaluator::new(make)?.evaluate(&mut homing, 20, EvalSeeds::Test)?.summary();
//! assert_eq!(summary.success, 1.0);
//! # Ok::<(), handful::error::Error>(())
//! ```
//!
//! # A map of the crate
//!
//! A module uses only its own layer and the layers below it; `tests/layering.rs` enforces that.
//!
//! | layer | module | what is in it |
//! | --- | --- | --- |
//! | 4 | `cli` | the command line, for any registry (feature `cli`) |
//! | 3 | [`study`] | evaluation protocol, runs, registry, statistics, tables, figures, reports |
//! | 3 | [`watch`] | an episode as a 3D replay in one HTML file |
//! | 2 | [`agent`] | agents: the wiring of what is below |
//! | 2 | [`diff`] | differentiable simulators, iLQR, analytic policy gradients, system identification |
//! | 1 | [`plan`] | random shooting, CEM, iCEM, MPPI with and without a guide, gradient ascent; receding-horizon control |
//! | 1 | [`model`] | learned models: probabilistic ensembles, latent world models with and without a decoder, imagination |
//! | 1 | [`replay`] | transitions, episodes, replay buffers |
//! | 0 | [`env`](mod@env) | environments: the arm at its table, pendulum, cart-pole |
//! | 0 | [`nn`] | networks, distributions, optimisers, on dfdx |
//! | 0 | [`checkpoint`], [`rng`], [`files`], [`settings`], [`error`] | weights in files, random numbers, files that are written whole, ranges of settings, errors |
//! | 0 | `chart` | charts for chapters, examples and reports (feature `figures`) |
//!
//! Invariants:
//! - Agents, evaluation, runs, replays and the study know an environment by its traits alone.
//! - A planner never sees an environment: it maximises a closure.
//! - No global generator: random numbers come from streams that follow from a seed and a purpose ([`rng::stream`]). One seed
//!   fixes a run bit for bit, with any number of threads, with AVX2 and with AVX-512.
//! - Lengths are metres, angles radians, times seconds, unless a name says otherwise.
//! - What can fail returns an [`error::Error`]; a function panics only where its documentation says so, or where tensors or slices
//!   that it is given do not fit together.
#![warn(missing_debug_implementations, missing_docs)]

pub mod agent;
#[cfg(feature = "figures")]
pub mod chart;
pub mod checkpoint;
#[cfg(feature = "cli")]
pub mod cli;
pub mod diff;
pub mod env;
pub mod error;
pub mod files;
pub mod model;
pub mod nn;
pub mod plan;
pub mod replay;
pub mod rng;
pub mod settings;
pub mod study;
pub mod watch;

/// Vectors, matrices and rotations: the crate that poses, Jacobians and differentiable systems here are made of.
pub use nalgebra;

/// What most programs that use this crate need.
pub mod prelude {
    pub use crate::agent::{
        Agent, Checkpoint, Diagnostics, Dreamer, DreamerConfig, Losses, Method, Mode, Oracle, OracleConfig, Pets,
        PetsConfig, Policy, Preset, Random, Sac, SacConfig, Scripted, Slot, Slots, TdMpc2, TdMpc2Config,
    };
    pub use crate::env::tabletop::TableOptions;
    pub use crate::env::vector::VectorEnv;
    pub use crate::env::{Env, Feature, KnownReward, Snapshot, Spec, Step, Task, World};
    pub use crate::error::{Error, Result};
    pub use crate::model::{
        Ensemble, EnsembleConfig, Imagination, ImplicitConfig, ImplicitModel, Propagation, WorldModel, WorldModelConfig,
    };
    pub use crate::plan::{
        ActionSequences, CemConfig, ControlConfig, GuidedConfig, IcemConfig, MppiConfig, Objective, Planner,
        PlannerConfig, RecedingHorizon,
    };
    pub use crate::replay::{ReplayBuffer, Transition};
    pub use crate::study::evaluate::{EvalSeeds, Evaluator};
    pub use crate::study::registry::{EnvEntry, NoOptions, Registry};
}
