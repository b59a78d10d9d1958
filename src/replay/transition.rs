//! Single transitions in a ring buffer, sampled uniformly: what SAC and PETS learn from.

use std::ops::RangeInclusive;

use rand::RngExt;

use super::fitting;
use crate::checkpoint::{MAX_COUNT, Weights};
use crate::error::Result;
use crate::rng::Rng;

/// One step of experience in any environment.
#[derive(Clone, Debug, PartialEq)]
pub struct Transition {
    /// The observation before the step.
    pub obs: Vec<f32>,
    /// The action, as the agent chose it, each component in [-1, 1].
    pub action: Vec<f32>,
    /// The reward of the step.
    pub reward: f32,
    /// The observation after the step: at the end of an episode its last one, not the first of the next episode.
    pub next_obs: Vec<f32>,
    /// Whether the step ended the task itself, so that there is no future to bootstrap from. After the time limit there is:
    /// `next_obs` has a value like any other.
    pub terminated: bool,
    /// Whether the time limit ended the episode.
    pub truncated: bool,
}

/// A transition as the buffer stores it.
#[derive(Clone, Copy, Debug)]
pub struct Row<'a> {
    /// The observation before the step.
    pub obs: &'a [f32],
    /// The action.
    pub action: &'a [f32],
    /// The reward.
    pub reward: f32,
    /// The observation after the step.
    pub next_obs: &'a [f32],
    /// Whether the task ended.
    pub terminated: bool,
}

/// A minibatch of `size` transitions, each of one time step or of several, each field row by row.
#[derive(Clone, Debug, Default)]
pub struct Batch {
    /// Rows.
    pub size: usize,
    /// Observations, `[size, observation]`.
    pub obs: Vec<f32>,
    /// Actions, `[size, action]`.
    pub actions: Vec<f32>,
    /// Rewards, `[size]`; of several time steps, their discounted sums.
    pub rewards: Vec<f32>,
    /// Observations after the last step, `[size, observation]`.
    pub next_obs: Vec<f32>,
    /// 1 where the task ended, else 0, `[size]`.
    pub terminated: Vec<f32>,
    /// Time steps between `obs` and `next_obs`, `[size]`.
    pub steps: Vec<usize>,
}

impl Batch {
    /// Adds successive time steps of an episode as one transition with their n-step return.
    pub(crate) fn push(&mut self, path: &[Row], gamma: f32) {
        let (first, last) = (path[0], path[path.len() - 1]);
        self.size += 1;
        self.obs.extend(first.obs);
        self.actions.extend(first.action);
        let (mut reward, mut weight) = (0.0, 1.0);
        for row in path {
            reward += weight * row.reward;
            weight *= gamma;
        }
        self.rewards.push(reward);
        self.next_obs.extend(last.next_obs);
        self.terminated.push(f32::from(last.terminated));
        self.steps.push(path.len());
    }
}

const GOES_ON: f32 = 0.0;
const TERMINATED: f32 = 1.0;
/// Older checkpoints have [`GOES_ON`] here.
const CUT_OFF: f32 = 2.0;

/// A ring buffer of the latest transitions.
#[doc(alias = "replay buffer")]
#[doc(alias = "experience replay")]
#[derive(Clone, Debug)]
pub struct ReplayBuffer {
    observation_size: usize,
    action_size: usize,
    capacity: usize,
    /// Transitions added so far, those that were overwritten included.
    pushed: u64,
    /// One row for each transition: obs, action, reward, next_obs, and how it ended: [`GOES_ON`], [`TERMINATED`] or [`CUT_OFF`].
    rows: Vec<f32>,
}

impl ReplayBuffer {
    /// A buffer for `capacity` transitions.
    pub fn new(observation_size: usize, action_size: usize, capacity: usize) -> Self {
        Self { observation_size, action_size, capacity: capacity.max(1), pushed: 0, rows: Vec::new() }
    }

    fn width(&self) -> usize {
        2 * self.observation_size + self.action_size + 2
    }

    /// Where the next transition goes.
    fn next(&self) -> usize {
        (self.pushed % self.capacity as u64) as usize
    }

    /// Transitions held.
    pub fn len(&self) -> usize {
        self.rows.len() / self.width()
    }

    /// Whether it holds none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Adds a transition, in place of the oldest one if the buffer is full.
    ///
    /// # Panics
    /// If observation or action have the wrong length.
    pub fn push(&mut self, t: &Transition) {
        let (obs, action) = (self.observation_size, self.action_size);
        assert!(
            t.obs.len() == obs && t.next_obs.len() == obs && t.action.len() == action,
            "the sizes differ from those of the buffer"
        );
        let end = match t {
            Transition { terminated: true, .. } => TERMINATED,
            Transition { truncated: true, .. } => CUT_OFF,
            _ => GOES_ON,
        };
        let row = t.obs.iter().chain(&t.action).chain([&t.reward]).chain(&t.next_obs).chain([&end]);
        if self.len() < self.capacity {
            self.rows.extend(row);
        } else {
            let from = self.next() * self.width();
            self.rows[from..].iter_mut().zip(row).for_each(|(old, new)| *old = *new);
        }
        self.pushed += 1;
    }

    /// Ends the episode after the last transition: it was given up, or a decision that the time limit cut short is left out.
    pub(crate) fn cut_off(&mut self) {
        let (last, width) = ((self.pushed.max(1) - 1) % self.capacity as u64, self.width());
        if let Some(end) = self.rows.get_mut((last as usize + 1) * width - 1)
            && *end == GOES_ON
        {
            *end = CUT_OFF;
        }
    }

    /// The transition at index `i`. Once the buffer is full, indices are not in the order of time.
    ///
    /// # Panics
    /// If `i` is not below [`ReplayBuffer::len`].
    pub fn row(&self, i: usize) -> Row<'_> {
        let width = self.width();
        let (obs, rest) = self.rows[i * width..][..width].split_at(self.observation_size);
        let (action, rest) = rest.split_at(self.action_size);
        let (reward, next_obs, terminated) =
            (rest[0], &rest[1..=self.observation_size], rest[rest.len() - 1] == TERMINATED);
        Row { obs, action, reward, next_obs, terminated }
    }

    /// How many transitions had been added before the one at index `i`. Unlike `i` it is in the order of time, and no other
    /// transition ever has the same one.
    pub fn serial(&self, i: usize) -> u64 {
        let (full, next) = (self.pushed / self.capacity as u64, self.next());
        // Indices from `next` on still hold transitions of the lap before.
        let laps = if i < next { full } else { full.saturating_sub(1) };
        laps * self.capacity as u64 + i as u64
    }

    /// Samples `size` transitions uniformly, with replacement.
    ///
    /// # Panics
    /// If the buffer is empty.
    pub fn sample(&self, size: usize, rng: &mut Rng) -> Batch {
        self.sample_n_step(size, 1, 1.0, rng)
    }

    /// The same for n-step returns (Sutton and Barto 2018, section 7.1): `rewards` are sums over up to `n` time steps,
    /// r_t + gamma r_{t+1} + ..., and `next_obs` comes after the last of them. There are fewer, `steps`, where the episode, or
    /// what the buffer holds of it, ends before.
    ///
    /// # Panics
    /// If the buffer is empty.
    #[doc(alias = "multi-step return")]
    pub fn sample_n_step(&self, size: usize, n: usize, gamma: f32, rng: &mut Rng) -> Batch {
        assert!(!self.is_empty(), "something to draw from");
        let mut batch = Batch::default();
        for _ in 0..size {
            let first = rng.random_range(0..self.len());
            batch.push(&self.episode_from(first).take(n).collect::<Vec<_>>(), gamma);
        }
        batch
    }

    /// The transition at index `i` and those that follow it in its episode, as far as the buffer holds them.
    pub fn episode_from(&self, i: usize) -> impl Iterator<Item = Row<'_>> {
        std::iter::successors(Some(i), |i| self.successor(*i)).map(|i| self.row(i))
    }

    /// The index of the transition after the one at index `i`, if it belongs to the same episode: if that did not end, and it starts
    /// from the observation at which the other ended.
    fn successor(&self, i: usize) -> Option<usize> {
        let next = (i + 1) % self.capacity;
        // After the newest comes the oldest, or nothing.
        let newest = next == self.next();
        let goes_on = self.rows[(i + 1) * self.width() - 1] == GOES_ON;
        (!newest && goes_on && self.row(next).obs == self.row(i).next_obs).then_some(next)
    }

    /// How many transitions may have been added, from those held.
    pub(crate) fn pushes(&self) -> RangeInclusive<u64> {
        let held = self.len() as u64;
        held..=if self.len() < self.capacity { held } else { MAX_COUNT }
    }

    /// Writes the buffer into `weights`, under `prefix`.
    pub fn save(&self, weights: &mut Weights, prefix: &str) {
        weights.insert(format!("{prefix}.rows"), self.rows.clone(), [1, self.len(), self.width()]);
        weights.insert_counts(format!("{prefix}.next"), &[self.next() as u64]);
        weights.insert_counts(format!("{prefix}.pushed"), &[self.pushed]);
    }

    /// Reads what [`ReplayBuffer::save`] wrote.
    ///
    /// # Errors
    /// If it is missing, has transitions of other sizes or more of them than fit, or was full at a smaller capacity.
    pub fn load(&mut self, weights: &Weights, prefix: &str) -> Result<()> {
        let name = format!("{prefix}.rows");
        let count = fitting(weights, &name, self.capacity)?;
        let rows = weights.get(&name, [1, count, self.width()])?.to_vec();
        let held = count as u64;
        // Before it is full, a buffer holds all that was added, in order.
        let full = count == self.capacity;
        let next = weights.count(&format!("{prefix}.next"), if full { 0..=held } else { held..=held })?;
        let pushed = format!("{prefix}.pushed");
        self.pushed = if weights.has_counts(&pushed) {
            weights.count(&pushed, held..=if full { MAX_COUNT } else { held })?
        } else if !full {
            held
        } else {
            // Older checkpoints do not say how often the ring was filled; any number tells its order.
            held + next
        };
        self.rows = rows;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;

    fn numbered(i: u64) -> Transition {
        let (obs, next_obs) = (vec![i as f32], vec![i as f32 + 1.0]);
        Transition { obs, action: vec![0.0], reward: 0.0, next_obs, terminated: false, truncated: false }
    }

    /// Two episodes of three steps, the first cut off by its time limit, the second terminated, in a ring that has lost the
    /// first transition.
    #[test]
    fn n_step_returns_end_with_their_episode() {
        let mut buffer = ReplayBuffer::new(1, 1, 5);
        for episode in 0..2 {
            for t in 0..3 {
                let at = |t: usize| vec![(10 * episode + t) as f32];
                let (obs, next_obs, reward) = (at(t), at(t + 1), 1.0 + t as f32);
                let (terminated, truncated) = (t == 2 && episode == 1, t == 2 && episode == 0);
                buffer.push(&Transition { obs, action: vec![0.0], reward, next_obs, terminated, truncated });
            }
        }
        let batch = buffer.sample_n_step(200, 2, 0.5, &mut rng::stream(0, "n-step"));
        for i in 0..200 {
            let of_row = (batch.rewards[i], batch.next_obs[i], batch.terminated[i], batch.steps[i]);
            let expected = match batch.obs[i] as usize {
                1 => (2.0 + 0.5 * 3.0, 3.0, 0.0, 2),
                2 => (3.0, 3.0, 0.0, 1),
                10 => (1.0 + 0.5 * 2.0, 12.0, 0.0, 2),
                11 => (2.0 + 0.5 * 3.0, 13.0, 1.0, 2),
                12 => (3.0, 13.0, 1.0, 1),
                lost => panic!("{lost} is not in the ring any more"),
            };
            assert_eq!(of_row, expected);
        }
    }

    /// Every episode is one step from 0 back to 0, cut off by the time limit, or followed by a decision that is left out.
    #[test]
    fn an_episode_ends_even_where_the_next_one_starts() {
        let mut buffer = ReplayBuffer::new(1, 1, 10);
        for truncated in [true, false, true, false] {
            let (obs, next_obs) = (vec![0.0], vec![0.0]);
            buffer.push(&Transition { obs, action: vec![0.0], reward: 1.0, next_obs, terminated: false, truncated });
            if !truncated {
                buffer.cut_off();
            }
        }
        let batch = buffer.sample_n_step(50, 3, 1.0, &mut rng::stream(0, "one step each"));
        assert_eq!((batch.rewards, batch.terminated), (vec![1.0; 50], vec![0.0; 50]));
    }

    /// Each transition keeps its serial number while it is in the ring, and in a checkpoint; an old checkpoint, which does
    /// not have them, at least loads with all numbers in the order of time.
    #[test]
    fn serial_numbers_are_for_life() {
        let mut buffer = ReplayBuffer::new(1, 1, 7);
        for i in 0..40 {
            buffer.push(&numbered(i));
            let mut state = Weights::default();
            buffer.save(&mut state, "replay");
            let mut resumed = ReplayBuffer::new(1, 1, 7);
            resumed.load(&state, "replay").expect("what was saved");
            for row in 0..buffer.len() {
                assert_eq!(buffer.serial(row), buffer.row(row).obs[0] as u64);
                assert_eq!(resumed.serial(row), buffer.serial(row));
            }
            // In a larger buffer, the order of a ring would be lost.
            assert_eq!(ReplayBuffer::new(1, 1, 9).load(&state, "replay").is_err(), buffer.len() == 7);
            let mut old = Weights::default();
            old.insert("replay.rows", buffer.rows.clone(), [1, buffer.len(), buffer.width()]);
            old.insert_counts("replay.next", &[buffer.next() as u64]);
            resumed.load(&old, "replay").expect("an old checkpoint");
            assert_eq!(resumed.next(), buffer.next());
            for row in 0..buffer.len() {
                assert_eq!(resumed.serial(row) - resumed.serial(buffer.next() % buffer.len()), {
                    buffer.serial(row) - buffer.serial(buffer.next() % buffer.len())
                });
            }
        }
    }
}
