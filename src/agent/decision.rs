//! Decisions that last several time steps: an action that is held, and the experience that it brings.

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
        if self.left == 0 {
            self.action = decide();
            self.left = steps;
        }
        self.left -= 1;
        self.action.clone()
    }

    /// Drops what is left of it: a new episode begins.
    pub fn reset(&mut self) {
        self.left = 0;
    }
}

/// The transitions of one decision, joined.
#[derive(Debug, Default)]
pub(super) struct Decision {
    so_far: Option<Transition>,
    steps: usize,
}

impl Decision {
    /// Adds a time step. When the decision is over, after `steps` of them or at the end of the episode, the whole of it: its
    /// reward is the mean.
    pub fn join(&mut self, t: &Transition, steps: usize) -> Option<Transition> {
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
        if self.steps >= steps || t.terminated || t.truncated {
            return Some(joined);
        }
        self.so_far = Some(joined);
        None
    }

    /// Drops what has been joined: a new episode begins.
    pub fn reset(&mut self) {
        self.so_far = None;
    }
}

/// An episode as decisions of `steps` time steps each.
pub(super) fn in_decisions(episode: &Episode, steps: usize) -> Episode {
    let last = episode.observations.last().filter(|_| !episode.rewards.len().is_multiple_of(steps));
    Episode {
        observations: episode.observations.iter().step_by(steps).chain(last).cloned().collect(),
        actions: episode.actions.iter().step_by(steps).cloned().collect(),
        rewards: episode.rewards.chunks(steps).map(|r| r.iter().sum::<f32>() / r.len() as f32).collect(),
        terminated: episode.terminated,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Seven time steps are decisions of three, three and one; what is recorded is what was replayed.
    #[test]
    fn decisions_join_what_belongs_together() {
        let (mut held, mut decision, mut decisions) = (Held::default(), Decision::default(), Vec::new());
        let mut recorded = Episode { observations: vec![vec![0.0]], ..Episode::default() };
        for i in 0..7_u8 {
            let (now, next_obs) = (f32::from(i), vec![f32::from(i) + 1.0]);
            let action = held.next(3, || vec![now]);
            assert_eq!(action, [f32::from(i / 3 * 3)]);
            recorded.observations.push(next_obs.clone());
            recorded.actions.push(action.clone());
            recorded.rewards.push(now);
            let t = Transition { obs: vec![now], action, reward: now, next_obs, terminated: false, truncated: i == 6 };
            decisions.extend(decision.join(&t, 3));
        }
        let found: Vec<_> = decisions.iter().map(|t| (t.obs[0], t.action[0], t.reward, t.next_obs[0])).collect();
        assert_eq!(found, [(0.0, 0.0, 1.0, 3.0), (3.0, 3.0, 4.0, 6.0), (6.0, 6.0, 6.0, 7.0)]);
        assert!(decisions[2].truncated && !decisions[1].truncated);
        let coarse = in_decisions(&recorded, 3);
        assert_eq!(coarse.observations.concat(), [0.0, 3.0, 6.0, 7.0]);
        assert_eq!((coarse.actions.concat(), coarse.rewards), (vec![0.0, 3.0, 6.0], vec![1.0, 4.0, 6.0]));
    }
}
