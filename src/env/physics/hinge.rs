//! Bodies that turn on hinges: a door on its frame, a handle on its door.

use nalgebra::{Translation3, UnitQuaternion, Vector3};
use rapier3d::prelude::*;

use super::build::{link_body, surface};
use super::convert::{to_rapier, to_vector};
use super::{Object, Physics};
use crate::env::arm::{Inertia, Pose, Primitive, PrimitiveKind};

/// A body on a hinge, in its own frame.
#[derive(Clone, Debug)]
pub struct Hinge {
    /// Where the body's frame is in the frame of the body that carries it, at angle zero.
    pub mount: Pose,
    /// A point on the axis, m.
    pub point: Vector3<f64>,
    /// The direction of the axis.
    pub axis: Vector3<f64>,
    /// The range of the angle, rad.
    pub range: [f64; 2],
    /// Viscous damping, N m s/rad.
    pub damping: f64,
    /// Dry friction, N m.
    pub friction: f64,
    /// Stiffness of a spring towards angle zero, N m/rad.
    pub stiffness: f64,
    /// Mass and inertia of the body.
    pub inertia: Inertia,
    /// Its shapes.
    pub shapes: Vec<Primitive>,
}

/// Angle and angular velocity of a body on a hinge.
#[derive(Clone, Copy, Debug)]
pub struct HingeState {
    /// Angle, rad.
    pub angle: f64,
    /// Angular velocity, rad/s.
    pub rate: f64,
}

impl Physics {
    /// Puts a body on the scene that never moves: shapes in its frame, friction coefficient, pose. As an [`Object`] it
    /// touches with its first shape.
    ///
    /// # Panics
    /// If there is no shape.
    pub fn add_fixed(&mut self, shapes: &[Primitive], friction: f64, pose: &Pose) -> Object {
        let body = self.world.insert_body(RigidBodyBuilder::fixed().pose(to_rapier(pose)));
        self.add_shapes(body, shapes, friction)
    }

    /// Hangs a body on a hinge at `carrier`, at angle zero and at rest. As an [`Object`] it touches with its first shape.
    ///
    /// Bodies on hinges do not collide with the bodies that they hang on, up to the first that is on no hinge itself; with
    /// that one and everything else they do, so that a bolt can hold a door.
    ///
    /// # Panics
    /// If there is no shape, or the axis is zero.
    pub fn add_hinged(&mut self, carrier: Object, hinge: &Hinge, friction: f64) -> Object {
        let PhysicsWorld { bodies, multibody_joints, .. } = &self.world;
        let place = *bodies[carrier.body].position();
        let hangs_itself = multibody_joints.rigid_body_link(carrier.body).is_some();
        // rapier counts the root among the bodies of a chain, which do not collide with each other; hence a root of its own.
        let parent =
            if hangs_itself { carrier.body } else { self.world.insert_body(RigidBodyBuilder::fixed().pose(place)) };
        let body = link_body(&hinge.inertia).gravity_scale(1.0).pose(place * to_rapier(&hinge.mount));
        let body = self.world.insert_body(body);
        let object = self.add_shapes(body, &hinge.shapes, friction);

        let turn = UnitQuaternion::rotation_between(&Vector3::x(), &hinge.axis)
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI));
        let axis = Pose::from_parts(Translation3::from(hinge.point), turn);
        let mut joint = GenericJointBuilder::new(JointAxesMask::LOCKED_REVOLUTE_AXES)
            .local_frame1(to_rapier(&(hinge.mount * axis)))
            .local_frame2(to_rapier(&axis))
            .limits(JointAxis::AngX, hinge.range.map(|limit| limit as f32));
        if hinge.stiffness > 0.0 {
            joint = joint.motor_model(JointAxis::AngX, MotorModel::ForceBased).motor_position(
                JointAxis::AngX,
                0.0,
                hinge.stiffness as f32,
                0.0,
            );
        }
        let handle = self.world.insert_multibody_joint(parent, body, joint.build()).expect("a chain has no loops");

        let PhysicsWorld { bodies, colliders, multibody_joints, .. } = &mut self.world;
        bodies[body].recompute_mass_properties_from_colliders(colliders);
        let (chain, link) = multibody_joints.get_mut(handle).expect("it was inserted above");
        chain.set_self_contacts_enabled(false);
        // Only now do the joints have their final places (as in `Physics::configure_joints`).
        chain.forward_kinematics(bodies, true);
        let dof = chain.link(link).expect("it was inserted above").assembly_id();
        chain.damping_mut()[dof] = hinge.damping as f32;
        chain.frictions_mut()[dof] = hinge.friction as f32;
        chain.update_rigid_bodies(bodies, true);
        object
    }

    /// Angle and angular velocity of an object on a hinge; None if it is on none.
    pub fn hinge_state(&self, object: Object) -> Option<HingeState> {
        let joints = &self.world.multibody_joints;
        let at = joints.rigid_body_link(object.body)?;
        let chain = joints.get_multibody(at.multibody)?;
        let link = chain.link(at.id)?;
        Some(HingeState {
            angle: link.joint().coords()[JointAxis::AngX as usize].into(),
            rate: chain.joint_velocity(link)[0].into(),
        })
    }

    /// Makes the table another one of the same height: half widths along x and y, and where its middle is, m.
    pub fn set_table(&mut self, half: [f64; 2], middle: [f64; 2]) {
        let [plate, centre] = &mut self.plate;
        (plate.x, plate.y, centre.x, centre.y) = (half[0], half[1], middle[0], middle[1]);
        let table = &mut self.world.colliders[self.table];
        table.set_shape(SharedShape::cuboid(plate.x as f32, plate.y as f32, plate.z as f32));
        let body = table.parent().expect("the table has a body");
        self.world.bodies[body].set_translation(to_vector(centre), false);
    }

    fn add_shapes(&mut self, body: RigidBodyHandle, shapes: &[Primitive], friction: f64) -> Object {
        let colliders: Vec<_> = shapes
            .iter()
            .map(|shape| self.world.insert_collider(surface(exact(shape), friction), Some(body)))
            .collect();
        Object { body, collider: colliders[0] }
    }
}

/// A shape whose cylinders have edges: how far a bolt reaches decides when it is free.
fn exact(shape: &Primitive) -> ColliderBuilder {
    match shape.kind {
        PrimitiveKind::Cylinder(radius, half) => {
            // rapier's cylinders stand along y.
            let upright = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::FRAC_PI_2);
            ColliderBuilder::cylinder(half as f32, radius as f32).position(to_rapier(&(shape.pose * upright)))
        }
        _ => super::build::placed(shape),
    }
}

#[cfg(test)]
mod tests {
    use rapier3d::math::Vector;

    use super::*;
    use crate::env::arm::{ArmDescription, JointVector};
    use crate::env::tabletop::{Door, TableTask};
    use crate::rng;

    /// The arm, held far away from a door with a handle.
    fn door() -> (Physics, [Object; 2]) {
        let mut physics = Physics::new(ArmDescription::panda());
        let setup = Door.place(&mut physics, &mut rng::stream(0, "reset"));
        physics.set_joints(&JointVector::from([1.5, 0.2, 0.0, -2.6, 0.0, 2.9, 0.8]), [0.0; 2]);
        (physics, [setup.objects[1], setup.objects[2]])
    }

    fn angle(physics: &Physics, object: Object) -> f64 {
        physics.hinge_state(object).expect("on a hinge").angle
    }

    /// How far the door opens in two seconds with 2 N m on its hinge, the handle held at an angle.
    fn opening(handle_angle: f64) -> f64 {
        let (mut physics, [door, handle]) = door();
        let at = *physics.world.multibody_joints.rigid_body_link(handle.body).expect("on a hinge");
        let chain = physics.world.multibody_joints.get_multibody_mut(at.multibody).expect("it exists");
        let joint = &mut chain.link_mut(at.id).expect("it exists").joint.data;
        joint.set_motor_position(JointAxis::AngX, handle_angle as f32, 200.0, 6.0);
        for step in 0..480 {
            let torque = if step < 160 { 0.0 } else { 2.0 };
            let door = &mut physics.world.bodies[door.body];
            door.reset_torques(true);
            door.add_torque(Vector::Z * torque, true);
            physics.step(&JointVector::zeros(), [0.0; 2]);
        }
        angle(&physics, door)
    }

    /// robosuite 1.5.2, measured in the same way: angle of the handle, angle of the door.
    #[test]
    fn the_bolt_holds_the_door_as_in_robosuite() {
        let held = [(0.0, 0.0148), (0.6, 0.0151), (0.8, 0.0191), (1.0, 0.0318), (1.1, 0.0455), (-1.0, 0.0318)];
        for (handle, theirs) in held {
            let ours = opening(handle);
            assert!((ours - theirs).abs() < 0.006, "handle at {handle} rad: door at {ours}, in robosuite at {theirs}");
        }
        for handle in [1.3, -1.3, 1.5] {
            let ours = opening(handle);
            assert!(ours > 0.35, "handle at {handle} rad: the door should open, it is at {ours}");
        }
    }

    /// The handle's way back from 1.5 rad, every fourth control step, and where friction stops it.
    #[test]
    fn the_handle_springs_back_as_in_robosuite() {
        let (mut physics, [_, handle]) = door();
        let at = *physics.world.multibody_joints.rigid_body_link(handle.body).expect("on a hinge");
        let PhysicsWorld { bodies, multibody_joints, .. } = &mut physics.world;
        let chain = multibody_joints.get_multibody_mut(at.multibody).expect("it exists");
        chain.apply_displacements(&[0.0, 1.5]);
        chain.forward_kinematics(bodies, false);
        chain.update_rigid_bodies(bodies, true);
        for theirs in [0.875, 0.331, 0.035, -0.026, -0.026] {
            for _ in 0..32 {
                physics.step(&JointVector::zeros(), [0.0; 2]);
            }
            let ours = angle(&physics, handle);
            assert!((ours - theirs).abs() < 0.15, "the handle is at {ours} rad, in robosuite at {theirs}");
        }
    }

    #[test]
    fn what_is_on_no_hinge_has_no_angle() {
        let mut physics = Physics::new(ArmDescription::panda());
        let cube = physics.add_box([0.02; 3], 1000.0, 1.0, &Pose::translation(0.0, 0.0, 1.0));
        assert!(physics.hinge_state(cube).is_none());
    }
}
