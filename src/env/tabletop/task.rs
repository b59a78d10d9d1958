//! What makes one table task differ from another, and what they share.

use std::ops::Range;

use nalgebra::{UnitQuaternion, Vector3};

use crate::env::Feature;
use crate::env::arm::Pose;
use crate::env::physics::{JointState, Object, Physics, TABLE_TOP};
use crate::env::scene::Body;
use crate::rng::{self, Rng};

/// Where the hand's position (m) stands in every compact observation.
pub const HAND_POSITION: Range<usize> = 0..3;
/// Where the hand's velocity (m/s) stands in every compact observation.
pub const HAND_VELOCITY: Range<usize> = 3..6;

/// What stands on the table, and where the goal is.
#[derive(Clone, Debug, Default)]
pub struct Setup {
    /// Objects in the task's own order.
    pub objects: Vec<Object>,
    /// The goal position, m, if the task has one.
    pub goal: Option<Vector3<f64>>,
}

/// What a task can see when it composes an observation.
pub struct TaskView<'a> {
    /// The world.
    pub physics: &'a Physics,
    /// What stands on the table.
    pub setup: &'a Setup,
    /// Joints and fingers.
    pub joints: &'a JointState,
    /// Pose of the grip site.
    pub hand: Pose,
    /// Velocity of the grip site, m/s.
    pub hand_velocity: Vector3<f64>,
    /// Where the finger servos are told to go, m.
    pub finger_target: f64,
}

/// What an observation is worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TaskOutcome {
    /// The shaped reward, in [0, 1].
    pub shaped: f64,
    /// Whether the task is fulfilled.
    pub success: bool,
    /// How many stages are fulfilled.
    pub stage: usize,
}

/// What makes one table task differ from another.
pub trait TableTask: Send + Sync {
    /// Its name.
    fn name(&self) -> &'static str;
    /// Control steps in an episode.
    fn horizon(&self) -> usize;
    /// The stages on the way to success.
    fn stages(&self) -> &'static [&'static str];
    /// Whether the agent moves the fingers; otherwise they stay closed and the action's last number
    /// is ignored, as in the Fetch tasks.
    fn uses_gripper(&self) -> bool;
    /// Puts objects and goal where this episode has them.
    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup;
    /// The features that follow the hand's position and velocity in an observation.
    fn features(&self) -> Vec<Feature>;
    /// Their values.
    fn observe(&self, view: &TaskView) -> Vec<f64>;
    /// robosuite's object state.
    fn object_state(&self, view: &TaskView) -> Vec<(String, f64)>;
    /// What a compact observation is worth.
    fn outcome(&self, obs: &[f32]) -> TaskOutcome;
    /// What a hand-written policy does (hand action): it shows that the task can be solved.
    fn scripted(&self, obs: &[f32]) -> [f64; 4];
    /// Objects, in the order of [`Setup::objects`], and the goal, as they are drawn.
    fn drawn(&self, setup: &Setup) -> Vec<Body>;
}

/// The vector that stands at `at` in an observation.
pub(super) fn vector(obs: &[f32], at: usize) -> Vector3<f64> {
    Vector3::new(obs[at].into(), obs[at + 1].into(), obs[at + 2].into())
}

/// Features for three coordinates.
pub(super) fn xyz(name: &str, centre: [f32; 3], scale: f32) -> impl Iterator<Item = Feature> {
    let name = name.to_string();
    (0..3).map(move |i| Feature::new(format!("{name} {}", ["x", "y", "z"][i])).around(centre[i], scale))
}

/// Features for the way from one place to another, each named in the three coordinates of its position.
pub(super) fn way(from: &str, to: &str) -> impl Iterator<Item = Feature> + use<> {
    ["x", "y", "z"]
        .map(|axis| {
            let feature = Feature::new(format!("{from} to {to} {axis}")).around(0.0, 0.1);
            feature.difference(format!("{to} {axis}"), format!("{from} {axis}"))
        })
        .into_iter()
}

/// Features of an object: position, the directions of its x and z axes (continuous, where a
/// quaternion jumps), velocity.
pub(super) fn object_features(name: &str) -> Vec<Feature> {
    let table = TABLE_TOP as f32;
    xyz(name, [0.0, 0.0, table + 0.02], 0.1)
        .chain(xyz(&format!("{name} x-axis"), [0.0; 3], 1.0))
        .chain(xyz(&format!("{name} z-axis"), [0.0; 3], 1.0))
        .chain(xyz(&format!("{name} v"), [0.0; 3], 0.2))
        .collect()
}

/// [`object_features`] of a cube.
pub(super) fn cube_features(name: &str) -> impl Iterator<Item = Feature> {
    object_features(name)
        .into_iter()
        .map(move |feature| if feature.name.contains("-axis ") { feature.axis_of_cube(name) } else { feature })
}

/// The values of [`object_features`].
pub(super) fn object_values(view: &TaskView, object: usize) -> Vec<f64> {
    let state = view.physics.object_state(view.setup.objects[object]);
    let turn = state.pose.rotation;
    [state.pose.translation.vector, turn * Vector3::x(), turn * Vector3::z(), state.velocity]
        .iter()
        .flat_map(|v| v.iter().copied())
        .collect()
}

/// Features of a gripper that the agent moves: opening and target (m, of one finger), and whether
/// each pad touches the object.
pub(super) fn gripper_features() -> Vec<Feature> {
    ["finger opening", "finger target"]
        .map(|name| Feature::new(name).around(0.02, 0.02))
        .into_iter()
        .chain(["pad contact left", "pad contact right"].map(|name| Feature::new(name).around(0.5, 0.5)))
        .collect()
}

/// The values of [`gripper_features`].
pub(super) fn gripper_values(view: &TaskView, object: usize) -> Vec<f64> {
    let [left, right] = view.physics.pad_forces(view.setup.objects[object]);
    let opening = (view.joints.fingers[0] + view.joints.fingers[1]) / 2.0;
    vec![opening, view.finger_target, f64::from(left > 0.0), f64::from(right > 0.0)]
}

/// 1 at distance zero, falling to 0.24 at 10 cm: robosuite's shaping of distances.
pub(super) fn closeness(distance: f64) -> f64 {
    1.0 - (10.0 * distance).tanh()
}

/// The hand action that moves by `way` (m) with some care, fingers as told.
pub(super) fn towards(way: Vector3<f64>, grip: f64) -> [f64; 4] {
    let a = way * 15.0;
    [a.x, a.y, a.z, grip]
}

/// A pose on the table: uniform in a square of half width `reach` around the centre, turned
/// about the vertical at random, the lowest point at height `lift` above the table.
pub(super) fn on_table(rng: &mut Rng, reach: f64, half_height: f64, lift: f64) -> Pose {
    let (x, y) = (rng::uniform(rng, -reach, reach), rng::uniform(rng, -reach, reach));
    let yaw = rng::uniform(rng, 0.0, std::f64::consts::TAU);
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    Pose::from_parts(nalgebra::Translation3::new(x, y, TABLE_TOP + half_height + lift), turn)
}

/// Position and quaternion (x, y, z, w) of an object, and its distance vector from the hand, by
/// robosuite's names.
pub(super) fn object_state_of(view: &TaskView, object: usize, name: &str, hand_to: &str) -> Vec<(String, f64)> {
    let pose = view.physics.object_state(view.setup.objects[object]).pose;
    let position = pose.translation.vector;
    let to = position - view.hand.translation.vector;
    let mut values = named(&format!("{name}_pos"), position.iter());
    values.extend(named(&format!("{name}_quat"), pose.rotation.coords.iter()));
    values.extend(named(hand_to, to.iter()));
    values
}

/// `name[0]`, `name[1]`, ... with their values.
pub(super) fn named<'a>(name: &str, values: impl Iterator<Item = &'a f64>) -> Vec<(String, f64)> {
    values.enumerate().map(|(i, &value)| (format!("{name}[{i}]"), value)).collect()
}
