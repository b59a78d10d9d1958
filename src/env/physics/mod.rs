//! The rigid-body simulation under every arm task: a rapier world with one arm, a table and the objects on it.
//!
//! [`Physics::new`] builds it, [`Physics::step`] advances it, and the rest asks it for poses and contact forces. Cloning it is
//! a snapshot: the clone steps on bit for bit as the original would.
//!
//! ```
//! use handful::env::arm::{ArmDescription, JointVector, Pose};
//! use handful::env::physics::{Physics, TABLE_TOP};
//!
//! let mut physics = Physics::new(ArmDescription::panda());
//! let cube = physics.add_box([0.02; 3], 1000.0, 0.5, &Pose::translation(0.0, 0.0, TABLE_TOP + 0.05));
//! for _ in 0..160 {
//!     physics.step(&JointVector::zeros(), [0.0; 2]);
//! }
//! // After a second the cube has fallen onto the table.
//! let height = physics.object_state(cube).pose.translation.z - TABLE_TOP;
//! assert!((height - 0.02).abs() < 1e-3);
//! ```

mod build;
mod convert;
mod grip;
mod hinge;
mod step;

use nalgebra::Vector3;
use rapier3d::prelude::*;

use self::convert::{from_rapier, from_vector};
pub use self::hinge::{Hinge, HingeState};
pub(crate) use self::step::dry_friction;
use super::arm::{ArmDescription, JOINTS, JointVector, Pose};
use super::kinematics::{KinematicModel, Kinematics};

/// Control steps per second: how often an agent acts.
pub const CONTROL_HZ: f64 = 20.0;
/// Physics steps in one control step (robosuite: 25 of 2 ms); the controller computes new torques in each.
pub const STEPS_PER_CONTROL: usize = 8;
/// Seconds of one physics step.
pub const TIMESTEP: f64 = 1.0 / (CONTROL_HZ * STEPS_PER_CONTROL as f64);

/// Height of the table's top, m.
pub const TABLE_TOP: f64 = 0.8;
/// Half extents of the table's plate, m.
pub const TABLE_HALF: [f64; 3] = [0.4, 0.4, 0.025];

/// An object: a box on the table ([`Physics::add_box`]), or a part of what stands there ([`Physics::add_hinged`]).
#[derive(Clone, Copy, Debug)]
pub struct Object {
    body: RigidBodyHandle,
    collider: ColliderHandle,
}

/// Positions and velocities of the arm's joints and of the two fingers.
#[derive(Clone, Copy, Debug)]
pub struct JointState {
    /// Joint angles, rad.
    pub q: JointVector,
    /// Joint velocities, rad/s.
    pub qd: JointVector,
    /// Finger positions, m; 0 is closed.
    pub fingers: [f64; 2],
    /// Finger velocities, m/s.
    pub finger_velocities: [f64; 2],
}

/// Position, orientation and velocities of an object, world frame.
#[derive(Clone, Copy, Debug)]
pub struct ObjectState {
    /// Pose of its centre.
    pub pose: Pose,
    /// Linear velocity, m/s.
    pub velocity: Vector3<f64>,
    /// Angular velocity, rad/s.
    pub angular_velocity: Vector3<f64>,
}

/// The side of the gripper that a finger is on, in the order of every pair of fingers here.
const SIDES: [f64; 2] = [1.0, -1.0];

/// A rapier world with one arm and a table. Cloning it gives a second world that steps on exactly
/// as the first would.
pub struct Physics {
    world: PhysicsWorld,
    arm: ArmDescription,
    model: KinematicModel,
    base: RigidBodyHandle,
    links: [RigidBodyHandle; JOINTS],
    fingers: [RigidBodyHandle; 2],
    pads: [ColliderHandle; 2],
    /// All shapes of links and fingers that touch objects, pads included.
    shapes: Vec<ColliderHandle>,
    joints: [MultibodyJointHandle; JOINTS + 2],
    table: ColliderHandle,
    /// Half extents and centre of the table's plate, m.
    plate: [Vector3<f64>; 2],
}

impl Clone for Physics {
    fn clone(&self) -> Self {
        let world = &self.world;
        Self {
            // Everything that the future depends on; pipelines are workspaces and start afresh.
            world: PhysicsWorld {
                gravity: world.gravity,
                integration_parameters: world.integration_parameters,
                islands: world.islands.clone(),
                broad_phase: world.broad_phase.clone(),
                narrow_phase: world.narrow_phase.clone(),
                bodies: world.bodies.clone(),
                colliders: world.colliders.clone(),
                impulse_joints: world.impulse_joints.clone(),
                multibody_joints: world.multibody_joints.clone(),
                soft_bodies: world.soft_bodies.clone(),
                ccd_solver: world.ccd_solver.clone(),
                ..PhysicsWorld::default()
            },
            arm: self.arm.clone(),
            model: self.model.clone(),
            shapes: self.shapes.clone(),
            ..*self
        }
    }
}

impl std::fmt::Debug for Physics {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("Physics").field("joints", &self.joint_state()).finish_non_exhaustive()
    }
}

impl Physics {
    /// The arm's description.
    pub fn arm(&self) -> &ArmDescription {
        &self.arm
    }

    /// Positions and velocities of all joints.
    pub fn joint_state(&self) -> JointState {
        let (multibody, _) = self.world.multibody_joints.get(self.joints[0]).expect("the arm is in the world");
        let velocity = multibody.generalized_velocity();
        // Link 0 of the multibody is the base.
        let coordinate = |joint: usize, axis: usize| {
            f64::from(multibody.link(joint + 1).expect("a link for each joint").joint.coords()[axis])
        };
        JointState {
            q: JointVector::from_fn(|i, _| coordinate(i, JointAxis::AngX as usize)),
            qd: JointVector::from_fn(|i, _| f64::from(velocity[i])),
            fingers: [0, 1].map(|i| coordinate(JOINTS + i, JointAxis::LinX as usize)),
            finger_velocities: [0, 1].map(|i| f64::from(velocity[JOINTS + i])),
        }
    }

    /// Kinematics of the arm at joint angles `q`.
    pub fn kinematics(&self, q: &JointVector) -> Kinematics {
        self.model.at(q)
    }

    /// Where an object is and how it moves.
    pub fn object_state(&self, object: Object) -> ObjectState {
        let body = &self.world.bodies[object.body];
        ObjectState {
            pose: from_rapier(body.position()),
            velocity: from_vector(body.linvel()),
            angular_velocity: from_vector(body.angvel()),
        }
    }

    /// Force with which each pad presses on `object`, N; zero where it does not touch.
    pub fn pad_forces(&self, object: Object) -> [f64; 2] {
        self.pads.map(|pad| self.contact_force(pad, object.collider))
    }

    /// Whether two objects touch.
    pub fn touching(&self, a: Object, b: Object) -> bool {
        self.contact_force(a.collider, b.collider) > 0.0
    }

    /// Normal force between two colliders in the last step, N. (rapier lists pairs that are merely
    /// close as well; those carry no impulse.)
    fn contact_force(&self, a: ColliderHandle, b: ColliderHandle) -> f64 {
        let pair = self.world.narrow_phase.contact_pair(a, b);
        pair.map_or(0.0, |pair| f64::from(pair.total_impulse_magnitude()) / TIMESTEP)
    }

    /// Deepest penetration between each pad and `object`, m; negative where they are apart.
    pub fn pad_penetrations(&self, object: Object) -> [f64; 2] {
        self.pads.map(|pad| {
            let pair = self.world.narrow_phase.contact_pair(pad, object.collider);
            pair.and_then(|pair| pair.find_deepest_contact().map(|(_, contact)| contact.dist))
                .map_or(f64::NEG_INFINITY, |distance| -f64::from(distance))
        })
    }

    /// The table's plate: half extents and centre, m.
    pub fn table(&self) -> [Vector3<f64>; 2] {
        self.plate
    }

    /// Poses of the base, the links and the fingers, in this order, for drawing.
    pub fn arm_poses(&self) -> impl Iterator<Item = Pose> {
        std::iter::once(&self.base)
            .chain(&self.links)
            .chain(&self.fingers)
            .map(|body| from_rapier(self.world.bodies[*body].position()))
    }
}
