//! Decisions that last several time steps: an action that is held, and the experience of it.

use crate::checkpoint::MAX_COUNT;
use crate::env::Spec;
use crate::error::{Error, Result};
use crate::replay::{Episode, Transition};

/// An action that is held.
#[derive(Debug, Default)]
pub(super) struct Held {
    action: Vec<f32>,
    left: usize,
}

impl Held {
    /// The action of the next time step; `decide` is asked for one when the last has been held for `steps` of them.
    pub fn next(&mut self, steps: usize, decide: impl FnOnce() -> Vec<f32>) -> Vec<f32> {
        if self.is_due() {
            self.begin(decide(), steps);
        }
        self.advance()
    }

    /// Whether the next time step needs a decision.
    pub fn is_due(&self) -> bool {
        self.left == 0
    }

    /// Begins to hold `action`, for `steps` time steps.
    pub fn begin(&mut self, action: Vec<f32>, steps: usize) {
        self.action = action;
        self.left = steps;
    }

    /// The action of the next time step, for which no decision is due.
    pub fn advance(&mut self) -> Vec<f32> {
        self.left -= 1;
        self.action.clone()
    }

    /// The action before the next decision: `size` zeros before the first one of an episode.
    pub fn last(&self, size: usize) -> Vec<f32> {
        if self.action.is_empty() { vec![0.0; size] } else { self.action.clone() }
    }

    /// Drops it: a new episode begins.
    pub fn reset(&mut self) {
        *self = Self::default();
    }
}

/// The transitions of one decision, joined.
#[derive(Debug, Default)]
pub(super) struct Decision {
    so_far: Option<Transition>,
    steps: usize,
}

/// A decision that is over.
#[derive(Debug)]
pub(super) enum Over {
    /// It lasted as long as it should, or until the task itself ended. The reward is the mean, with zeros after the end of the task.
    Whole(Transition),
    /// The time limit cut it short: what follows from holding its action is unknown. The observation that it began with.
    Short(Vec<f32>),
}

impl Decision {
    /// Adds a time step; the decision is over after `steps` of them, or at the end of the episode.
    pub fn join(&mut self, t: &Transition, steps: usize) -> Option<Over> {
        let joined = match self.so_far.take() {
            None => {
                self.steps = 1;
                t.clone()
            }
            Some(Transition { obs, action, reward, .. }) => {
                self.steps += 1;
                let reward = reward + (t.reward - reward) / self.steps as f32;
                Transition { obs, action, reward, ..t.clone() }
            }
        };
        if self.steps >= steps {
            Some(Over::Whole(joined))
        } else if t.terminated {
            let reward = joined.reward * self.steps as f32 / steps as f32;
            Some(Over::Whole(Transition { reward, ..joined }))
        } else if t.truncated {
            Some(Over::Short(joined.obs))
        } else {
            self.so_far = Some(joined);
            None
        }
    }

    /// Drops what has been joined: a new episode begins.
    pub fn reset(&mut self) {
        self.so_far = None;
    }
}

/// An episode as decisions of `steps` time steps each, without one that the time limit cut short.
pub(super) fn in_decisions(episode: &Episode, steps: usize) -> Episode {
    let count = episode.rewards.len();
    let whole = if episode.terminated { count.div_ceil(steps) } else { count / steps };
    let mean = |rewards: &[f32]| rewards.iter().sum::<f32>() / steps as f32;
    Episode {
        observations: (0..=whole).map(|i| episode.observations[(i * steps).min(count)].clone()).collect(),
        actions: episode.actions.iter().step_by(steps).take(whole).cloned().collect(),
        rewards: episode.rewards.chunks(steps).take(whole).map(mean).collect(),
        terminated: episode.terminated,
    }
}

/// # Errors
/// If the episodes of an environment have fewer than `decisions` decisions of `action_repeat` time steps each: nothing could be learned.
pub(super) fn check_decisions(agent: &str, spec: &Spec, action_repeat: usize, decisions: usize) -> Result<()> {
    if spec.horizon / action_repeat >= decisions {
        return Ok(());
    }
    let instead = if decisions > 1 { "`action_repeat` or `horizon`" } else { "`action_repeat`" };
    Err(Error::Config(format!(
        "{agent}: an episode of `{}` has only {} time steps; the agent needs {} ({decisions} x {action_repeat}) or more: lower its {instead}",
        spec.name,
        spec.horizon,
        decisions * action_repeat
    )))
}

/// The most time steps that an agent can have observed if at most `pushes` entries went into its replay buffer. With held
/// actions there is no bound: a decision that the time limit cuts short leaves no trace there.
pub(super) fn most_observed(pushes: u64, action_repeat: usize) -> u64 {
    if action_repeat == 1 { pushes } else { MAX_COUNT }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Seven time steps are two decisions of three, and one that was cut short: it counts if the task itself ended. What is
    /// recorded is what was replayed.
    #[test]
    fn decisions_join_what_belongs_together() {
        for terminated in [false, true] {
            let (mut held, mut decision, mut decisions) = (Held::default(), Decision::default(), Vec::new());
            let mut recorded = Episode { observations: vec![vec![0.0]], terminated, ..Episode::default() };
            for i in 0..7_u8 {
                let (now, next_obs) = (f32::from(i), vec![f32::from(i) + 1.0]);
                let action = held.next(3, || vec![now]);
                assert_eq!(action, [f32::from(i / 3 * 3)]);
                recorded.observations.push(next_obs.clone());
                recorded.actions.push(action.clone());
                recorded.rewards.push(now);
                let [terminated, truncated] = [terminated, !terminated].map(|end| end && i == 6);
                let t = Transition { obs: vec![now], action, reward: now, next_obs, terminated, truncated };
                decisions.extend(decision.join(&t, 3));
            }
            let found = decisions.iter().map(|over| match over {
                Over::Whole(t) => vec![t.obs[0], t.action[0], t.reward, t.next_obs[0]],
                Over::Short(obs) => obs.clone(),
            });
            let last = if terminated { vec![6.0, 6.0, 2.0, 7.0] } else { vec![6.0] };
            assert_eq!(found.collect::<Vec<_>>(), [vec![0.0, 0.0, 1.0, 3.0], vec![3.0, 3.0, 4.0, 6.0], last]);
            let coarse = in_decisions(&recorded, 3);
            let count = if terminated { 3 } else { 2 };
            assert_eq!(coarse.observations.concat(), [0.0, 3.0, 6.0, 7.0][..=count]);
            assert_eq!(coarse.actions.concat(), [0.0, 3.0, 6.0][..count]);
            assert_eq!(coarse.rewards, [1.0, 4.0, 2.0][..count]);
        }
    }
}
