//! What the hand holds goes with it along an arc.
//!
//! The solver finds velocities, and then every body moves straight ahead by velocity times time step, except for the links of
//! the arm, which turn about their joints. An object that friction holds at the velocity of the pads would therefore stay
//! behind by the curvature of their path, half the acceleration times the square of the step, always towards the outside: a
//! hand at half a metre per second would lose its grip within seconds. [`Grip::carry`] adds what is missing.

use rapier3d::math::Vector;
use rapier3d::prelude::*;

use super::{Physics, TIMESTEP};
use crate::env::arm::JOINTS;

/// An object between both pads, and where everything was before a step.
pub(super) struct Grip {
    object: RigidBodyHandle,
    center: Vector,
    hand: Pose,
    /// The joints' axes, and a point on each.
    hinges: [(Vector, Vector); JOINTS],
}

impl Physics {
    /// The grip of the hand, if it holds something.
    pub(super) fn grip(&self) -> Option<Grip> {
        let PhysicsWorld { colliders, bodies, multibody_joints, .. } = &self.world;
        let pressed = |pad: ColliderHandle| {
            self.touched(pad).filter(|(_, pair)| pair.total_impulse_magnitude() > 0.0).map(|(other, _)| other)
        };
        let [left, right] = self.pads;
        let both = pressed(left).find(|one| pressed(right).any(|other| other == *one))?;
        // What hangs on a hinge turns about it, as the links do.
        let free =
            |body: &RigidBodyHandle| bodies[*body].is_dynamic() && multibody_joints.rigid_body_link(*body).is_none();
        let object = colliders[both].parent().filter(free)?;
        Some(Grip {
            object,
            center: bodies[object].center_of_mass(),
            hand: *bodies[self.links[JOINTS - 1]].position(),
            hinges: self.links.map(|link| (bodies[link].rotation() * Vector::Z, bodies[link].translation())),
        })
    }
}

impl Grip {
    /// After the step: moves the object by the difference between the displacement of the hand and its velocity times the step.
    pub(super) fn carry(self, physics: &mut Physics) {
        let rates = physics.joint_state().qd;
        let (mut linear, mut angular) = (Vector::ZERO, Vector::ZERO);
        for ((axis, origin), rate) in self.hinges.iter().zip(&rates) {
            linear += axis.cross(self.center - origin) * *rate as f32;
            angular += axis * *rate as f32;
        }
        let bodies = &mut physics.world.bodies;
        let hand = *bodies[physics.links[JOINTS - 1]].position();
        let turn = hand.rotation * self.hand.rotation.inverse();
        let displacement = turn * (self.center - self.hand.translation) + hand.translation - self.center;
        let dt = TIMESTEP as f32;
        let object = &mut bodies[self.object];
        let mut pose = *object.position();
        pose.translation += displacement - linear * dt;
        pose.rotation = turn * Rotation::from_scaled_axis(-angular * dt) * pose.rotation;
        object.set_position(pose, false);
    }
}
