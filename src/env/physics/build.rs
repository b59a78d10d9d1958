//! The rapier world is built: the arm as a multibody, the table, the objects.
//!
//! rapier's defaults are made for metre-sized objects; with them a 4 cm cube slips out of the
//! fingers or hovers above the table. [`Physics::new`] says which settings differ, and why.

use nalgebra::{Translation3, UnitQuaternion, Vector3};
use rapier3d::math::{Matrix, Vector};
use rapier3d::prelude::*;

use super::convert::{to_rapier, to_vector};
use super::{Object, Physics, SIDES, TABLE_HALF, TABLE_TOP, TIMESTEP};
use crate::env::arm::{ArmDescription, Inertia, JOINTS, Pose, Primitive, PrimitiveKind};
use crate::env::kinematics::{GRAVITY, KinematicModel};

/// The stops of the arm's hinges are critically damped springs with the time constant of MuJoCo's (its default `solref`,
/// 0.02 s). With rigid ones, an arm that is wedged between a stop and an obstacle would store any amount of energy, to
/// release it at once.
const HINGE_STOP: SpringCoefficients<f32> = SpringCoefficients { natural_frequency: 8.0, damping_ratio: 1.0 };

impl Physics {
    /// A table with `arm` beside it, at its home posture.
    pub fn new(arm: ArmDescription) -> Self {
        let mut world = PhysicsWorld { gravity: Vector::new(0.0, 0.0, -GRAVITY as f32), ..PhysicsWorld::default() };
        let settings = &mut world.integration_parameters;
        settings.dt = TIMESTEP as f32;
        settings.num_internal_pgs_iterations = 4;
        // Contact springs scale with the mass at the contact; a cube of 64 g needs a stiff one.
        settings.contact_softness = SpringCoefficients::new(100.0, 5.0);
        // The table is a hundred times as stiff, so that an arm of many kilograms that comes down on a cube does not press it in.
        settings.static_contact_softness = SpringCoefficients::new(1000.0, 5.0);
        // Distances of centimetres would count as contact for things of centimetres.
        settings.normalized_prediction_distance = 0.002;
        settings.normalized_allowed_linear_error = 0.000_1;
        settings.normalized_max_corrective_velocity = 0.5;
        settings.contact_recycling = false;
        settings.friction_in_bias_pass = true;
        settings.max_ccd_substeps = 0;
        // Contacts of the arm always use Coulomb friction; so must those between objects.
        settings.friction_model = FrictionModel::Coulomb;

        let table_body = world.insert_body(RigidBodyBuilder::fixed().translation(Vector::new(
            0.0,
            0.0,
            (TABLE_TOP - TABLE_HALF[2]) as f32,
        )));
        let table =
            world.insert_collider(surface(collider(PrimitiveKind::Box(TABLE_HALF.into())), 1.0), Some(table_body));

        // What falls off the table stays in the room.
        world.insert_collider(surface(ColliderBuilder::new(SharedShape::halfspace(Vector::Z)), 1.0), None);

        let base = world.insert_body(RigidBodyBuilder::fixed().pose(to_rapier(&arm.base)));
        let mut parent = base;
        let mut handles = Vec::with_capacity(JOINTS + 2);
        let turn_x_to_z = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -std::f64::consts::FRAC_PI_2);
        let hinge = Pose::from_parts(Translation3::identity(), turn_x_to_z);
        let links = arm.links.each_ref().map(|link| {
            let body = world.insert_body(link_body(&link.inertia));
            for shape in &link.shapes {
                if link.collides {
                    world.insert_collider(surface(placed(shape), 1.0), Some(body));
                }
            }
            let joint = GenericJointBuilder::new(JointAxesMask::LOCKED_REVOLUTE_AXES)
                .local_frame1(to_rapier(&(link.mount * hinge)))
                .local_frame2(to_rapier(&hinge))
                .limits(JointAxis::AngX, link.range.map(|limit| limit as f32))
                .softness(HINGE_STOP);
            handles.push(world.insert_multibody_joint(parent, body, joint.build()).expect("a chain has no loops"));
            parent = body;
            body
        });
        let gripper = arm.gripper.clone();
        let mut pads = Vec::with_capacity(2);
        let mut shapes: Vec<ColliderHandle> =
            links.iter().flat_map(|link| world.bodies[*link].colliders()).copied().collect();
        let fingers = SIDES.map(|side| {
            let body = world.insert_body(link_body(&gripper.inertia));
            shapes
                .push(world.insert_collider(surface(placed(&gripper.on_side(&gripper.finger, side)), 1.0), Some(body)));
            pads.push(world.insert_collider(
                surface(placed(&gripper.on_side(&gripper.pad, side)), gripper.pad_friction),
                Some(body),
            ));
            let turn_x_to_side =
                UnitQuaternion::from_axis_angle(&Vector3::z_axis(), side * std::f64::consts::FRAC_PI_2);
            let slide = Pose::from_parts(Translation3::identity(), turn_x_to_side);
            let joint = GenericJointBuilder::new(JointAxesMask::LOCKED_PRISMATIC_AXES)
                .local_frame1(to_rapier(&(gripper.mount * slide)))
                .local_frame2(to_rapier(&slide))
                .limits(JointAxis::LinX, gripper.range.map(|limit| limit as f32));
            handles.push(
                world.insert_multibody_joint(links[JOINTS - 1], body, joint.build()).expect("a chain has no loops"),
            );
            body
        });

        let mut physics = Self {
            world,
            model: KinematicModel::new(&arm),
            base,
            links,
            fingers,
            pads: [pads[0], pads[1]],
            shapes: shapes.into_iter().chain(pads.iter().copied()).collect(),
            joints: handles.try_into().expect("seven hinges and two slides"),
            table,
            plate: [TABLE_HALF.into(), Vector3::new(0.0, 0.0, TABLE_TOP - TABLE_HALF[2])],
            arm,
        };
        physics.configure_joints();
        physics.set_joints(&physics.arm.home.clone(), [gripper.start; 2]);
        physics
    }

    /// Rotor inertia and damping. rapier counts a fixed base as a free one until the
    /// first forward kinematics; only then do the joints have their final places.
    fn configure_joints(&mut self) {
        let PhysicsWorld { bodies, colliders, multibody_joints, .. } = &mut self.world;
        for handle in self.links.iter().chain(&self.fingers) {
            bodies[*handle].recompute_mass_properties_from_colliders(colliders);
        }
        let (multibody, _) = multibody_joints.get_mut(self.joints[0]).expect("the arm is in the world");
        multibody.forward_kinematics(bodies, true);
        multibody.set_self_contacts_enabled(false);
        assert_eq!(multibody.ndofs(), JOINTS + 2, "the base is fixed");
        let gripper = &self.arm.gripper;
        let rows = self.arm.links.iter().map(|link| (link.armature, link.damping));
        for (dof, (armature, damping)) in rows.chain([(gripper.armature, gripper.damping); 2]).enumerate() {
            multibody.armature_mut()[dof] = armature as f32;
            multibody.damping_mut()[dof] = damping as f32;
        }
    }

    /// Puts a box on the scene: half extents (m), density (kg/m3), friction coefficient, pose.
    pub fn add_box(&mut self, half: [f64; 3], density: f64, friction: f64, pose: &Pose) -> Object {
        let body = self.world.insert_body(RigidBodyBuilder::dynamic().pose(to_rapier(pose)).can_sleep(false));
        let shape = collider(PrimitiveKind::Box(half.into())).density(density as f32);
        let collider = self.world.insert_collider(surface_with_density(shape, friction), Some(body));
        Object { body, collider }
    }

    /// Sets the friction coefficient of the table (1 at first).
    pub fn set_table_friction(&mut self, friction: f64) {
        self.world.colliders[self.table].set_friction(friction as f32);
    }
}

pub(super) fn link_body(inertia: &Inertia) -> RigidBodyBuilder {
    let m = inertia.tensor.map(|x| x as f32);
    let tensor = Matrix::from_cols_slice(m.as_slice());
    RigidBodyBuilder::dynamic()
        .additional_mass_properties(MassProperties::with_inertia_matrix(
            to_vector(&inertia.com),
            inertia.mass as f32,
            tensor,
        ))
        // The real arm carries its own weight; so does this one.
        .gravity_scale(0.0)
        .can_sleep(false)
}

fn collider(kind: PrimitiveKind) -> ColliderBuilder {
    match kind {
        PrimitiveKind::Box(half) => ColliderBuilder::cuboid(half.x as f32, half.y as f32, half.z as f32),
        PrimitiveKind::Capsule(radius, half) => ColliderBuilder::capsule_z(half as f32, radius as f32),
        PrimitiveKind::Cylinder(radius, half) => {
            ColliderBuilder::capsule_z((half - radius).max(0.0) as f32, radius as f32)
        }
        PrimitiveKind::Ball(radius) => ColliderBuilder::ball(radius as f32),
    }
}

pub(super) fn placed(shape: &Primitive) -> ColliderBuilder {
    collider(shape.kind).position(to_rapier(&shape.pose))
}

/// A massless surface; its body's mass is given separately.
pub(super) fn surface(collider: ColliderBuilder, friction: f64) -> ColliderBuilder {
    surface_with_density(collider.density(0.0), friction)
}

/// The rougher of two surfaces decides, as in MuJoCo; nothing bounces.
fn surface_with_density(collider: ColliderBuilder, friction: f64) -> ColliderBuilder {
    collider.friction(friction as f32).friction_combine_rule(CoefficientCombineRule::Max).restitution(0.0)
}
