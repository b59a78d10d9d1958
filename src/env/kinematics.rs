//! Forward kinematics of the arm, Jacobians of the hand, and the joint-space mass matrix, in any kind of number: the world
//! steps in f64, and dual numbers carry derivatives through the same lines.
//!
//! ```
//! use handful::env::arm::{ArmDescription, JointVector};
//! use handful::env::kinematics::KinematicModel;
//!
//! let arm = ArmDescription::panda();
//! let model = KinematicModel::new(&arm);
//! let home = model.at(&arm.home);
//! // The Jacobian is the derivative of the hand's position.
//! let mut q = arm.home;
//! q[3] += 1e-6;
//! let moved = (model.at(&q).grip.translation.vector - home.grip.translation.vector) / 1e-6;
//! assert!((moved - home.linear.column(3)).norm() < 1e-5);
//! assert!(home.coriolis(&JointVector::zeros()).norm() == 0.0);
//! ```

use nalgebra::{Isometry3, Quaternion, RealField, SMatrix, SVector, UnitQuaternion, Vector3, convert};

use super::arm::{ArmDescription, Inertia, JOINTS};

/// 3 x 7: velocity of a point, or angular velocity of a link, from joint velocities.
pub type Jacobian<S = f64> = SMatrix<S, 3, JOINTS>;

/// 7 x 7: joint-space inertia.
pub type MassMatrix<S = f64> = SMatrix<S, JOINTS, JOINTS>;

/// Downward acceleration, m/s2.
pub const GRAVITY: f64 = 9.81;

/// Everything that follows from the joint angles alone, in the world frame.
#[derive(Clone, Debug)]
pub struct Kinematics<S: RealField = f64> {
    /// Pose of each link.
    pub links: [Isometry3<S>; JOINTS],
    /// Pose of the grip site: the controlled point between the pads.
    pub grip: Isometry3<S>,
    /// Linear Jacobian of the grip site, m/rad.
    pub linear: Jacobian<S>,
    /// Angular Jacobian of the hand, rad/rad.
    pub angular: Jacobian<S>,
    /// Joint-space inertia with rotor inertias, kg m2.
    pub mass: MassMatrix<S>,
    /// Joint torques that compensate gravity, N m.
    pub gravity: SVector<S, JOINTS>,
    /// Mass, centre of mass and inertia of each link in the world frame.
    bodies: [Inertia<S>; JOINTS],
    /// Direction of each joint's axis.
    axes: [Vector3<S>; JOINTS],
}

impl<S: RealField + Copy> Kinematics<S> {
    /// Torques (N m) that the joints need to keep moving at constant velocities `qd` (rad/s):
    /// centrifugal and Coriolis forces, by the recursive Newton-Euler algorithm.
    pub fn coriolis(&self, qd: &SVector<S, JOINTS>) -> SVector<S, JOINTS> {
        let mut torque = SVector::<S, JOINTS>::zeros();
        let mut origin = self.links[0].translation.vector;
        let (mut spin, mut spin_rate, mut acceleration) = (Vector3::zeros(), Vector3::zeros(), Vector3::zeros());
        for (i, (body, link)) in self.bodies.iter().zip(&self.links).enumerate() {
            let along = link.translation.vector - origin;
            origin = link.translation.vector;
            acceleration += spin_rate.cross(&along) + spin.cross(&spin.cross(&along));
            let own = self.axes[i] * qd[i];
            spin_rate += spin.cross(&own);
            spin += own;
            let out = body.com - origin;
            let force = (acceleration + spin_rate.cross(&out) + spin.cross(&spin.cross(&out))) * body.mass;
            let moment = body.tensor * spin_rate + spin.cross(&(body.tensor * spin));
            for j in 0..=i {
                let arm = body.com - self.links[j].translation.vector;
                torque[j] += self.axes[j].dot(&(arm.cross(&force) + moment));
            }
        }
        torque
    }
}

/// Computes [`Kinematics`] for one arm. The fingers count as part of the hand, where they are at
/// reset: their 0.2 kg move by two centimetres, which the joints cannot tell.
#[derive(Clone, Debug)]
pub struct KinematicModel<S: RealField = f64> {
    base: Isometry3<S>,
    mounts: [Isometry3<S>; JOINTS],
    inertias: [Inertia<S>; JOINTS],
    armature: SVector<S, JOINTS>,
    grip_site: Isometry3<S>,
}

impl KinematicModel {
    /// The kinematics of `arm`.
    pub fn new(arm: &ArmDescription) -> Self {
        let mut inertias = arm.links.each_ref().map(|link| link.inertia);
        let gripper = &arm.gripper;
        for side in [1.0, -1.0] {
            let finger = gripper.finger_pose(side, gripper.start);
            inertias[JOINTS - 1] = inertias[JOINTS - 1].welded(&gripper.inertia.seen_at(&finger));
        }
        Self {
            base: arm.base,
            mounts: arm.links.each_ref().map(|link| link.mount),
            inertias,
            armature: SVector::from_iterator(arm.links.iter().map(|link| link.armature)),
            grip_site: arm.grip_site,
        }
    }

    /// The same arm in numbers of another kind.
    pub fn cast<S: RealField + Copy>(&self) -> KinematicModel<S> {
        let pose = |pose: &Isometry3<f64>| {
            Isometry3::from_parts(pose.translation.vector.map(convert).into(), cast_rotation(&pose.rotation))
        };
        KinematicModel {
            base: pose(&self.base),
            mounts: self.mounts.each_ref().map(pose),
            inertias: self.inertias.each_ref().map(Inertia::cast),
            armature: self.armature.map(convert),
            grip_site: pose(&self.grip_site),
        }
    }
}

impl<S: RealField + Copy> KinematicModel<S> {
    /// Adds a body to the hand, given in the frame of the grip site: what the fingers hold.
    pub fn hold(&mut self, body: &Inertia<S>) {
        let hand = &mut self.inertias[JOINTS - 1];
        *hand = hand.welded(&body.seen_at(&self.grip_site));
    }

    /// Forward kinematics, Jacobians and mass matrix at joint angles `q` (rad).
    pub fn at(&self, q: &SVector<S, JOINTS>) -> Kinematics<S> {
        let mut parent = self.base;
        let links: [Isometry3<S>; JOINTS] = std::array::from_fn(|i| {
            // Smooth at zero, unlike the general turn about a scaled axis.
            let (sin, cos) = (q[i] * convert(0.5)).sin_cos();
            let turn = UnitQuaternion::new_unchecked(Quaternion::new(cos, S::zero(), S::zero(), sin));
            parent = parent * self.mounts[i] * turn;
            parent
        });
        let grip = links[JOINTS - 1] * self.grip_site;

        let axes = links.map(|link| link.rotation * Vector3::z());
        let mut linear = Jacobian::<S>::zeros();
        let mut angular = Jacobian::<S>::zeros();
        for (j, (axis, link)) in axes.iter().zip(&links).enumerate() {
            let arm = grip.translation.vector - link.translation.vector;
            linear.set_column(j, &axis.cross(&arm));
            angular.set_column(j, axis);
        }

        // M = sum over bodies of m Jv' Jv + Jw' I Jw; body i is moved by joints 0..=i only.
        let mut mass = MassMatrix::<S>::from_diagonal(&self.armature);
        let mut gravity = SVector::<S, JOINTS>::zeros();
        let bodies: [Inertia<S>; JOINTS] = std::array::from_fn(|i| self.inertias[i].seen_at(&links[i]));
        for (i, body) in bodies.iter().enumerate() {
            let mut velocity = [Vector3::zeros(); JOINTS];
            let mut momentum = [Vector3::zeros(); JOINTS];
            for j in 0..=i {
                velocity[j] = axes[j].cross(&(body.com - links[j].translation.vector));
                momentum[j] = body.tensor * axes[j];
                gravity[j] += body.mass * convert(GRAVITY) * velocity[j].z;
            }
            for a in 0..=i {
                for b in 0..=a {
                    let m = body.mass * velocity[a].dot(&velocity[b]) + axes[a].dot(&momentum[b]);
                    mass[(a, b)] += m;
                    if a != b {
                        mass[(b, a)] += m;
                    }
                }
            }
        }
        Kinematics { links, grip, linear, angular, mass, gravity, bodies, axes }
    }
}

/// The same rotation in numbers of another kind.
pub(super) fn cast_rotation<S: RealField>(rotation: &UnitQuaternion<f64>) -> UnitQuaternion<S> {
    UnitQuaternion::new_unchecked(Quaternion { coords: rotation.coords.map(convert) })
}
