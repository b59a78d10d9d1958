//! Options that every table task has.

use serde::{Deserialize, Serialize};

use crate::settings::ranges;

/// The kind of reward.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum RewardKind {
    /// A number in [0, 1] that grows along the way to success.
    #[default]
    Shaped,
    /// The shaped reward with distances in logarithm ([`log_reaching_reward`](super::helpers::log_reaching_reward)), so that
    /// what is far away still pulls. For planners: see [`TableOptions::planning_reward`].
    Log,
    /// 1 at success, else 0.
    Sparse,
}

/// The meaning of an action.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum ActionKind {
    /// `[dx, dy, dz, gripper]`; the hand keeps its home orientation. The gripper closes with a
    /// speed proportional to the fourth number, so that a policy can learn it by gradient.
    #[default]
    Hand,
    /// robosuite's `[dx, dy, dz, rx, ry, rz, gripper]`: also a rotation vector, in the world frame;
    /// only the sign of the last number counts.
    Pose,
}

/// The contents of an observation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum ObservationKind {
    /// Hand, gripper, objects, goal, and the vectors between them.
    #[default]
    Compact,
    /// robosuite 1.5's vector: the task's object state, then 50 numbers of the robot. Rewards cannot
    /// be computed from it alone (it does not tell what the pads touch).
    Robosuite,
}

/// Options of every table task.
///
/// ```
/// use handful::env::tabletop::{RewardKind, TableOptions};
///
/// let options = TableOptions { reward: RewardKind::Sparse, horizon: Some(50), ..TableOptions::default() };
/// assert_eq!(options, toml::from_str("reward = 'sparse'\nhorizon = 50")?);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TableOptions {
    /// The reward that the environment pays.
    pub reward: RewardKind,
    /// The reward that is known to methods which are told one (the oracle, PETS unless it learns the reward, SAC with hindsight); the
    /// same if absent. Results are measured with `reward` all the same.
    pub planning_reward: Option<RewardKind>,
    /// The meaning of an action.
    pub action: ActionKind,
    /// The contents of an observation.
    pub observation: ObservationKind,
    /// Control steps in an episode; the task's own number if absent.
    pub horizon: Option<usize>,
}

ranges!(TableOptions { reward: Any, planning_reward: Any, action: Any, observation: Any, horizon: 1..=10_000 });

impl TableOptions {
    /// The options of the environments that planners try actions in, or take the reward from.
    pub(crate) fn of_planning(&self) -> Self {
        Self { reward: self.planning_reward.unwrap_or(self.reward), ..*self }
    }

    /// A hand motion and gripper command (dx, dy, dz, grip), clipped to [-1, 1], as the action that these options ask for.
    pub(in crate::env) fn action_of_hand(&self, hand: [f64; 4]) -> Vec<f32> {
        let [x, y, z, grip] = hand.map(|a| a.clamp(-1.0, 1.0) as f32);
        match self.action {
            ActionKind::Hand => vec![x, y, z, grip],
            ActionKind::Pose => vec![x, y, z, 0.0, 0.0, 0.0, grip],
        }
    }
}
