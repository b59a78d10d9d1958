//! What table tasks are made of: features and their values, shaping, steps of scripted policies.
//!
//! Features and values come in pairs ([`object_features`] and [`object_values`], [`gripper_features`] and
//! [`gripper_values`]): [`TableTask::features`](super::TableTask::features) lists the first,
//! [`TableTask::observe`](super::TableTask::observe) the second, in the same order.
//!
//! ```
//! use handful::env::tabletop::helpers::{action_towards, cube_features, difference_features, reaching_reward, vector_at};
//!
//! let features: Vec<_> = cube_features("cube").chain(difference_features("hand", "cube")).collect();
//! assert_eq!((features.len(), features[0].name.as_str()), (15, "cube x"));
//!
//! // 12.5 cm from a goal: full speed towards it.
//! let way = vector_at(&[0.0, 0.0, 0.125, 0.0], 1);
//! assert_eq!(action_towards(way, 0.0), [0.0, 1.875, 0.0, 0.0]);
//! assert!((reaching_reward(0.1) - 0.24).abs() < 0.01);
//! ```

use std::f64::consts::LN_2;
use std::ops::Range;

use nalgebra::{UnitQuaternion, Vector3};

use super::task::{HAND_VELOCITY, TaskView};
use crate::env::Feature;
use crate::env::arm::Pose;
use crate::env::physics::TABLE_TOP;
use crate::rng::{self, Rng};

/// Indices of [`gripper_features`] in compact observations of tasks that list them first.
pub const GRIPPER: Range<usize> = HAND_VELOCITY.end..HAND_VELOCITY.end + 4;

/// The vector whose coordinates start at index `at` of an observation.
pub fn vector_at(obs: &[f32], at: usize) -> Vector3<f64> {
    Vector3::new(obs[at].into(), obs[at + 1].into(), obs[at + 2].into())
}

/// Three features, "`name` x" to "`name` z".
pub fn xyz_features(name: &str, centre: [f32; 3], scale: f32) -> impl Iterator<Item = Feature> + use<> {
    let name = name.to_string();
    (0..3).map(move |i| Feature::new(format!("{name} {}", ["x", "y", "z"][i])).around(centre[i], scale))
}

/// Three features for the vector from one position to another, whose features are "`from` x" and so on: models compute
/// them from those two instead of predicting them.
pub fn difference_features(from: &str, to: &str) -> impl Iterator<Item = Feature> + use<> {
    ["x", "y", "z"]
        .map(|axis| {
            let feature = Feature::new(format!("{from} to {to} {axis}")).around(0.0, 0.1);
            feature.difference(format!("{to} {axis}"), format!("{from} {axis}"))
        })
        .into_iter()
}

/// Twelve features of an object: position (m), the directions of its x and z axes (continuous, where a quaternion
/// jumps), velocity (m/s).
pub fn object_features(name: &str) -> Vec<Feature> {
    let table = TABLE_TOP as f32;
    xyz_features(name, [0.0, 0.0, table + 0.02], 0.1)
        .chain(xyz_features(&format!("{name} x-axis"), [0.0; 3], 1.0))
        .chain(xyz_features(&format!("{name} z-axis"), [0.0; 3], 1.0))
        .chain(xyz_features(&format!("{name} v"), [0.0; 3], 0.2))
        .collect()
}

/// [`object_features`] of a cube, which looks the same from every side: models may treat its 24 orientations alike.
pub fn cube_features(name: &str) -> impl Iterator<Item = Feature> + use<> {
    let name = name.to_string();
    object_features(&name)
        .into_iter()
        .map(move |feature| if feature.name.contains("-axis ") { feature.axis_of_cube(&name) } else { feature })
}

/// The values of [`object_features`] for the object of that index in [`super::Setup::objects`].
pub fn object_values(view: &TaskView, object: usize) -> Vec<f64> {
    let state = view.physics.object_state(view.setup.objects[object]);
    let turn = state.pose.rotation;
    [state.pose.translation.vector, turn * Vector3::x(), turn * Vector3::z(), state.velocity]
        .iter()
        .flat_map(|v| v.iter().copied())
        .collect()
}

/// Four features of a gripper that the agent moves: opening and target (m, of one finger), and whether each pad touches
/// the object (0 or 1).
pub fn gripper_features() -> Vec<Feature> {
    ["finger opening", "finger target"]
        .map(|name| Feature::new(name).around(0.02, 0.02))
        .into_iter()
        .chain(["pad contact left", "pad contact right"].map(|name| Feature::new(name).flag()))
        .collect()
}

/// The values of [`gripper_features`]; pads are asked whether they touch the object of that index.
pub fn gripper_values(view: &TaskView, object: usize) -> Vec<f64> {
    let [left, right] = view.physics.pad_forces(view.setup.objects[object]);
    let opening = (view.joints.fingers[0] + view.joints.fingers[1]) / 2.0;
    vec![opening, view.finger_target, f64::from(left > 0.0), f64::from(right > 0.0)]
}

/// Whether both pads touch the object, in observations with [`GRIPPER`] features. (Learned models predict numbers
/// between 0 and 1.)
pub fn grasped(obs: &[f32]) -> bool {
    obs[GRIPPER.start + 2] > 0.5 && obs[GRIPPER.start + 3] > 0.5
}

/// robosuite's shaping of a distance (m): 1 - tanh(10 d), which is 1 at distance zero and 0.24 at 10 cm.
#[doc(alias = "reward shaping")]
pub fn reaching_reward(distance: f64) -> f64 {
    1.0 - (10.0 * distance).tanh()
}

/// The logarithm of [`reaching_reward`]: 0 at distance zero, -1.4 at 10 cm, and from there on 2 less with every 10 cm, where
/// the other is flat.
pub fn log_reaching_reward(distance: f64) -> f64 {
    // 1 - tanh(x) = 2 / (1 + exp(2 x))
    LN_2 - (20.0 * distance) - (-20.0 * distance).exp().ln_1p()
}

/// The action of a proportional controller that moves the hand by `way` (m); it is saturated beyond 7 cm. `grip` is the
/// action's last number: positive closes the fingers.
pub fn action_towards(way: Vector3<f64>, grip: f64) -> [f64; 4] {
    let a = way * 15.0;
    [a.x, a.y, a.z, grip]
}

/// The first half of a scripted grasp, given the vector (m) from the hand to the object: above it, down to it, close.
pub fn action_to_grasp(way: Vector3<f64>) -> [f64; 4] {
    let aside = way.xy().norm();
    if aside > 0.02 {
        // Approach a few centimetres above the object, so that the fingers do not knock it over.
        action_towards(way + Vector3::z() * 0.06, -1.0)
    } else if way.norm() > 0.012 {
        action_towards(way, -1.0)
    } else {
        action_towards(way, 1.0)
    }
}

/// A random pose on the table: uniform in a square of half width `reach` (m) around the centre, turned about the
/// vertical at random, the lowest point `lift` (m) above the table.
pub fn pose_on_table(rng: &mut Rng, reach: f64, half_height: f64, lift: f64) -> Pose {
    let (x, y) = (rng::uniform(rng, -reach, reach), rng::uniform(rng, -reach, reach));
    let yaw = rng::uniform(rng, 0.0, std::f64::consts::TAU);
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    Pose::from_parts(nalgebra::Translation3::new(x, y, TABLE_TOP + half_height + lift), turn)
}

/// robosuite's state of an object, by its names: position, quaternion (x, y, z, w), and the vector from the hand to it,
/// which is called `hand_to`.
pub fn robosuite_object_state(view: &TaskView, object: usize, name: &str, hand_to: &str) -> Vec<(String, f64)> {
    let pose = view.physics.object_state(view.setup.objects[object]).pose;
    let position = pose.translation.vector;
    let to = position - view.hand.translation.vector;
    let mut values = named_values(&format!("{name}_pos"), position.iter());
    values.extend(named_values(&format!("{name}_quat"), pose.rotation.coords.iter()));
    values.extend(named_values(hand_to, to.iter()));
    values
}

/// `name[0]`, `name[1]`, ... with their values.
pub fn named_values<'a>(name: &str, values: impl Iterator<Item = &'a f64>) -> Vec<(String, f64)> {
    values.enumerate().map(|(i, &value)| (format!("{name}[{i}]"), value)).collect()
}
