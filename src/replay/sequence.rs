//! Experience in the order of time, drawn in subsequences: what recurrent models learn from.

use rand::RngExt;

use super::Transition;
use crate::checkpoint::Weights;
use crate::error::Result;
use crate::rng::Rng;

/// A moment of an episode, as sequence models see it: what was observed, and what had come of it so far.
#[derive(Clone, Copy, Debug)]
struct Flags {
    first: bool,
    last: bool,
    terminal: bool,
}

/// Pieces of experience, `length` moments of `sequences` stretches: numbers of one moment stand together, the moments one
/// after the other (`[length, sequences, ...]`). A stretch may begin and end anywhere, and may hold the end of one episode
/// and the beginning of the next.
#[derive(Clone, Debug, Default)]
pub struct SequenceBatch {
    /// Stretches side by side.
    pub sequences: usize,
    /// Moments in each.
    pub length: usize,
    /// What was observed.
    pub obs: Vec<f32>,
    /// What was done there; zeros at the end of an episode.
    pub actions: Vec<f32>,
    /// The reward for having arrived there; zero at the start of an episode.
    pub rewards: Vec<f32>,
    /// Whether an episode starts there.
    pub first: Vec<bool>,
    /// Whether an episode ends there, by the clock or by itself.
    pub last: Vec<bool>,
    /// Whether the task itself ends there.
    pub terminal: Vec<bool>,
}

impl SequenceBatch {
    /// The last `moments` of each stretch.
    pub fn last(&self, moments: usize) -> Self {
        let rows = moments * self.sequences;
        fn end<T: Clone>(all: &[T], rows: usize, of: usize) -> Vec<T> {
            all[all.len() - all.len() / of * rows..].to_vec()
        }
        let of = self.length * self.sequences;
        Self {
            sequences: self.sequences,
            length: moments,
            obs: end(&self.obs, rows, of),
            actions: end(&self.actions, rows, of),
            rewards: end(&self.rewards, rows, of),
            first: end(&self.first, rows, of),
            last: end(&self.last, rows, of),
            terminal: end(&self.terminal, rows, of),
        }
    }
}

/// All experience, in the order of time.
#[derive(Clone, Debug)]
pub struct SequenceReplay {
    observation_size: usize,
    action_size: usize,
    capacity: usize,
    /// One row a moment: obs, action, reward, first, last, terminal.
    rows: Vec<f32>,
    /// Where the oldest row stands, once the buffer is full.
    oldest: usize,
    /// The reward for arriving at the moment that comes next; none at the start of an episode.
    arrived: Option<f32>,
}

impl SequenceReplay {
    /// A buffer for `capacity` moments.
    pub fn new(observation_size: usize, action_size: usize, capacity: usize) -> Self {
        Self { observation_size, action_size, capacity, rows: Vec::new(), oldest: 0, arrived: None }
    }

    fn width(&self) -> usize {
        self.observation_size + self.action_size + 4
    }

    /// Moments held: one more than steps in each episode.
    pub fn len(&self) -> usize {
        self.rows.len() / self.width()
    }

    /// Whether it holds none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Adds a step of the present episode.
    ///
    /// # Panics
    /// If observation or action have the wrong length.
    pub fn push(&mut self, t: &Transition) {
        assert!(t.obs.len() == self.observation_size && t.action.len() == self.action_size, "sizes of this buffer");
        let first = self.arrived.is_none();
        let reward = self.arrived.unwrap_or(0.0);
        self.push_moment(&t.obs, &t.action, reward, Flags { first, last: false, terminal: false });
        self.arrived = Some(t.reward);
        if t.terminated || t.truncated {
            let rest = vec![0.0; self.action_size];
            self.push_moment(&t.next_obs, &rest, t.reward, Flags { first: false, last: true, terminal: t.terminated });
            self.arrived = None;
        }
    }

    fn push_moment(&mut self, obs: &[f32], action: &[f32], reward: f32, flags: Flags) {
        let flags = [flags.first, flags.last, flags.terminal].map(f32::from);
        let row = obs.iter().chain(action).chain([&reward]).chain(&flags).copied();
        if self.len() < self.capacity {
            self.rows.extend(row);
        } else {
            let width = self.width();
            let old = &mut self.rows[self.oldest * width..][..width];
            old.iter_mut().zip(row).for_each(|(old, new)| *old = new);
            self.oldest = (self.oldest + 1) % self.capacity;
        }
    }

    /// Draws stretches of `length` moments, each start as likely as any other.
    ///
    /// # Panics
    /// If there are not so many moments.
    pub fn sample(&self, sequences: usize, length: usize, rng: &mut Rng) -> SequenceBatch {
        assert!(self.len() >= length && length > 0, "enough to draw from");
        let (count, width) = (self.len(), self.width());
        let starts: Vec<usize> = (0..sequences).map(|_| rng.random_range(0..=count - length)).collect();
        let row = |i: usize| &self.rows[(self.oldest + i) % count * width..][..width];
        let mut batch = SequenceBatch { sequences, length, ..SequenceBatch::default() };
        for t in 0..length {
            for start in &starts {
                let (obs, rest) = row(start + t).split_at(self.observation_size);
                let (action, rest) = rest.split_at(self.action_size);
                let [reward, first, last, terminal] = rest else { unreachable!("four numbers") };
                // An episode that a crash cut short has no last moment; what follows it begins anew.
                let cut = start + t + 1 < count && row(start + t + 1)[width - 3] > 0.5;
                batch.obs.extend(obs);
                batch.actions.extend(action);
                batch.rewards.push(*reward);
                batch.first.push(*first > 0.5);
                batch.last.push(*last > 0.5 || cut);
                batch.terminal.push(*terminal > 0.5);
            }
        }
        batch
    }

    /// Writes the buffer into `weights`, under `prefix`.
    pub fn save(&self, weights: &mut Weights, prefix: &str) {
        weights.insert(format!("{prefix}.rows"), self.rows.clone(), [1, self.len(), self.width()]);
        weights.insert_counts(format!("{prefix}.oldest"), &[self.oldest as u64]);
    }

    /// Reads what [`SequenceReplay::save`] wrote; the present episode starts anew.
    ///
    /// # Errors
    /// If it is missing, or of moments of other sizes.
    pub fn load(&mut self, weights: &Weights, prefix: &str) -> Result<()> {
        let name = format!("{prefix}.rows");
        let [_, count, _] = weights.shape(&name)?;
        let rows = weights.get(&name, [1, count, self.width()])?.to_vec();
        self.oldest = weights.counts(&format!("{prefix}.oldest"), 1)?[0] as usize;
        self.rows = rows;
        self.arrived = None;
        Ok(())
    }
}
