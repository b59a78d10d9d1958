//! Replay buffers: single transitions ([`ReplayBuffer`]), subsequences of experience ([`SequenceReplay`]), and recorded
//! episodes ([`Episode`]).
//!
//! ```
//! use handful::replay::{ReplayBuffer, SequenceReplay, Transition};
//!
//! // Observations of 2 numbers, actions of 1, at most 1000 transitions.
//! let mut buffer = ReplayBuffer::new(2, 1, 1000);
//! let mut sequences = SequenceReplay::new(2, 1, 1000);
//! for i in 0..10 {
//!     let transition = Transition {
//!         obs: vec![i as f32, 0.0],
//!         action: vec![0.5],
//!         reward: 1.0,
//!         next_obs: vec![i as f32 + 1.0, 0.0],
//!         terminated: false,
//!         truncated: i == 9,
//!     };
//!     buffer.push(&transition);
//!     sequences.push(&transition);
//! }
//! let mut rng = handful::rng::stream(0, "example");
//! let batch = buffer.sample(32, &mut rng);
//! assert_eq!((batch.size, batch.obs.len()), (32, 32 * 2));
//! // Ten steps have eleven observations; four subsequences of five time steps each.
//! assert_eq!(sequences.len(), 11);
//! let batch = sequences.sample(4, 5, &mut rng);
//! assert_eq!(batch.obs.len(), 5 * 4 * 2);
//! ```

mod episode;
mod sequence;
mod transition;

pub use episode::Episode;
pub use sequence::{SequenceBatch, SequenceReplay};
pub use transition::{Batch, ReplayBuffer, Row, Transition};

use crate::checkpoint::Weights;
use crate::error::{Error, Result};

/// The number of saved rows under a name.
///
/// # Errors
/// If there are none of that name, or more than fit into a buffer of this capacity.
fn fitting(weights: &Weights, name: &str, capacity: usize) -> Result<usize> {
    match weights.shape(name)? {
        [_, count, _] if count > capacity => {
            Err(Error::Config(format!("`{name}` has {count} rows; they do not fit into a replay buffer of {capacity}")))
        }
        [_, count, _] => Ok(count),
    }
}
