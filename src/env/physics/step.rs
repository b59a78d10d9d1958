//! A physics step: motor torques, dry friction in the joints, and rapier's solver.

use nalgebra::{RealField, convert};
use rapier3d::math::Vector;
use rapier3d::prelude::*;

use super::{JointState, Physics, SIDES, TIMESTEP};
use crate::env::arm::{GripperDescription, JOINTS, JointVector};

/// Substeps of the solver in a physics step, and where an object of a few grams is squeezed between an arm of many kilograms and
/// something else: with such a ratio of masses, the solver's iterations find too small a force.
const SUBSTEPS: usize = 1;
const SUBSTEPS_SQUEEZED: usize = 12;

/// A contact force that the weight of an object does not explain, N.
const SQUEEZING: f64 = 3.0;

/// A joint limit counts as near at this distance, far more than a joint moves in one step: rad, m.
const HINGE_MARGIN: f64 = 0.1;
const SLIDE_MARGIN: f64 = 0.005;

impl Physics {
    /// Puts the arm at joint angles `q` (rad) and the fingers at `fingers` (m), at rest.
    pub fn set_joints(&mut self, q: &JointVector, fingers: [f64; 2]) {
        let now = self.joint_state();
        let PhysicsWorld { bodies, multibody_joints, .. } = &mut self.world;
        let (multibody, _) = multibody_joints.get_mut(self.joints[0]).expect("the arm is in the world");
        let mut move_by = [0.0; JOINTS + 2];
        for i in 0..JOINTS {
            move_by[i] = (q[i] - now.q[i]) as f32;
        }
        for i in 0..2 {
            move_by[JOINTS + i] = (fingers[i] - now.fingers[i]) as f32;
        }
        multibody.apply_displacements(&move_by);
        multibody.generalized_velocity_mut().fill(0.0);
        multibody.forward_kinematics(bodies, false);
        multibody.update_rigid_bodies(bodies, true);
    }

    /// Advances by one [`TIMESTEP`] under joint torques (N m) and finger forces (N, positive opens). The arm has no weight: torques are
    /// those beyond what would carry it. They are not limited here.
    pub fn step(&mut self, torques: &JointVector, finger_forces: [f64; 2]) {
        let joints = self.joint_state();
        self.watch_limits(&joints);
        let arm = &self.arm;
        let torques = JointVector::from_fn(|i, _| {
            torques[i] - dry_friction(arm.links[i].friction, arm.links[i].armature, joints.qd[i], torques[i])
        });
        let finger_forces = [0, 1].map(|i| {
            let GripperDescription { friction, armature, .. } = arm.gripper;
            finger_forces[i] - dry_friction(friction, armature, joints.finger_velocities[i], finger_forces[i])
        });
        let bodies = &mut self.world.bodies;
        let axes = self.links.map(|link| bodies[link].rotation() * Vector::Z);
        // A motor turns its link and pushes back on the link before it.
        for i in 0..JOINTS {
            let own = axes[i] * torques[i] as f32;
            let next = if i + 1 < JOINTS { axes[i + 1] * torques[i + 1] as f32 } else { Vector::ZERO };
            let link = &mut bodies[self.links[i]];
            link.reset_torques(true);
            link.reset_forces(true);
            link.add_torque(own - next, true);
        }
        for ((finger, side), force) in self.fingers.iter().zip(SIDES).zip(finger_forces) {
            let finger = &mut bodies[*finger];
            let push = finger.rotation() * Vector::Y * (side * force) as f32;
            let at = finger.center_of_mass();
            finger.reset_forces(true);
            finger.add_force(push, true);
            bodies[self.links[JOINTS - 1]].add_force_at_point(-push, at, true);
        }
        let squeezes = self.squeezes();
        self.world.integration_parameters.num_solver_iterations = if squeezes { SUBSTEPS_SQUEEZED } else { SUBSTEPS };
        // With substeps, the velocity at the end is not that of the whole step: an impact may have reversed the hand. (And an object
        // stays behind by a twelfth only.)
        let grip = if squeezes { None } else { self.grip() };
        self.world.step();
        if let Some(grip) = grip {
            grip.carry(self);
        }
    }

    /// Whether the arm squeezes an object against something else: it presses in the same direction as the object does, or, by
    /// friction, so hard that the object's weight cannot be the reason. (Across the table, a cube is pushed at right angles to the
    /// direction in which it presses on the table.)
    fn squeezes(&self) -> bool {
        let PhysicsWorld { colliders, bodies, .. } = &self.world;
        let normals = |one: ColliderHandle, pair: &ContactPair| -> Vec<Vector> {
            let sign = if pair.collider1 == one { 1.0 } else { -1.0 };
            let active = pair.manifolds().iter().filter(|manifold| !manifold.data.solver_contacts.is_empty());
            active.map(|manifold| manifold.data.normal * sign).collect()
        };
        let movable = |shape: ColliderHandle| colliders[shape].parent().is_some_and(|body| bodies[body].is_dynamic());
        self.shapes.iter().any(|part| {
            let mut objects = self.touched(*part).filter(|(other, _)| !self.shapes.contains(other) && movable(*other));
            objects.any(|(object, pair)| {
                let towards = normals(*part, pair);
                let mut others = self.touched(object).filter(|(other, _)| !self.shapes.contains(other));
                !towards.is_empty()
                    && others.any(|(_, pair)| {
                        f64::from(pair.total_impulse_magnitude()) > SQUEEZING * TIMESTEP
                            || normals(object, pair).iter().any(|on| towards.iter().any(|by| on.dot(*by) > 0.1))
                    })
            })
        })
    }

    /// The shapes near `shape`, each with the pair of the two.
    pub(super) fn touched(&self, shape: ColliderHandle) -> impl Iterator<Item = (ColliderHandle, &ContactPair)> {
        let pairs = self.world.narrow_phase.contact_pairs_with(shape);
        pairs.map(move |pair| (if pair.collider1 == shape { pair.collider2 } else { pair.collider1 }, pair))
    }

    /// Tells the solver only of those joint limits that are near: each costs it a row in every
    /// substep, however far away.
    fn watch_limits(&mut self, joints: &JointState) {
        let (multibody, _) = self.world.multibody_joints.get_mut(self.joints[0]).expect("the arm is in the world");
        let hinges = self.arm.links.iter().zip(joints.q.iter());
        let hinges = hinges.map(|(link, q)| (link.range, *q, HINGE_MARGIN, JointAxesMask::ANG_X));
        let slides = joints.fingers.map(|q| (self.arm.gripper.range, q, SLIDE_MARGIN, JointAxesMask::LIN_X));
        for (i, ([low, high], q, margin, axis)) in hinges.chain(slides).enumerate() {
            let joint = &mut multibody.link_mut(i + 1).expect("a link for each joint").joint.data;
            joint.limit_axes.set(axis, q - low < margin || high - q < margin);
        }
    }
}

/// Dry friction (N m or N) that a joint feels which moves at `velocity` under `force`: just what would
/// stop it within the step, up to `friction`. With rotor inertias this large it is as good as a row of
/// the solver, and cheaper.
pub(crate) fn dry_friction<S: RealField + Copy>(friction: S, armature: S, velocity: S, force: S) -> S {
    (armature * velocity / convert(TIMESTEP) + force).clamp(-friction, friction)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::super::convert::from_vector;
    use super::*;
    use crate::env::arm::{ArmDescription, Pose, Primitive};

    /// A ball pushes the forearm of the folded arm towards the shoulder, against the stop of the elbow. The axes of the shoulder's
    /// three joints meet in a point, so none of them yields. With a rigid stop, joints reached 100 rad/s.
    #[test]
    fn an_arm_that_is_wedged_against_a_stop_does_not_explode() {
        const RADIUS: f64 = 0.05;
        for overlap in [0.002, 0.01, 0.03] {
            let mut physics = Physics::new(ArmDescription::panda());
            let mut folded = physics.arm().home;
            folded[3] = physics.arm().links[3].range[0];
            physics.set_joints(&folded, [0.0; 2]);

            let forearm = &physics.world.bodies[physics.links[4]];
            let shape = &physics.world.colliders[forearm.colliders()[0]];
            let place = *forearm.position() * *shape.position_wrt_parent().expect("it belongs to the forearm");
            let middle = from_vector(place.translation);
            let shoulder = from_vector(physics.world.bodies[physics.links[1]].translation());
            let outwards: Vector3<f64> = (middle - shoulder).normalize();
            let radius = f64::from(shape.shape().as_capsule().expect("a capsule").radius);
            let ball = middle + outwards * (radius + RADIUS - overlap);
            physics.add_fixed(&[Primitive::ball(RADIUS, [0.0; 3])], 1.0, &Pose::translation(ball.x, ball.y, ball.z));

            let mut fastest = 0.0_f64;
            for _ in 0..800 {
                physics.step(&JointVector::zeros(), [0.0; 2]);
                fastest = fastest.max(physics.joint_state().qd.amax());
            }
            assert!(fastest < 6.0, "with {overlap} m of overlap a joint turns at {fastest} rad/s");
        }
    }
}
