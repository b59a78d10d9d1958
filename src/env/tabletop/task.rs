//! What makes one table task differ from another.

use std::ops::Range;

use nalgebra::Vector3;

use crate::env::Feature;
use crate::env::arm::Pose;
use crate::env::physics::{JointState, Object, Physics};
use crate::env::scene::{Body, Camera};
use crate::rng::Rng;

/// Indices of the hand's position (m) in every compact observation.
pub const HAND_POSITION: Range<usize> = 0..3;
/// Indices of the hand's velocity (m/s) in every compact observation.
pub const HAND_VELOCITY: Range<usize> = 3..6;

/// The objects and the goal of an episode.
#[derive(Clone, Debug, Default)]
pub struct Setup {
    /// Objects in the task's own order.
    pub objects: Vec<Object>,
    /// The goal position, m, if the task has one.
    pub goal: Option<Vector3<f64>>,
}

/// The state that a task composes its observation from.
#[derive(Debug)]
#[non_exhaustive]
pub struct TaskView<'a> {
    /// The simulation.
    pub physics: &'a Physics,
    /// The objects and the goal.
    pub setup: &'a Setup,
    /// Joints and fingers.
    pub joints: &'a JointState,
    /// Pose of the grip site.
    pub hand: Pose,
    /// Velocity of the grip site, m/s.
    pub hand_velocity: Vector3<f64>,
    /// Target of the finger servos, m.
    pub finger_target: f64,
}

/// The reward of an observation, and how far the task has come in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TaskOutcome {
    /// The shaped reward, in [0, 1].
    pub shaped: f64,
    /// Whether the task is solved.
    pub success: bool,
    /// How many of the [`TableTask::stages`] are reached.
    pub stage: usize,
}

/// What makes one table task differ from another. The [module](super) has an example, [`super::helpers`] what our own
/// tasks are made of.
pub trait TableTask: Send + Sync {
    /// Its name.
    fn name(&self) -> &str;

    /// Control steps in an episode, unless [`super::TableOptions::horizon`] says otherwise.
    fn horizon(&self) -> usize;

    /// The stages on the way to success, in order, for reports. None by default.
    fn stages(&self) -> Vec<String> {
        Vec::new()
    }

    /// Whether the agent moves the fingers; otherwise (the default) they stay closed and the action's last number is
    /// ignored, as in Gymnasium's FetchReach and FetchPush.
    fn uses_gripper(&self) -> bool {
        false
    }

    /// Puts the objects and the goal where this episode has them; everything random is drawn from `rng`.
    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup;

    /// The features that follow the hand's position and velocity ([`HAND_POSITION`], [`HAND_VELOCITY`]) in a compact
    /// observation.
    fn features(&self) -> Vec<Feature>;

    /// Their values, as many as there are [`TableTask::features`].
    fn observe(&self, view: &TaskView) -> Vec<f64>;

    /// Reward, success and stage of a compact observation. It must follow from the observation alone: planners compute
    /// it from predicted observations.
    fn outcome(&self, obs: &[f32]) -> TaskOutcome;

    /// The reward of [`RewardKind::Log`](super::RewardKind::Log): that of [`TableTask::outcome`] with distances in
    /// logarithm. The shaped reward itself by default.
    fn log_shaped(&self, obs: &[f32]) -> f64 {
        self.outcome(obs).shaped
    }

    /// The bodies to draw: one for each object, in the order of [`Setup::objects`], then one for the goal if there is one.
    fn drawn(&self, setup: &Setup) -> Vec<Body>;

    /// Where the 3D replay is seen from: by default obliquely from the front, aimed between the arm's base and the middle of the table.
    fn camera(&self) -> Camera {
        Camera { eye: [0.85, -0.95, 1.4], target: [-0.17, 0.0, 0.99] }
    }

    /// The action of a hand-written policy for a compact observation: hand motion (dx, dy, dz) and gripper, clipped to
    /// [-1, 1]. It shows that the task can be solved. None (the default) if there is no such policy.
    fn scripted(&self, _obs: &[f32]) -> Option<[f64; 4]> {
        None
    }

    /// Names and values of robosuite's object state, for [`super::ObservationKind::Robosuite`]. None (the default) if the
    /// task is none of robosuite's.
    fn object_state(&self, _view: &TaskView) -> Option<Vec<(String, f64)>> {
        None
    }
}
