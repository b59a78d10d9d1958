//! `door`: turn the handle of a door and open it. robosuite's Door with its latch, with its numbers.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Quaternion, Translation3, UnitQuaternion, Vector3};

use super::helpers::{
    GRIPPER, action_towards, difference_features, gripper_features, gripper_values, log_reaching_reward, named_values,
    reaching_reward, vector_at, xyz_features,
};
use super::task::{Setup, TableTask, TaskOutcome, TaskView};
use crate::env::Feature;
use crate::env::arm::{Inertia, Pose, Primitive, PrimitiveKind};
use crate::env::physics::{Hinge, HingeState, Physics};
use crate::env::scene::{Body, Camera};
use crate::rng::{Rng, uniform};

/// The door's angle that counts as open, rad.
const OPEN: f64 = 0.3;
/// The handle's angle beyond which its bolt no longer holds the door, rad.
const TURNED: f64 = 1.25;

/// The handle's axis in the door's frame, and the point to take hold of in the handle's: they determine how the door stands.
const HANDLE_AXIS: [f64; 3] = [-0.175, 0.0, -0.025];
const HANDLE_POINT: [f64; 3] = [0.125, -0.10, 0.0];

/// Order of [`Setup::objects`].
const PANEL: usize = 1;
const HANDLE: usize = 2;

const DOOR_POSITION: usize = GRIPPER.end;
const HANDLE_POSITION: usize = DOOR_POSITION + 3;
const ANGLE: usize = HANDLE_POSITION + 3;
const HAND_TO_HANDLE: usize = ANGLE + 4;
const HANDLE_ANGLE: usize = HAND_TO_HANDLE + 3;

/// Press the handle of a door down and pull the door open by 0.3 rad: robosuite's Door with its latch, with its numbers,
/// except for the damping of the handle. An episode is shorter than in robosuite's published runs.
///
/// A bolt on the handle holds the door by contact with the frame until the handle is turned by about 1.2 rad, up or down.
/// The compact observation has the rates of both hinges beside robosuite's numbers.
#[derive(Clone, Copy, Debug)]
pub struct Door;

impl TableTask for Door {
    fn name(&self) -> &str {
        "door"
    }

    /// robosuite's published runs use 500 (set `horizon`); most of those steps only collect the
    /// success reward, so the default is shorter.
    fn horizon(&self) -> usize {
        200
    }

    fn stages(&self) -> Vec<String> {
        ["reached", "turned", "opened"].map(String::from).into()
    }

    fn uses_gripper(&self) -> bool {
        true
    }

    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup {
        physics.set_table([0.4, 0.15], [-0.2, -0.35]);
        let (x, y) = (uniform(rng, 0.07, 0.09), uniform(rng, -0.01, 0.01));
        let yaw = uniform(rng, -FRAC_PI_2 - 0.25, -FRAC_PI_2);
        let whole = pose([-0.2 + x, -0.35 + y, 1.1], [(yaw / 2.0).cos(), 0.0, 0.0, (yaw / 2.0).sin()]);
        let frame =
            physics.add_fixed(&frame(), 1.0, &(whole * pose([0.0, 0.22, 0.0], [0.707388, 0.0, 0.0, -0.706825])));
        let panel = physics.add_hinged(frame, &panel(), 1.0);
        let handle = physics.add_hinged(panel, &handle(), 1.0);
        Setup { objects: vec![frame, panel, handle], goal: None }
    }

    fn features(&self) -> Vec<Feature> {
        let door = xyz_features("door", [-0.2, -0.35, 1.1], 0.05);
        // The hinge is upright.
        let door = door.enumerate().map(|(i, feature)| if i == 2 { feature.constant() } else { feature });
        gripper_features()
            .into_iter()
            .chain(door)
            .chain(xyz_features("handle", [-0.1, -0.2, 1.0], 0.1))
            .chain([Feature::new("door angle").around(0.15, 0.15)])
            .chain(difference_features("hand", "door"))
            .chain(difference_features("hand", "handle"))
            .chain([Feature::new("handle angle").around(0.75, 0.75)])
            .chain([Feature::new("door rate").around(0.0, 0.5), Feature::new("handle rate").around(0.0, 2.0)])
            .collect()
    }

    fn observe(&self, view: &TaskView) -> Vec<f64> {
        let Parts { door, handle, to_door, to_handle, door_hinge, handle_hinge } = Parts::of(view);
        let mut values = gripper_values(view, HANDLE);
        values.extend(door.iter().chain(&handle).chain([&door_hinge.angle]).chain(&to_door).chain(&to_handle));
        values.extend([handle_hinge.angle, door_hinge.rate, handle_hinge.rate]);
        values
    }

    fn object_state(&self, view: &TaskView) -> Option<Vec<(String, f64)>> {
        let Parts { door, handle, to_door, to_handle, door_hinge, handle_hinge } = Parts::of(view);
        let mut values = named_values("door_pos", door.iter());
        values.extend(named_values("handle_pos", handle.iter()));
        values.push(("hinge_qpos".into(), door_hinge.angle));
        values.extend(named_values("door_to_eef_pos", to_door.iter()));
        values.extend(named_values("handle_to_eef_pos", to_handle.iter()));
        values.push(("handle_qpos".into(), handle_hinge.angle));
        Some(values)
    }

    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        let distance = vector_at(obs, HAND_TO_HANDLE).norm();
        let (angle, handle) = (f64::from(obs[ANGLE]), f64::from(obs[HANDLE_ANGLE]).abs());
        let success = angle > OPEN;
        let shaped = 0.25 * (reaching_reward(distance) + (handle / FRAC_PI_2).min(1.0));
        TaskOutcome {
            shaped: if success { 1.0 } else { shaped },
            success,
            stage: if success {
                3
            } else if handle > TURNED {
                2
            } else {
                usize::from(distance < 0.06)
            },
        }
    }

    /// With the door's angle, too, about which robosuite's shaping is silent until the door is open.
    fn log_shaped(&self, obs: &[f32]) -> f64 {
        let TaskOutcome { shaped, success, .. } = self.outcome(obs);
        let distance = vector_at(obs, HAND_TO_HANDLE).norm();
        let near = 0.25 * (log_reaching_reward(distance) - reaching_reward(distance));
        if success { shaped } else { shaped + near + 0.5 * f64::from(obs[ANGLE]) / OPEN }
    }

    /// Above the handle's end, down on it until it is turned, then back with it: the handle's spring presses it against the
    /// finger, and the friction between the two pulls the door open.
    ///
    /// (The handle cannot be grasped from above: the hand is wider than the gap between handle and door.)
    fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> {
        let handle = f64::from(obs[HANDLE_ANGLE]);
        let from_door = vector_at(obs, HANDLE_POSITION) - vector_at(obs, DOOR_POSITION);
        let in_door = Vector3::new(HANDLE_AXIS[0] + HANDLE_POINT[0] * handle.cos(), HANDLE_POINT[1], 0.0);
        let yaw = from_door.y.atan2(from_door.x) - in_door.y.atan2(in_door.x);
        // Horizontal directions: along the handle at rest, and away from the door.
        let along = Vector3::new(yaw.cos(), yaw.sin(), 0.0);
        let away = Vector3::new(yaw.sin(), -yaw.cos(), 0.0);
        // The handle's own directions when it is turned by an angle: to its end, and out of its upper side.
        let end = |angle: f64| along * angle.cos() - Vector3::z() * angle.sin();
        let up = |angle: f64| along * angle.sin() + Vector3::z() * angle.cos();
        // From the hand to where it rests on the handle, with its inner finger.
        let to_axis = vector_at(obs, HAND_TO_HANDLE) - end(handle) * HANDLE_POINT[0];
        let to_rest = |angle: f64| to_axis + end(angle) * 0.115 + up(angle) * 0.03 + away * 0.028;

        let way = to_rest(handle);
        // To the same distance from the handle's axis, and against its upper side.
        let hold = |press: f64| end(handle) * way.dot(&end(handle)) - up(handle) * press;
        let near = way.norm() < 0.12;
        if f64::from(obs[ANGLE]) > OPEN + 0.02 {
            let still = if near && handle > 1.0 { hold(0.015) + away * 0.015 } else { Vector3::zeros() };
            return Some(action_towards(still, 0.0));
        }
        if handle > 1.35 && near {
            return Some(action_towards(hold(0.03) + away * 0.1, 0.0));
        }
        let above = way.dot(&up(handle));
        Some(if (way - up(handle) * above).norm() < 0.025 && above > -0.03 {
            let next = (handle + 0.5).min(1.6);
            action_towards(to_rest(next) - up(next) * 0.02, 0.0)
        } else if way.xy().norm() < 0.02 {
            action_towards(way, 0.0)
        } else {
            // Up first, so that the fingers do not push against the handle from the side.
            let aside = if way.z > 0.0 { 0.5 } else { 1.0 };
            let [x, y, z, grip] = action_towards(way + Vector3::z() * 0.05, 0.0);
            [x.clamp(-1.0, 1.0) * aside, y.clamp(-1.0, 1.0) * aside, z, grip]
        })
    }

    fn drawn(&self, _setup: &Setup) -> Vec<Body> {
        vec![
            Body::solid("frame", "#7d6a55", frame()),
            Body::solid("door", "#a9805a", panel().shapes),
            Body::solid("handle", "#d9b54a", handle().shapes),
        ]
    }

    /// From the side that the door opens to.
    fn camera(&self) -> Camera {
        Camera { eye: [0.8, 0.85, 1.6], target: [-0.25, -0.2, 1.02] }
    }
}

/// The state of the door and its handle, and where they are as seen from the hand.
struct Parts {
    door: Vector3<f64>,
    handle: Vector3<f64>,
    to_door: Vector3<f64>,
    to_handle: Vector3<f64>,
    door_hinge: HingeState,
    handle_hinge: HingeState,
}

impl Parts {
    fn of(view: &TaskView) -> Self {
        let hand = view.hand.translation.vector;
        let at = |object: usize| view.physics.object_state(view.setup.objects[object]).pose;
        let hinge = |object: usize| {
            view.physics.hinge_state(view.setup.objects[object]).expect("door and handle are on hinges")
        };
        let door = at(PANEL).translation.vector;
        let handle = (at(HANDLE) * nalgebra::Point3::from(HANDLE_POINT)).coords;
        Self {
            door,
            handle,
            to_door: door - hand,
            to_handle: handle - hand,
            door_hinge: hinge(PANEL),
            handle_hinge: hinge(HANDLE),
        }
    }
}

/// A pose from position (m) and quaternion (w, x, y, z).
fn pose(position: [f64; 3], [w, x, y, z]: [f64; 4]) -> Pose {
    Pose::from_parts(Translation3::from(position), UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)))
}

/// Two posts.
fn frame() -> Vec<Primitive> {
    let post = |x: f64| Primitive { kind: PrimitiveKind::Cylinder(0.03, 0.3), pose: Pose::translation(x, 0.0, 0.0) };
    vec![post(0.045), post(0.555)]
}

/// The door itself on its hinge.
fn panel() -> Hinge {
    let principal = pose([0.029_681_6, -0.001_523_45, 0.0], [0.701_072, 0.0, 0.0, 0.713_091]);
    Hinge {
        mount: Pose::translation(0.3, 0.0, 0.0),
        point: Vector3::new(0.255, 0.0, 0.0),
        axis: Vector3::z(),
        range: [0.0, 0.4],
        damping: 0.1,
        friction: 0.0,
        stiffness: 0.0,
        inertia: Inertia::diagonal(2.434_55, [0.0; 3], [0.091_375_1, 0.052_161_5, 0.043_714]).seen_at(&principal),
        shapes: vec![Primitive::cuboid([0.22, 0.02, 0.29], [0.0; 3])],
    }
}

/// Lever, shaft and bolt in one, on a hinge with a spring.
fn handle() -> Hinge {
    let principal = pose([-0.017_762, 0.013_854_4, 0.0], [0.365_653, 0.605_347, -0.365_22, 0.605_365]);
    let across = |radius: f64, half: f64, centre: [f64; 3]| {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), FRAC_PI_2);
        Primitive {
            kind: PrimitiveKind::Cylinder(radius, half),
            pose: Pose::from_parts(Translation3::from(centre), turn),
        }
    };
    Hinge {
        mount: Pose::translation(HANDLE_AXIS[0], HANDLE_AXIS[1], HANDLE_AXIS[2]),
        point: Vector3::zeros(),
        axis: Vector3::y(),
        range: [-1.57, 1.57],
        // robosuite sets none, but there the released handle comes back as slowly as this. (Perhaps the drag of the air: MuJoCo takes
        // a body for a box of its inertia, here one of two metres.)
        damping: 0.2,
        friction: 0.1,
        stiffness: 1.0,
        inertia: Inertia::diagonal(0.1, [0.0; 3], [0.048_377_1, 0.041, 0.011_101_3]).seen_at(&principal),
        shapes: vec![
            Primitive::cuboid([0.075, 0.015, 0.02], [0.075, -0.10, 0.0]),
            across(0.025, 0.093_75, [0.0, -0.031_25, 0.0]),
            Primitive::cuboid([0.031_25, 0.012_5, 0.025], [-0.031_25, 0.05, 0.0]),
            across(0.025, 0.012_5, [-0.062_5, 0.05, 0.0]),
        ],
    }
}
