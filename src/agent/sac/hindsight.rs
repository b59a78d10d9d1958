//! Hindsight experience replay (HER; Andrychowicz et al. 2017): whatever an episode came to is treated as if it had been its
//! goal, so that there is success to learn from before the first goal is reached.
//!
//! A goal is a feature that is constant over an episode and compared with a dynamic one by a
//! [`Role::Difference`]; the dynamic one is what was achieved. The new goal is what a later time step of the same episode achieved
//! (the paper's strategy *future*), the difference is computed anew, and so are the reward, which therefore has to be known, and
//! whether the task has ended. No other feature may depend on the goal.

use rand::RngExt;

use crate::env::{Role, SharedReward, Spec};
use crate::error::{Error, Result};
use crate::model::FeatureMap;
use crate::replay::{Batch, ReplayBuffer, Row};
use crate::rng::Rng;

/// Draws minibatches part of which are relabelled.
pub(super) struct Hindsight {
    /// The part that is relabelled.
    share: f32,
    /// Indices of each goal's feature and of what is compared with it: `[goal, achieved]`.
    goals: Vec<[usize; 2]>,
    /// `[index, minuend, subtrahend]`.
    differences: Vec<[usize; 3]>,
    reward: SharedReward,
}

impl Hindsight {
    pub(super) fn new(spec: &Spec, reward: Option<SharedReward>, share: f32) -> Result<Self> {
        let refused = |what: &str| Error::Unsupported(format!("`sac.hindsight` is {share}, but {} {what}", spec.name));
        let reward = reward.filter(|reward| reward.is_known());
        let reward = reward.ok_or_else(|| refused("has no reward that is known as a function of observations"))?;
        let constant = |i: usize| spec.observation[i].role == Role::Constant;
        let mut differences = FeatureMap::new(spec)?.differences;
        differences.retain(|&[_, a, b]| constant(a) != constant(b));
        let goals: Vec<_> = differences.iter().map(|&[_, a, b]| if constant(a) { [a, b] } else { [b, a] }).collect();
        if goals.is_empty() {
            return Err(refused("has no goal: no constant feature that another one is compared with"));
        }
        let twice = |goal: &[usize; 2]| goals.iter().find(|other| other[0] == goal[0] && other[1] != goal[1]).copied();
        if let Some((goal, other)) = goals.iter().find_map(|goal| Some((goal, twice(goal)?))) {
            let [goal, a, b] = [goal[0], goal[1], other[1]].map(|i| &spec.observation[i].name);
            return Err(refused(&format!(
                "compares `{goal}` with both `{a}` and `{b}`: which of them is to reach it?"
            )));
        }
        Ok(Self { share, goals, differences, reward })
    }

    /// As [`ReplayBuffer::sample_n_step`], with the rewards of the known function.
    pub(super) fn sample(&self, replay: &ReplayBuffer, size: usize, n: usize, gamma: f32, rng: &mut Rng) -> Batch {
        let mut batch = Batch::default();
        for _ in 0..size {
            let rows: Vec<Row> = replay.episode_from(rng.random_range(0..replay.len())).collect();
            let relabelled = rng.random::<f32>() < self.share;
            let achieved = relabelled.then(|| rows[rng.random_range(0..rows.len())].next_obs);
            let seen = |obs: &[f32]| achieved.map_or_else(|| obs.to_vec(), |achieved| self.relabel(obs, achieved));
            let path = &rows[..n.min(rows.len())];
            let observations: Vec<_> = path.iter().map(|row| (seen(row.obs), seen(row.next_obs))).collect();
            let path = path.iter().zip(&observations).map(|(row, (obs, next_obs))| {
                let reward = self.reward.reward(obs, row.action, next_obs);
                let terminated = if relabelled { self.terminates(row, next_obs) } else { row.terminated };
                Row { obs, next_obs, reward, terminated, ..*row }
            });
            let mut path: Vec<Row> = path.collect();
            let end = path.iter().position(|row| row.terminated);
            path.truncate(end.map_or(path.len(), |end| end + 1));
            batch.push(&path, gamma);
        }
        batch
    }

    /// Whether a transition ends the task, if its observation is `next_obs` instead: an end that the old goal explains falls away.
    fn terminates(&self, row: &Row, next_obs: &[f32]) -> bool {
        self.reward.terminated(next_obs) || row.terminated && !self.reward.terminated(row.next_obs)
    }

    /// `obs`, if the goal had been what is `achieved` in another observation.
    fn relabel(&self, obs: &[f32], achieved: &[f32]) -> Vec<f32> {
        let mut obs = obs.to_vec();
        self.goals.iter().for_each(|&[goal, of]| obs[goal] = achieved[of]);
        self.differences.iter().for_each(|&[i, a, b]| obs[i] = obs[a] - obs[b]);
        obs
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::env::{Env, Feature, KnownReward, Task};
    use crate::replay::Transition;
    use crate::rng;

    /// One where the goal is reached.
    struct There;

    impl KnownReward for There {
        fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
            f32::from(next_obs[2] == 0.0)
        }
    }

    fn line() -> Spec {
        let way = Feature::new("way").difference("goal", "x");
        Spec::new("line", [Feature::new("x"), Feature::new("goal").constant(), way], 1, 4, 0.1)
    }

    /// Two episodes go from 0 to 4, one for the goal 100, the other for 200. In hindsight they were after 1, 2, 3 or 4, and
    /// nothing later than the goal, nor of the other episode, is in sight.
    #[test]
    fn goals_are_achieved_later_in_the_same_episode() {
        let mut replay = ReplayBuffer::new(3, 1, 100);
        for goal in [100.0, 200.0] {
            let at = |x: usize| vec![x as f32, goal, goal - x as f32];
            for x in 0..4 {
                let (obs, next_obs) = (at(x), at(x + 1));
                let (terminated, truncated) = (false, x == 3);
                replay.push(&Transition { obs, action: vec![0.0], reward: 0.0, next_obs, terminated, truncated });
            }
        }
        let hindsight = Hindsight::new(&line(), Some(Arc::new(There)), 0.75).expect("a goal and a reward");
        let batch = hindsight.sample(&replay, 4000, 2, 0.5, &mut rng::stream(0, "hindsight"));
        assert_eq!(batch.size, 4000);
        let mut relabelled = 0;
        for i in 0..batch.size {
            let ([x, goal, way], [next, next_goal, next_way]) = [&batch.obs, &batch.next_obs]
                .map(|rows| <[f32; 3]>::try_from(&rows[3 * i..][..3]).expect("three"))
                .into();
            assert!(
                goal == next_goal && way == goal - x && next_way == goal - next,
                "the same goal, and the way to it"
            );
            if goal < 100.0 {
                relabelled += 1;
                assert!(goal > x && goal <= 4.0, "{goal} is achieved after {x}");
            }
            let rewards = f32::from(x + 1.0 == goal) + 0.5 * f32::from(x < 3.0 && x + 2.0 == goal);
            assert_eq!((batch.rewards[i], batch.steps[i]), (rewards, if x < 3.0 { 2 } else { 1 }));
        }
        assert!((relabelled as f32 / 4000.0 - 0.75).abs() < 0.035, "{relabelled}");
    }

    /// As [`There`], which ends the episode.
    struct Over;

    impl KnownReward for Over {
        fn reward(&self, obs: &[f32], action: &[f32], next_obs: &[f32]) -> f32 {
            There.reward(obs, action, next_obs)
        }

        fn terminated(&self, next_obs: &[f32]) -> bool {
            next_obs[2] == 0.0
        }
    }

    /// From 0 to the goal 4, which ends the episode. In hindsight it ends where the new goal is reached, and returns of three steps
    /// end there too.
    #[test]
    fn the_new_goal_ends_the_episode_and_the_old_one_no_longer_does() {
        let mut replay = ReplayBuffer::new(3, 1, 100);
        let at = |x: usize| vec![x as f32, 4.0, 4.0 - x as f32];
        for x in 0..4 {
            let (obs, next_obs) = (at(x), at(x + 1));
            let reward = f32::from(x == 3);
            let (terminated, truncated) = (x == 3, false);
            replay.push(&Transition { obs, action: vec![0.0], reward, next_obs, terminated, truncated });
        }
        let hindsight = Hindsight::new(&line(), Some(Arc::new(Over)), 1.0).expect("a goal and a reward");
        let batch = hindsight.sample(&replay, 400, 3, 0.5, &mut rng::stream(0, "hindsight"));
        for i in 0..batch.size {
            let [x, goal] = [batch.obs[3 * i], batch.obs[3 * i + 1]];
            let steps = (goal - x).min(3.0);
            assert_eq!(batch.steps[i], steps as usize, "from {x} to {goal}");
            assert_eq!(batch.next_obs[3 * i], x + steps);
            assert_eq!(batch.terminated[i], f32::from(x + steps == goal), "from {x} to {goal}");
        }
    }

    /// Relabelling could not make both differences zero.
    #[test]
    fn a_goal_that_two_features_are_compared_with_is_refused() {
        let [by_hand, by_cube] =
            ["hand", "cube"].map(|what| Feature::new(format!("{what} to goal")).difference("goal", what));
        let features = [Feature::new("hand"), Feature::new("cube"), Feature::new("goal").constant(), by_hand, by_cube];
        let spec = Spec::new("carry", features, 1, 4, 0.1);
        let problem = Hindsight::new(&spec, Some(Arc::new(There)), 0.5).map(|_| ()).expect_err("two of them");
        assert!(problem.to_string().contains("compares `goal` with both `hand` and `cube`"), "{problem}");
    }

    /// On the arm's tasks a transition whose goal was relabelled has the reward that the environment would have given.
    #[test]
    fn tasks_with_goals_can_be_relabelled() {
        for task in [Task::Reach, Task::Push] {
            let mut world = task.make();
            let obs = world.reset(1);
            let hindsight = Hindsight::new(world.spec(), Some(Arc::new(task.make())), 0.8).expect("a goal");
            let reached = hindsight.relabel(&obs, &obs);
            assert_eq!(world.reward(&obs, &[0.0; 4], &reached), 1.0, "{}: the goal is where it is", task.name());
        }
        let lift = Task::Lift.make();
        let problem = Hindsight::new(lift.spec(), Some(Arc::new(Task::Lift.make())), 0.8).err().expect("no goal");
        assert!(problem.to_string().contains("has no goal"), "{problem}");
        let problem = Hindsight::new(&line(), None, 0.8).err().expect("no reward").to_string();
        assert!(problem.contains("`sac.hindsight` is 0.8, but line has no reward"), "{problem}");
    }
}
