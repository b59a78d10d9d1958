//! Experience in the order of time, drawn in subsequences: what recurrent models learn from.

use rand::RngExt;

use super::{Transition, fitting};
use crate::checkpoint::{MAX_COUNT, Weights};
use crate::error::Result;
use crate::rng::Rng;

/// Where in an episode a time step is.
#[derive(Clone, Copy, Debug)]
struct Flags {
    first: bool,
    last: bool,
    terminal: bool,
}

/// A batch of subsequences of experience, time-major: every field is `[length, sequences, ...]`. A sequence may start and end
/// anywhere, and may contain the end of one episode and the start of the next.
///
/// As in DreamerV3, a time step holds an observation, the action taken *there*, and the reward for *arriving* there.
#[derive(Clone, Debug, Default)]
pub struct SequenceBatch {
    /// Sequences in parallel.
    pub sequences: usize,
    /// Time steps of each sequence.
    pub length: usize,
    /// Observations, `[length, sequences, observation]`.
    pub obs: Vec<f32>,
    /// Actions, `[length, sequences, action]`; zeros at the last time step of an episode.
    pub actions: Vec<f32>,
    /// Rewards for arriving at each time step, `[length, sequences]`; zero at the first time step of an episode.
    pub rewards: Vec<f32>,
    /// Whether an episode starts there (`is_first`), `[length, sequences]`.
    pub first: Vec<bool>,
    /// Whether an episode ends there (`is_last`), by the time limit or by itself, `[length, sequences]`.
    pub last: Vec<bool>,
    /// Whether the task itself ends there (`is_terminal`), `[length, sequences]`.
    pub terminal: Vec<bool>,
}

impl SequenceBatch {
    /// The last `length` time steps of each sequence.
    ///
    /// # Panics
    /// If the sequences are shorter.
    pub fn last(&self, length: usize) -> Self {
        let rows = length * self.sequences;
        fn end<T: Clone>(all: &[T], rows: usize, of: usize) -> Vec<T> {
            all[all.len() - all.len() / of * rows..].to_vec()
        }
        let of = self.length * self.sequences;
        Self {
            sequences: self.sequences,
            length,
            obs: end(&self.obs, rows, of),
            actions: end(&self.actions, rows, of),
            rewards: end(&self.rewards, rows, of),
            first: end(&self.first, rows, of),
            last: end(&self.last, rows, of),
            terminal: end(&self.terminal, rows, of),
        }
    }
}

/// A replay buffer of whole episodes in the order of time, which samples subsequences.
#[doc(alias = "replay buffer")]
#[derive(Clone, Debug)]
pub struct SequenceReplay {
    observation_size: usize,
    action_size: usize,
    capacity: usize,
    /// One row for each time step: obs, action, reward, first, last, terminal.
    rows: Vec<f32>,
    /// Index of the oldest row, once the buffer is full.
    oldest: usize,
    /// The reward for arriving at the next time step; none at the start of an episode.
    arrival_reward: Option<f32>,
}

impl SequenceReplay {
    /// A buffer for `capacity` time steps, at least one.
    pub fn new(observation_size: usize, action_size: usize, capacity: usize) -> Self {
        let capacity = capacity.max(1);
        Self { observation_size, action_size, capacity, rows: Vec::new(), oldest: 0, arrival_reward: None }
    }

    fn width(&self) -> usize {
        self.observation_size + self.action_size + 4
    }

    /// Time steps held: for each episode one more than it has actions.
    pub fn len(&self) -> usize {
        self.rows.len() / self.width()
    }

    /// Whether it holds none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Adds a step of the current episode; the oldest time steps make room if the buffer is full.
    ///
    /// # Panics
    /// If observation or action have the wrong length.
    pub fn push(&mut self, t: &Transition) {
        assert!(
            t.obs.len() == self.observation_size && t.action.len() == self.action_size,
            "the sizes differ from those of the buffer"
        );
        let first = self.arrival_reward.is_none();
        let reward = self.arrival_reward.unwrap_or(0.0);
        self.push_time_step(&t.obs, &t.action, reward, Flags { first, last: false, terminal: false });
        self.arrival_reward = Some(t.reward);
        if t.terminated || t.truncated {
            self.close(&t.next_obs, t.terminated);
        }
    }

    /// Ends the current episode with its last observation, unless it has ended already: where there is no last transition to
    /// [`push`](SequenceReplay::push), because the time limit cut the last decision short.
    ///
    /// # Panics
    /// If the observation has the wrong length.
    pub fn close(&mut self, obs: &[f32], terminal: bool) {
        assert!(obs.len() == self.observation_size, "the sizes differ from those of the buffer");
        if let Some(reward) = self.arrival_reward.take() {
            self.push_time_step(
                obs,
                &vec![0.0; self.action_size],
                reward,
                Flags { first: false, last: true, terminal },
            );
        }
    }

    /// Gives up the current episode, whose last observation is not known: the next step begins another.
    pub fn abandon(&mut self) {
        self.arrival_reward = None;
    }

    fn push_time_step(&mut self, obs: &[f32], action: &[f32], reward: f32, flags: Flags) {
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

    /// Samples subsequences of `length` time steps with uniformly random starts.
    ///
    /// # Panics
    /// If the buffer holds fewer than `length` time steps.
    pub fn sample(&self, sequences: usize, length: usize, rng: &mut Rng) -> SequenceBatch {
        assert!(self.len() >= length && length > 0, "the buffer holds fewer than `length` time steps");
        let starts: Vec<usize> = (0..sequences).map(|_| rng.random_range(0..=self.len() - length)).collect();
        self.at(&starts, length)
    }

    /// Samples subsequences of `length` time steps that lie within an episode each; the current episode's are among them.
    /// `None` if no episode is that long.
    pub fn sample_within_episodes(&self, sequences: usize, length: usize, rng: &mut Rng) -> Option<SequenceBatch> {
        /// Attempts before all starts are looked through: most of them lead to a whole subsequence, unless episodes are short.
        const ATTEMPTS: usize = 100;
        let starts = (self.len() + 1).checked_sub(length).filter(|starts| *starts > 0 && length > 0)?;
        let within = |start: &usize| !(start + 1..start + length).any(|i| self.is_first(i));
        let mut all: Option<Vec<usize>> = None;
        let draw = |_| {
            if all.is_none() {
                let drawn = (0..ATTEMPTS).map(|_| rng.random_range(0..starts)).find(within);
                if drawn.is_some() {
                    return drawn;
                }
            }
            let all = all.get_or_insert_with(|| (0..starts).filter(within).collect());
            (!all.is_empty()).then(|| all[rng.random_range(0..all.len())])
        };
        let starts: Vec<usize> = (0..sequences).map(draw).collect::<Option<_>>()?;
        Some(self.at(&starts, length))
    }

    /// The time step `i`, counted from the oldest.
    fn row(&self, i: usize) -> &[f32] {
        &self.rows[(self.oldest + i) % self.len() * self.width()..][..self.width()]
    }

    /// Whether an episode begins with the time step at index `i`.
    fn is_first(&self, i: usize) -> bool {
        self.row(i)[self.width() - 3] > 0.5
    }

    /// The subsequences that start at these time steps.
    fn at(&self, starts: &[usize], length: usize) -> SequenceBatch {
        let count = self.len();
        let row = |i: usize| self.row(i);
        let mut batch = SequenceBatch { sequences: starts.len(), length, ..SequenceBatch::default() };
        for t in 0..length {
            for start in starts {
                let (obs, rest) = row(start + t).split_at(self.observation_size);
                let (action, rest) = rest.split_at(self.action_size);
                let [reward, first, last, terminal] = rest else { unreachable!("four numbers") };
                // An episode that a crash cut short has no last time step: the one before the next start is its last.
                let cut = start + t + 1 < count && self.is_first(start + t + 1);
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

    /// The most steps that may have been added, from the time steps held.
    pub(crate) fn most_pushes(&self) -> u64 {
        if self.len() < self.capacity { self.len() as u64 } else { MAX_COUNT }
    }

    /// Writes the buffer into `weights`, under `prefix`.
    pub fn save(&self, weights: &mut Weights, prefix: &str) {
        weights.insert(format!("{prefix}.rows"), self.rows.clone(), [1, self.len(), self.width()]);
        weights.insert_counts(format!("{prefix}.oldest"), &[self.oldest as u64]);
    }

    /// Reads what [`SequenceReplay::save`] wrote; the current episode is not continued.
    ///
    /// # Errors
    /// If it is missing, of time steps of other sizes, or of more of them than fit.
    pub fn load(&mut self, weights: &Weights, prefix: &str) -> Result<()> {
        let name = format!("{prefix}.rows");
        let count = fitting(weights, &name, self.capacity)?;
        let rows = weights.get(&name, [1, count, self.width()])?.to_vec();
        // Time steps are overwritten once the buffer is full.
        let newest = if count < self.capacity { 0 } else { count - 1 };
        self.oldest = weights.count(&format!("{prefix}.oldest"), 0..=newest as u64)? as usize;
        self.rows = rows;
        self.arrival_reward = None;
        Ok(())
    }
}
