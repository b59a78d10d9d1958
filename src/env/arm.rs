//! The arm as data: links, joints, motors, gripper, collision shapes.
//!
//! Everything that makes a Panda a Panda stands in [`ArmDescription::panda`]; kinematics, controller
//! and physics read it and know no number of their own. Another seven-joint arm is another
//! description. The numbers are those of robosuite 1.5.2's Panda, which differ from the real robot's.
//!
//! ```
//! use handful::env::arm::{ArmDescription, JOINTS};
//!
//! let panda = ArmDescription::panda();
//! assert_eq!((panda.links.len(), panda.gripper.range), (JOINTS, [0.0, 0.04]));
//! let mass: f64 = panda.links.iter().map(|link| link.inertia.mass).sum();
//! assert!((mass - 14.8).abs() < 1e-9, "{mass} kg with the hand");
//! ```

use nalgebra::{Isometry3, Quaternion, SVector, Translation3, UnitQuaternion, Vector3};

pub use super::inertia::Inertia;

/// Joints of the arms described here (the gripper's two fingers not counted).
pub const JOINTS: usize = 7;

/// One number for each joint of the arm.
pub type JointVector = SVector<f64, JOINTS>;

/// A rigid placement: rotation and translation, metres.
pub type Pose = Isometry3<f64>;

/// A collision and drawing primitive, placed in the frame of its body.
#[derive(Clone, Debug)]
pub struct Primitive {
    /// Its shape.
    pub kind: PrimitiveKind,
    /// Its pose in the body's frame.
    pub pose: Pose,
}

/// The kinds of primitive; lengths in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PrimitiveKind {
    /// A box of the given half extents.
    Box(Vector3<f64>),
    /// A cylinder with rounded ends: radius, and half the length of the straight part along z.
    Capsule(f64, f64),
    /// A cylinder along z: radius and half length. As a part of a link it collides as the capsule inside it, or as a ball of its radius if it
    /// is wider than long.
    Cylinder(f64, f64),
    /// A ball of the given radius.
    Ball(f64),
}

impl Primitive {
    /// A box at `centre`.
    pub fn cuboid(half: [f64; 3], centre: [f64; 3]) -> Self {
        Self { kind: PrimitiveKind::Box(half.into()), pose: Pose::translation(centre[0], centre[1], centre[2]) }
    }

    /// A ball at `centre`.
    pub fn ball(radius: f64, centre: [f64; 3]) -> Self {
        Self { kind: PrimitiveKind::Ball(radius), pose: Pose::translation(centre[0], centre[1], centre[2]) }
    }

    /// A capsule whose axis runs from `a` to `b`.
    pub fn capsule(radius: f64, a: [f64; 3], b: [f64; 3]) -> Self {
        let (a, b) = (Vector3::from(a), Vector3::from(b));
        let axis = b - a;
        let turn = UnitQuaternion::rotation_between(&Vector3::z(), &axis)
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
        Self {
            kind: PrimitiveKind::Capsule(radius, axis.norm() / 2.0),
            pose: Pose::from_parts(Translation3::from((a + b) / 2.0), turn),
        }
    }
}

/// A hinge and the link that it carries. The hinge turns about the link frame's z axis.
#[derive(Clone, Debug)]
pub struct LinkDescription {
    /// The link frame in the parent's frame at joint angle zero.
    pub mount: Pose,
    /// Joint range, rad.
    pub range: [f64; 2],
    /// Viscous joint damping, N m s/rad.
    pub damping: f64,
    /// Dry joint friction, N m.
    pub friction: f64,
    /// Rotor inertia added to the joint, kg m2.
    pub armature: f64,
    /// Largest motor torque, N m.
    pub max_torque: f64,
    /// The link's inertia; the last link's includes the hand that is bolted to it.
    pub inertia: Inertia,
    /// Shapes of the link, for collisions and drawing.
    pub shapes: Vec<Primitive>,
    /// Whether the shapes collide (the links near the base never reach anything).
    pub collides: bool,
}

/// Two fingers on slides, each moved by its own position servo.
#[derive(Clone, Debug)]
pub struct GripperDescription {
    /// The finger frame in the last link's frame; the fingers slide along its +y and -y.
    pub mount: Pose,
    /// Finger travel, m: 0 is closed.
    pub range: [f64; 2],
    /// Finger position at reset, m.
    pub start: f64,
    /// Viscous damping, N s/m.
    pub damping: f64,
    /// Dry friction, N.
    pub friction: f64,
    /// Rotor inertia added to the slide, kg.
    pub armature: f64,
    /// Servo stiffness, N/m.
    pub stiffness: f64,
    /// Largest servo force, N.
    pub max_force: f64,
    /// How far the servo's target may move in one control step, m.
    pub target_step: f64,
    /// Inertia of one finger in the finger frame.
    pub inertia: Inertia,
    /// The finger without its pad, as the +y finger has it (the other is its mirror image in y).
    pub finger: Primitive,
    /// The rubber pad of the +y finger.
    pub pad: Primitive,
    /// Friction coefficient of the pads.
    pub pad_friction: f64,
}

/// A seven-joint arm with a two-finger gripper.
#[derive(Clone, Debug)]
pub struct ArmDescription {
    /// Its name.
    pub name: &'static str,
    /// Pose of the base in the world frame.
    pub base: Pose,
    /// Shapes of the base, for drawing.
    pub base_shapes: Vec<Primitive>,
    /// The links from the base to the hand.
    pub links: [LinkDescription; JOINTS],
    /// The controlled point (the grip site, between the pads) in the last link's frame.
    pub grip_site: Pose,
    /// The gripper.
    pub gripper: GripperDescription,
    /// The joint angles that every episode starts near, rad.
    pub home: JointVector,
    /// Standard deviation of the reset noise on each joint, rad.
    pub home_noise: f64,
}

impl ArmDescription {
    /// The Franka Emika Panda as robosuite 1.5.2 simulates it on a table task.
    pub fn panda() -> Self {
        use std::f64::consts::{FRAC_PI_2, PI};
        let about_x = |angle: f64| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), angle);
        let about_z = |angle: f64| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
        let at = |p: [f64; 3], r: UnitQuaternion<f64>| Pose::from_parts(Translation3::from(Vector3::from(p)), r);

        // Hand and gripper body are bolted to link 7, the hand turned by -45.03 degrees.
        let hand = at([0.0, 0.0, 0.1065], UnitQuaternion::from_quaternion(Quaternion::new(0.924, 0.0, 0.0, -0.383)));
        let gripper_body = hand * at([0.0; 3], about_z(-FRAC_PI_2));
        let finger_mount = gripper_body * at([0.0, 0.0, 0.0524], about_z(FRAC_PI_2));

        let link7 = Inertia::diagonal(0.5, [0.0, 0.0, 0.08], [0.05; 3])
            .welded(&Inertia::diagonal(0.5, [0.0; 3], [0.05; 3]).seen_at(&hand))
            // Principal moments 0.09, 0.07, 0.05 in axes turned by 90 degrees about x.
            .welded(&Inertia::diagonal(0.3, [0.0, 0.0, 0.17], [0.09, 0.05, 0.07]).seen_at(&gripper_body));
        let finger_tip = at([0.0, 0.0085, 0.056], UnitQuaternion::identity());
        let finger = Inertia::diagonal(0.1, [0.0, 0.0, 0.05], [0.01, 0.01, 0.005])
            .welded(&Inertia::diagonal(0.01, [0.0; 3], [0.01; 3]).seen_at(&finger_tip));

        let palm = Primitive {
            kind: PrimitiveKind::Box(Vector3::new(0.102, 0.032, 0.046)),
            pose: gripper_body * at([0.002, 0.0, 0.020], UnitQuaternion::identity()),
        };
        let turn = about_x(FRAC_PI_2);
        let back = about_x(-FRAC_PI_2);
        let none = UnitQuaternion::identity();
        // mount, range, damping, torque limit, inertia (mass, centre of mass, moment), shapes
        let rows = [
            (
                at([0.0, 0.0, 0.333], none),
                [-2.8973, 2.8973],
                0.1,
                80.0,
                Inertia::diagonal(3.0, [0.0, 0.0, -0.07], [0.3; 3]),
                vec![
                    Primitive::capsule(0.06, [0.0, 0.0, -0.19], [0.0, 0.0, 0.0]),
                    Primitive::capsule(0.055, [0.0, -0.07, 0.0], [0.0, 0.0, 0.0]),
                ],
            ),
            (
                at([0.0; 3], back),
                [-1.7628, 1.7628],
                0.1,
                80.0,
                Inertia::diagonal(3.0, [0.0, -0.1, 0.0], [0.3; 3]),
                vec![
                    Primitive::capsule(0.055, [0.0, 0.0, 0.0], [0.0, 0.0, 0.07]),
                    Primitive::capsule(0.06, [0.0, -0.14, 0.0], [0.0, 0.0, 0.0]),
                ],
            ),
            (
                at([0.0, -0.316, 0.0], turn),
                [-2.8973, 2.8973],
                0.1,
                80.0,
                Inertia::diagonal(2.0, [0.04, 0.0, -0.05], [0.2; 3]),
                vec![
                    Primitive::capsule(0.055, [0.0, 0.0, -0.11], [0.0, 0.0, 0.0]),
                    Primitive::capsule(0.05, [0.0825, 0.0, 0.0], [0.0825, 0.06, 0.0]),
                ],
            ),
            (
                at([0.0825, 0.0, 0.0], turn),
                [-3.0718, -0.0698],
                0.1,
                80.0,
                Inertia::diagonal(2.0, [-0.04, 0.05, 0.0], [0.2; 3]),
                vec![
                    Primitive::capsule(0.05, [0.0, 0.0, 0.0], [0.0, 0.0, 0.06]),
                    Primitive::capsule(0.055, [-0.0825, 0.06, 0.0], [-0.0825, 0.12, 0.0]),
                ],
            ),
            (
                at([-0.0825, 0.384, 0.0], back),
                [-2.8973, 2.8973],
                0.1,
                80.0,
                Inertia::diagonal(2.0, [0.0, 0.0, -0.15], [0.2; 3]),
                vec![
                    Primitive::capsule(0.05, [0.0, 0.0, -0.22], [0.0, 0.0, -0.12]),
                    Primitive::capsule(0.045, [0.0, 0.06, -0.2], [0.0, 0.075, 0.0]),
                ],
            ),
            (
                at([0.0; 3], turn),
                [-0.0175, 3.7525],
                0.01,
                12.0,
                Inertia::diagonal(1.5, [0.06, 0.0, 0.0], [0.1; 3]),
                vec![
                    Primitive::capsule(0.048, [0.0, 0.0, 0.0], [0.088, 0.0, 0.0]),
                    Primitive::capsule(0.045, [0.088, 0.0, 0.0], [0.088, 0.035, 0.0]),
                ],
            ),
            (
                at([0.088, 0.0, 0.0], turn),
                [-2.8973, 2.8973],
                0.01,
                12.0,
                link7,
                vec![Primitive { kind: PrimitiveKind::Cylinder(0.044, 0.027), pose: at([0.0, 0.0, 0.08], none) }, palm],
            ),
        ];
        let mut index = 0;
        let links = rows.map(|(mount, range, damping, max_torque, inertia, shapes)| {
            index += 1;
            LinkDescription {
                mount,
                range,
                damping,
                friction: 0.1,
                armature: 5.0 / index as f64,
                max_torque,
                inertia,
                shapes,
                collides: index >= 5,
            }
        });
        Self {
            name: "panda",
            base: Pose::translation(-0.56, 0.0, 0.912),
            base_shapes: vec![
                Primitive::cuboid([0.11, 0.09, 0.07], [-0.04, 0.0, 0.07]),
                Primitive { kind: PrimitiveKind::Cylinder(0.1, 0.45), pose: at([0.0, 0.0, -0.46], none) },
            ],
            links,
            grip_site: gripper_body * at([0.0, 0.0, 0.097], none),
            gripper: GripperDescription {
                mount: finger_mount,
                range: [0.0, 0.04],
                start: 0.020_833,
                damping: 100.0,
                friction: 1.0,
                armature: 1.0,
                stiffness: 1000.0,
                max_force: 20.0,
                target_step: 0.004,
                inertia: finger,
                finger: Primitive::cuboid([0.0105, 0.00875, 0.027], [0.0, 0.01075, 0.027]),
                pad: Primitive::cuboid([0.008, 0.004, 0.008], [0.0, 0.0035, 0.041]),
                pad_friction: 2.0,
            },
            home: JointVector::from([0.0, PI / 16.0, 0.0, -5.0 * PI / 6.0, 0.0, PI - 0.2, PI / 4.0]),
            home_noise: 0.02,
        }
    }
}

impl GripperDescription {
    /// Pose of a finger in the last link's frame when it has slid to `position` (m);
    /// `side` is +1 for the finger on the mount's +y side and -1 for the other.
    pub fn finger_pose(&self, side: f64, position: f64) -> Pose {
        self.mount * Pose::translation(0.0, side * position, 0.0)
    }

    /// A shape of the +y finger as the finger on `side` has it.
    pub fn on_side(&self, shape: &Primitive, side: f64) -> Primitive {
        let mut mirrored = shape.clone();
        mirrored.pose.translation.y *= side;
        mirrored
    }
}
