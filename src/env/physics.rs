//! The physics under every arm task: a rapier world with one arm, a table and what stands on it.
//!
//! rapier's defaults are made for metre-sized objects; with them a 4 cm cube slips out of the
//! fingers or hovers above the table. [`Physics::new`] says which settings differ, and why.

use nalgebra::{Quaternion, Translation3, UnitQuaternion, Vector3};
use rapier3d::math::{Matrix, Pose as RapierPose, Rotation, Vector};
use rapier3d::prelude::*;

use super::arm::{ArmDescription, GripperDescription, Inertia, JOINTS, JointVector, Pose, Primitive, PrimitiveKind};
use super::kinematics::{GRAVITY, KinematicModel, Kinematics};

/// Control steps per second: how often an agent acts.
pub const CONTROL_HZ: f64 = 20.0;
/// Physics steps in one control step; the controller computes new torques in each.
pub const STEPS_PER_CONTROL: usize = 8;
/// Seconds of one physics step.
pub const TIMESTEP: f64 = 1.0 / (CONTROL_HZ * STEPS_PER_CONTROL as f64);

/// Substeps of the solver in a physics step. A grasp needs more: the hand moves on arcs, a held
/// object in straight lines from substep to substep, and the difference is slip.
const SUBSTEPS: usize = 1;
const SUBSTEPS_HOLDING: usize = 6;

/// A joint limit counts as near at this distance, far more than a joint moves in one step: rad, m.
const HINGE_MARGIN: f64 = 0.1;
const SLIDE_MARGIN: f64 = 0.005;

/// Height of the table's top, m.
pub const TABLE_TOP: f64 = 0.8;
/// Half extents of the table's plate, m.
pub const TABLE_HALF: [f64; 3] = [0.4, 0.4, 0.025];

/// An object that stands on the table.
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
    joints: [MultibodyJointHandle; JOINTS + 2],
    table: ColliderHandle,
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
    /// A table with `arm` beside it, at its home posture.
    pub fn new(arm: ArmDescription) -> Self {
        let mut world = PhysicsWorld { gravity: Vector::new(0.0, 0.0, -GRAVITY as f32), ..PhysicsWorld::default() };
        let settings = &mut world.integration_parameters;
        settings.dt = TIMESTEP as f32;
        settings.num_internal_pgs_iterations = 4;
        // Contact springs scale with the mass at the contact; a cube of 64 g needs a stiff one.
        settings.contact_softness = SpringCoefficients::new(100.0, 5.0);
        settings.static_contact_softness = settings.contact_softness;
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
                .limits(JointAxis::AngX, link.range.map(|limit| limit as f32));
            handles.push(world.insert_multibody_joint(parent, body, joint.build()).expect("a chain has no loops"));
            parent = body;
            body
        });
        let gripper = arm.gripper.clone();
        let mut pads = Vec::with_capacity(2);
        let fingers = SIDES.map(|side| {
            let body = world.insert_body(link_body(&gripper.inertia));
            world.insert_collider(surface(placed(&gripper.on_side(&gripper.finger, side)), 1.0), Some(body));
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
            joints: handles.try_into().expect("seven hinges and two slides"),
            table,
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

    /// The arm's description.
    pub fn arm(&self) -> &ArmDescription {
        &self.arm
    }

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

    /// Advances by one [`TIMESTEP`] under joint torques (N m) and finger forces (N, positive opens).
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
        self.world.integration_parameters.num_solver_iterations =
            if self.holding() { SUBSTEPS_HOLDING } else { SUBSTEPS };
        self.world.step();
    }

    /// Whether a pad touches anything.
    fn holding(&self) -> bool {
        let mut pairs = self.pads.iter().flat_map(|&pad| self.world.narrow_phase.contact_pairs_with(pad));
        pairs.any(|pair| pair.total_impulse_magnitude() > 0.0)
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

    /// Poses of the base, the links and the fingers, in this order, for drawing.
    pub fn arm_poses(&self) -> impl Iterator<Item = Pose> {
        std::iter::once(&self.base)
            .chain(&self.links)
            .chain(&self.fingers)
            .map(|body| from_rapier(self.world.bodies[*body].position()))
    }
}

/// Dry friction (N m or N) that a joint feels which moves at `velocity` under `force`: just what would
/// stop it within the step, up to `friction`. With rotor inertias this large it is as good as a row of
/// the solver, and cheaper.
fn dry_friction(friction: f64, armature: f64, velocity: f64, force: f64) -> f64 {
    (armature * velocity / TIMESTEP + force).clamp(-friction, friction)
}

fn link_body(inertia: &Inertia) -> RigidBodyBuilder {
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

fn placed(shape: &Primitive) -> ColliderBuilder {
    collider(shape.kind).position(to_rapier(&shape.pose))
}

/// A massless surface; its body's mass is given separately.
fn surface(collider: ColliderBuilder, friction: f64) -> ColliderBuilder {
    surface_with_density(collider.density(0.0), friction)
}

/// The rougher of two surfaces decides, as in MuJoCo; nothing bounces.
fn surface_with_density(collider: ColliderBuilder, friction: f64) -> ColliderBuilder {
    collider.friction(friction as f32).friction_combine_rule(CoefficientCombineRule::Max).restitution(0.0)
}

fn to_vector(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x as f32, v.y as f32, v.z as f32)
}

fn from_vector(v: Vector) -> Vector3<f64> {
    Vector3::new(v.x.into(), v.y.into(), v.z.into())
}

fn to_rapier(pose: &Pose) -> RapierPose {
    let q = pose.rotation.coords;
    RapierPose::from_parts(
        to_vector(&pose.translation.vector),
        Rotation::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32),
    )
}

fn from_rapier(pose: &RapierPose) -> Pose {
    let q = pose.rotation;
    Pose::from_parts(
        Translation3::from(from_vector(pose.translation)),
        UnitQuaternion::from_quaternion(Quaternion::new(q.w.into(), q.x.into(), q.y.into(), q.z.into())),
    )
}
