//! Whole episodes as they happened.

/// A recorded episode of T steps: what was observed, what was done, and the rewards.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Episode {
    /// Observations, `[T + 1, observation]`: one before each action, and the last one.
    pub observations: Vec<Vec<f32>>,
    /// Actions, `[T, action]`, each component in [-1, 1].
    pub actions: Vec<Vec<f32>>,
    /// The reward of each action, `[T]`.
    pub rewards: Vec<f32>,
    /// Whether the task itself ended with the last action, as opposed to the time limit.
    pub terminated: bool,
}
