//! The arm against robosuite's: kinematics, inertia, step responses, fingers, grasp.
//! The reference numbers stand in `data/reference/panda.toml` and, for the door, in `data/reference/door.toml`.

use std::f64::consts::PI;

use handful::env::arm::{ArmDescription, GripperDescription, JointVector, Pose};
use handful::env::kinematics::{GRAVITY, KinematicModel, Kinematics};
use handful::env::osc::{Goal, OperationalSpaceController};
use handful::env::physics::{Physics, STEPS_PER_CONTROL, TABLE_HALF, TABLE_TOP, TIMESTEP};
use handful::env::tabletop::{ActionKind, Door, Lift, TableOptions, Tabletop};
use handful::env::{Env, Task, World};
use handful::rng;
use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;
use serde::Deserialize;

/// robosuite's numbers are rounded to three decimals.
const KINEMATICS_TOLERANCE: f64 = 1e-3;
/// What robosuite's sums of masses round to, in N m; its gravity torques reach 25.
const GRAVITY_TOLERANCE: f64 = 3e-3;

#[derive(Deserialize)]
struct Reference {
    kinematics: Vec<KinematicsRow>,
    step_response: Vec<StepResponse>,
    gripper: Vec<GripperTrace>,
}

#[derive(Deserialize)]
#[allow(non_snake_case)]
struct KinematicsRow {
    name: String,
    q: [f64; 7],
    p: [f64; 3],
    R: [f64; 9],
    mass_diagonal: [f64; 7],
    gravity: [f64; 7],
    #[serde(default)]
    mass_off_diagonal: Vec<(usize, usize, f64)>,
    linear_jacobian: Option<[[f64; 7]; 3]>,
}

#[derive(Deserialize)]
struct StepResponse {
    action: [f32; 3],
    mm: Vec<f64>,
}

#[derive(Deserialize)]
struct GripperTrace {
    name: String,
    action: f64,
    start_mm: f64,
    target_mm: f64,
    mm: Vec<f64>,
}

fn reference() -> Reference {
    toml::from_str(include_str!("../data/reference/panda.toml")).expect("the reference file is well-formed")
}

fn close(what: &str, ours: f64, theirs: f64, tolerance: f64) {
    assert!((ours - theirs).abs() <= tolerance, "{what}: {ours} here, {theirs} in robosuite (tolerance {tolerance})");
}

fn kinematics(q: &[f64; 7]) -> Kinematics {
    KinematicModel::new(&ArmDescription::panda()).at(&JointVector::from(*q))
}

#[test]
fn kinematics_and_mass_matrix_are_those_of_robosuite() {
    let base = ArmDescription::panda().base.translation.vector;
    for row in reference().kinematics {
        let at = kinematics(&row.q);
        let (p, r) = (at.grip.translation.vector - base, at.grip.rotation.to_rotation_matrix());
        for i in 0..3 {
            close(&format!("{}: p[{i}]", row.name), p[i], row.p[i], KINEMATICS_TOLERANCE);
            for j in 0..3 {
                close(&format!("{}: R[{i},{j}]", row.name), r[(i, j)], row.R[3 * i + j], KINEMATICS_TOLERANCE);
            }
        }
        for i in 0..7 {
            close(&format!("{}: M[{i},{i}]", row.name), at.mass[(i, i)], row.mass_diagonal[i], KINEMATICS_TOLERANCE);
            close(&format!("{}: gravity[{i}]", row.name), at.gravity[i], row.gravity[i], GRAVITY_TOLERANCE);
        }
        if row.mass_off_diagonal.is_empty() {
            continue;
        }
        for i in 0..7 {
            for j in 0..i {
                let named = row.mass_off_diagonal.iter().find(|(a, b, _)| (*a - 1, *b - 1) == (j, i));
                let theirs = named.map_or(0.0, |(_, _, value)| *value);
                close(&format!("{}: M[{i},{j}]", row.name), at.mass[(i, j)], theirs, KINEMATICS_TOLERANCE);
                assert_eq!(at.mass[(i, j)], at.mass[(j, i)], "a symmetric matrix");
            }
        }
        for (i, jacobian) in row.linear_jacobian.iter().flatten().enumerate() {
            for (j, theirs) in jacobian.iter().enumerate() {
                close(&format!("{}: J[{i},{j}]", row.name), at.linear[(i, j)], *theirs, KINEMATICS_TOLERANCE);
            }
        }
    }
}

#[test]
fn jacobians_are_the_derivatives_of_the_pose() {
    let q = [0.3, -0.4, 0.5, -1.8, -0.6, 2.0, 0.7];
    let at = kinematics(&q);
    let h = 1e-6;
    for j in 0..7 {
        let moved = |by: f64| {
            let mut q = q;
            q[j] += by;
            kinematics(&q).grip
        };
        let (back, ahead) = (moved(-h), moved(h));
        let linear = (ahead.translation.vector - back.translation.vector) / (2.0 * h);
        let angular = (ahead.rotation * back.rotation.inverse()).scaled_axis() / (2.0 * h);
        assert!((linear - at.linear.column(j)).norm() < 1e-8, "linear, joint {j}");
        assert!((angular - at.angular.column(j)).norm() < 1e-8, "angular, joint {j}");
    }
}

/// The physics engine and our own equations agree: with torques tau, M qdd = tau - coriolis.
#[test]
fn the_engine_accelerates_as_the_equations_say() {
    let arm = ArmDescription::panda();
    let mut physics = Physics::new(arm.clone());
    let mut rng = rng::stream(0, "torques");
    let mut worst = 0.0_f64;
    for i in 0..200 {
        let before = physics.joint_state();
        let at = physics.kinematics(&before.q);
        // Slowly varying torques, far below the limits, that swing the arm about.
        let torques = JointVector::from_fn(|j, _| 3.0 * (0.05 * f64::from(i) + j as f64).sin() + rng::normal(&mut rng));
        physics.step(&torques, [0.0; 2]);
        let after = physics.joint_state();
        let damping = JointVector::from_fn(|j, _| arm.links[j].damping * before.qd[j]);
        let friction = JointVector::from_fn(|j, _| {
            let (link, timestep) = (&arm.links[j], handful::env::physics::TIMESTEP);
            (link.armature * before.qd[j] / timestep + torques[j]).clamp(-link.friction, link.friction)
        });
        let expected = at
            .mass
            .cholesky()
            .expect("positive definite")
            .solve(&(torques - at.coriolis(&before.qd) - damping - friction));
        let found = (after.qd - before.qd) / handful::env::physics::TIMESTEP;
        worst = worst.max((found - expected).amax());
    }
    // The engine counts in f32 and treats Coriolis forces implicitly; accelerations here reach 5 rad/s2.
    assert!(worst < 0.05, "accelerations differ by up to {worst} rad/s2");
}

fn pose_actions() -> TableOptions {
    TableOptions { action: ActionKind::Pose, horizon: Some(10_000), ..TableOptions::default() }
}

/// One control step, with the forces of the fingers as a function of their positions. Returns the last pose of the hand that
/// the controller has seen.
fn control_step(
    physics: &mut Physics,
    controller: &OperationalSpaceController,
    force: impl Fn(f64) -> f64,
) -> Isometry3<f64> {
    let mut measured = Isometry3::identity();
    for _ in 0..STEPS_PER_CONTROL {
        let joints = physics.joint_state();
        let at = physics.kinematics(&joints.q);
        measured = at.grip;
        physics.step(&controller.torques(&at, &joints.q, &joints.qd), joints.fingers.map(&force));
    }
    measured
}

/// The gripper's servo, which drives a finger to a position.
fn gripper_servo(gripper: &GripperDescription, target: f64) -> impl Fn(f64) -> f64 {
    move |q| (gripper.stiffness * (target - q)).clamp(-gripper.max_force, gripper.max_force)
}

/// The hand's path (mm from the start) under robosuite's pose action, from rest at home without noise.
fn response(action: [f32; 3], steps: usize) -> Vec<Vector3<f64>> {
    let arm = ArmDescription::panda();
    let mut physics = Physics::new(arm.clone());
    let start = physics.kinematics(&arm.home).grip;
    let mut measured = start;
    let goal = Goal { position: start.translation.vector, orientation: start.rotation };
    let mut controller = OperationalSpaceController::new(&arm, goal, arm.home);
    let lead = Vector3::from(action.map(|a| 0.05 * f64::from(a)));
    let mut path = Vec::new();
    for _ in 0..steps {
        controller.goal = Goal { position: measured.translation.vector + lead, orientation: measured.rotation };
        measured = control_step(&mut physics, &controller, |_| 0.0);
        let now = physics.kinematics(&physics.joint_state().q).grip;
        path.push((now.translation.vector - start.translation.vector) * 1e3);
    }
    path
}

#[test]
fn the_hand_follows_an_action_as_in_robosuite() {
    for StepResponse { action, mm } in reference().step_response {
        let along = Vector3::from(action.map(f64::from));
        for (i, (ours, theirs)) in response(action, mm.len()).iter().zip(&mm).enumerate() {
            close(&format!("action {action:?}, step {}: mm", i + 1), ours.dot(&along), *theirs, 2.0);
        }
    }
}

#[test]
fn the_fingers_move_as_in_robosuite() {
    let arm = ArmDescription::panda();
    for trace in reference().gripper {
        let mut physics = Physics::new(arm.clone());
        physics.set_joints(&arm.home, [trace.start_mm / 1e3; 2]);
        let home = physics.kinematics(&arm.home).grip;
        let goal = Goal { position: home.translation.vector, orientation: home.rotation };
        let controller = OperationalSpaceController::new(&arm, goal, arm.home);
        let gripper = &arm.gripper;
        let mut target = trace.target_mm / 1e3;
        for (i, theirs) in trace.mm.iter().enumerate() {
            target = (target - trace.action * gripper.target_step).clamp(0.0, 0.04);
            control_step(&mut physics, &controller, gripper_servo(gripper, target));
            for finger in physics.joint_state().fingers {
                close(&format!("{}, step {}: mm", trace.name, i + 1), finger * 1e3, *theirs, 1.0);
            }
        }
    }
}

#[derive(Deserialize)]
struct HeldOutPaths {
    path: Vec<HeldOutPath>,
}

#[derive(Deserialize)]
struct HeldOutPath {
    /// Translation and gripper's component of an action, then hand x, y, z and position of a finger.
    steps: Vec<[f64; 8]>,
}

/// Four paths of 120 control steps that served for nothing else.
#[test]
fn the_hand_follows_unseen_paths_of_robosuite() {
    let text = include_str!("../data/reference/paths.toml");
    let reference: HeldOutPaths = toml::from_str(text).expect("the reference file is well-formed");
    let arm = ArmDescription::panda();
    let gripper = &arm.gripper;
    let (mut hand, mut finger) = (Vec::new(), Vec::new());
    for path in reference.path {
        let mut physics = Physics::new(arm.clone());
        physics.set_joints(&arm.home, [gripper.start; 2]);
        let mut measured = physics.kinematics(&arm.home).grip;
        let goal = Goal { position: measured.translation.vector, orientation: measured.rotation };
        let mut controller = OperationalSpaceController::new(&arm, goal, arm.home);
        let mut opening = gripper.start;
        for [dx, dy, dz, closes, x, y, z, theirs] in path.steps {
            controller.goal = Goal {
                position: measured.translation.vector + 0.05 * Vector3::new(dx, dy, dz),
                orientation: measured.rotation,
            };
            opening = (opening - closes * gripper.target_step).clamp(0.0, 0.04);
            measured = control_step(&mut physics, &controller, gripper_servo(gripper, opening));
            let now = physics.joint_state();
            let grip = physics.kinematics(&now.q).grip.translation.vector;
            hand.push((grip - Vector3::new(x, y, z)).norm() * 1e3);
            finger.push((now.fingers[0] - theirs).abs() * 1e3);
        }
    }
    let [[hand_median, hand_worst], [finger_median, finger_worst]] = [hand, finger].map(|mut errors| {
        errors.sort_by(f64::total_cmp);
        [errors[errors.len() / 2], errors[errors.len() - 1]]
    });
    println!("hand {hand_median:.2} mm, at most {hand_worst:.2}; finger {finger_median:.2}, at most {finger_worst:.2}");
    assert!(hand_median < 4.0 && hand_worst < 7.5, "hand: {hand_median} mm, at most {hand_worst}");
    assert!(finger_median < 0.6 && finger_worst < 1.5, "finger: {finger_median} mm, at most {finger_worst}");
}

#[derive(Deserialize)]
struct DoorReference {
    episode: Vec<DoorEpisode>,
}

#[derive(Deserialize)]
struct DoorEpisode {
    seed: u64,
    hand: [f64; 3],
    door: [f64; 3],
    handle: [f64; 3],
    /// dx, dy, dz; then hand x, y, z, door angle, handle angle, reward.
    steps: Vec<[f64; 9]>,
}

/// Actions that press the handle down and pull the door open by the friction of a finger, in robosuite and here. Until the
/// handle is turned, positions decide; from then on the finger slides as well. (Beyond 0.2 rad it slips off here
/// and not there; the reference leaves out those steps, so it ends before the door counts as open.)
#[test]
fn a_door_is_pressed_and_begins_to_open_as_in_robosuite() {
    // The reference knows the starts of three seeds; a shake moves them.
    if rng::shake() != 0 {
        return;
    }
    let text = include_str!("../data/reference/door.toml");
    let reference: DoorReference = toml::from_str(text).expect("the reference file is well-formed");
    // Hand (mm), door (rad), handle (rad), reward: the largest deviations until the handle is turned, and after.
    let mut worst = [[0.0_f64; 4]; 2];
    for episode in reference.episode {
        let mut env = Tabletop::new(Door, pose_actions()).expect("options for the door");
        let start = env.reset(episode.seed);
        for (at, theirs) in [(0, episode.hand), (10, episode.door), (13, episode.handle)] {
            for i in 0..3 {
                close(
                    &format!("seed {}, start, number {}", episode.seed, at + i),
                    start[at + i].into(),
                    theirs[i],
                    2e-4,
                );
            }
        }
        for [dx, dy, dz, x, y, z, door, handle, reward] in episode.steps {
            let step = env.step(&[dx as f32, dy as f32, dz as f32, 0.0, 0.0, 0.0, 0.0]).expect("a valid action");
            let obs = &step.observation;
            let hand = (Vector3::new(obs[0], obs[1], obs[2]).cast() - Vector3::new(x, y, z)).norm() * 1e3;
            let (ours_door, ours_handle): (f64, f64) = (obs[16].into(), obs[23].into());
            let now = [hand, ours_door - door, ours_handle - handle, f64::from(step.reward) - reward];
            for (worst, now) in worst[usize::from(handle > 1.2)].iter_mut().zip(now) {
                *worst = worst.max(now.abs());
            }
        }
    }
    println!("{worst:.3?}");
    for (worst, most) in worst.iter().zip([[8.0, 0.005, 0.12, 0.005], [15.0, 0.02, 0.25, 0.03]]) {
        assert!(worst.iter().zip(most).all(|(worst, most)| *worst < most), "{worst:.3?} exceeds {most:?}");
    }
}

#[test]
fn without_an_action_the_arm_holds_still() {
    let mut env = Tabletop::new(Lift, pose_actions()).expect("options for lift");
    env.reset(0);
    let start = env.hand().expect("a hand");
    for _ in 0..200 {
        env.step(&[0.0; 7]).expect("a valid action");
    }
    let now = env.hand().expect("a hand");
    let drift = (Vector3::from(now) - Vector3::from(start)).norm();
    assert!(drift < 1e-3, "the hand drifted {:.3} mm in 200 steps", drift * 1e3);
}

/// A grasped cube, the hand above the table.
fn grasped(seed: u64) -> Tabletop {
    let mut env = Tabletop::new(Lift, TableOptions { horizon: Some(10_000), ..TableOptions::default() })
        .expect("options for lift");
    let policy = Task::Lift.scripted_policy(TableOptions::default()).expect("lift has one");
    let mut obs = env.reset(seed);
    for _ in 0..60 {
        obs = env.step(&policy(&obs)).expect("a valid action").observation;
    }
    env
}

/// What a cube in the hand does while the hand moves to and fro at full speed: how far it slips (mm) and turns (degrees),
/// how deep the pads sink in (mm), and the force of the weaker pad (N), for ten grasps and three directions.
#[test]
fn a_grasped_cube_does_not_slip() {
    let shaken = |(seed, axis): (u64, usize)| -> [f64; 4] {
        let mut env = grasped(seed);
        let cube = env.setup().objects[0];
        let in_hand = |env: &Tabletop| -> Pose {
            let physics = env.physics();
            let hand = physics.kinematics(&physics.joint_state().q).grip;
            hand.inverse() * physics.object_state(cube).pose
        };
        let start = in_hand(&env);
        for step in 0..100 {
            let mut action = [0.0, 0.0, 0.0, 1.0];
            // Never down to the table.
            action[axis] = if (step / 10) % 2 == 0 || env.compact()[2] < 0.88 { 1.0 } else { -1.0 };
            env.step(&action).expect("a valid action");
        }
        let end = in_hand(&env);
        let slip = (end.translation.vector - start.translation.vector).norm() * 1e3;
        let turn = end.rotation.angle_to(&start.rotation).to_degrees();
        let sunk = env.physics().pad_penetrations(cube).into_iter().fold(0.0, f64::max) * 1e3;
        let force = env.physics().pad_forces(cube).into_iter().fold(f64::INFINITY, f64::min);
        [slip, turn, sunk, force]
    };
    let grasps: Vec<(u64, usize)> = (0..10).flat_map(|seed| (0..3).map(move |axis| (seed, axis))).collect();
    let measured: Vec<[f64; 4]> = grasps.into_par_iter().map(shaken).collect();
    let [slip, turn, sunk, force] = std::array::from_fn(|i| {
        let mut column: Vec<f64> = measured.iter().map(|row| row[i]).collect();
        column.sort_by(f64::total_cmp);
        [column[0], column[column.len() / 2], column[column.len() - 1]]
    });
    // The bounds of the worst hold with room for what 180 grasps showed: 0.4 mm, 5.6 degrees, 1.04 mm, 12.5 N. The motors press
    // with 20 N; what arrives at a pad depends on how the cube lies in the hand.
    assert!(slip[1] < 0.3 && slip[2] < 1.0, "slips, in mm: least, median, most {slip:.2?}");
    assert!(turn[1] < 1.0 && turn[2] < 10.0, "turns, in degrees: {turn:.2?}");
    assert!(sunk[1] < 1.0 && sunk[2] < 1.5, "the pads sink in, in mm: {sunk:.2?}");
    assert!(force[0] > 9.0 && (14.0..20.0).contains(&force[1]) && force[2] < 20.0, "a pad presses, in N: {force:.1?}");
}

/// The hand comes down on a cube at full speed and presses on, with fingers closed, open or moving, straight, scraping, or
/// in jabs: how deep the lowest corner of a cube is pressed into the table, m, at worst in a hundred control steps.
fn pressed_in(task: Task, seed: u64) -> f64 {
    let options = TableOptions { horizon: Some(10_000), ..TableOptions::default() };
    let World::Tabletop(mut env) = task.make_with(options).expect("an arm task") else { unreachable!("an arm task") };
    let mut rng = rng::stream(seed, "press");
    env.reset(seed);
    let cubes = env.setup().objects.clone();
    let target = cubes[seed as usize / 2 % cubes.len()];
    let (style, off_centre) = (seed / 4 % 4, [0.0, 0.01, 0.02][seed as usize / 16 % 3]);
    let side = rng::uniform(&mut rng, -PI, PI);
    let (mut pressing, mut deepest) = (None, f64::NEG_INFINITY);
    for step in 0..150 {
        let cube = env.physics().object_state(target).pose.translation.vector;
        let over = cube + Vector3::new(off_centre * side.cos(), off_centre * side.sin(), 0.09);
        let way = (over - Vector3::from(env.hand().expect("a hand"))) * 12.0;
        let grip = [1.0, 1.0, -1.0, 0.0][seed as usize % 4];
        let mut action = [way.x, way.y, way.z, grip];
        if way.norm() < 0.12 || step == 50 {
            pressing = pressing.or(Some(step));
        }
        if let Some(since) = pressing {
            if step == since + 100 {
                break;
            }
            action[2] = -1.0;
            let t = f64::from(step);
            match style {
                1 => (action[0], action[1]) = ((0.3 * t).sin(), (0.23 * t).cos()),
                2 => {
                    (action[0], action[1]) = (way.x + 0.3 * rng::normal(&mut rng), way.y + 0.3 * rng::normal(&mut rng));
                    action[2] = if step / 5 % 2 == 0 { -1.0 } else { 0.5 };
                }
                3 => action[3] = if step / 8 % 2 == 0 { 1.0 } else { -1.0 },
                _ => {}
            }
        }
        env.step(&action.map(|a| a.clamp(-1.0, 1.0) as f32)).expect("a valid action");
        if pressing.is_some() {
            for cube in &cubes {
                let pose = env.physics().object_state(*cube).pose;
                let [x, y, z] = pose.translation.vector.into();
                // A cube that was pushed off the table lies on the floor.
                if x.abs() < TABLE_HALF[0] && y.abs() < TABLE_HALF[1] && z > TABLE_TOP - TABLE_HALF[2] {
                    let half = 0.02 * pose.rotation.to_rotation_matrix().matrix().row(2).abs().sum();
                    deepest = f64::max(deepest, TABLE_TOP - (z - half));
                }
            }
        }
    }
    deepest
}

/// As many control steps of pressing as an earlier version was tried with: there, a cube sank by up to 32 mm.
#[test]
fn no_cube_is_pressed_into_the_table() {
    let episodes: Vec<(Task, u64)> = [Task::Lift, Task::Stack, Task::Push]
        .into_iter()
        .flat_map(|task| (0..38).map(move |seed| (task, seed)))
        // Here a link, not the hand, presses on a cube, which sank by 7.3 and 3.8 mm before that was taken for squeezing, too.
        .chain([(Task::Stack, 405), (Task::Stack, 1367)])
        .collect();
    let mut depths: Vec<f64> = episodes.into_par_iter().map(|(task, seed)| pressed_in(task, seed)).collect();
    depths.sort_by(f64::total_cmp);
    // Over 72,000 control steps each, with 65 shakes, it was 2.73 mm at most.
    let worst = 1e3 * depths[depths.len() - 1];
    println!("pressed in by {worst:.2} mm");
    assert!(worst < 3.0, "pressed in by {worst:.2} mm");
}

/// Friction carries what the pads can carry, and no more: a cube falls out of a hand at rest with the acceleration
/// g - 2 mu N / m, or stays.
#[test]
fn what_is_too_heavy_slides_out_of_the_hand() {
    let mut arm = ArmDescription::panda();
    arm.gripper.pad_friction = 0.2;
    let (half, steps) = (0.02, 10);
    for density in [1000.0, 20_000.0] {
        let mut physics = Physics::new(arm.clone());
        let grip = physics.kinematics(&arm.home).grip;
        let cube = physics.add_box([half; 3], density, 0.2, &grip);
        physics.set_joints(&arm.home, [half + 1e-4; 2]);
        let goal = Goal { position: grip.translation.vector, orientation: grip.rotation };
        let controller = OperationalSpaceController::new(&arm, goal, arm.home);
        let (mut speed, mut force) = (0.0, 0.0);
        // The pads close on the cube while the first steps pass.
        for step in 0..10 + steps {
            let joints = physics.joint_state();
            let torques = controller.torques(&physics.kinematics(&joints.q), &joints.q, &joints.qd);
            physics.step(&torques, [-20.0; 2]);
            let pads: f64 = physics.pad_forces(cube).iter().sum();
            if step < 10 {
                speed = physics.object_state(cube).velocity.z;
            } else {
                force += pads / f64::from(steps);
            }
        }
        let found = -(physics.object_state(cube).velocity.z - speed) / (f64::from(steps) * TIMESTEP);
        let mass = density * (2.0 * half).powi(3);
        let expected = (GRAVITY - 0.2 * force / mass).max(0.0);
        assert!((found - expected).abs() < 0.1, "{mass:.2} kg under {force:.1} N: {found:.2} m/s2, not {expected:.2}");
    }
}

#[test]
fn pads_report_no_contact_from_5_mm_away() {
    let arm = ArmDescription::panda();
    let mut physics = Physics::new(arm.clone());
    let grip = physics.kinematics(&arm.home).grip;
    let half = 0.02;
    // A cube between the open fingers, in the air: its faces are 5 mm from the pads.
    let cube = physics.add_box([half; 3], 1000.0, 1.0, &grip);
    physics.set_joints(&arm.home, [half + 0.005 + 0.0005; 2]);
    let goal = Goal { position: grip.translation.vector, orientation: grip.rotation };
    let controller = OperationalSpaceController::new(&arm, goal, arm.home);
    for _ in 0..2 {
        let joints = physics.joint_state();
        let torques = controller.torques(&physics.kinematics(&joints.q), &joints.q, &joints.qd);
        physics.step(&torques, [0.0; 2]);
        assert_eq!(physics.pad_forces(cube), [0.0; 2], "5 mm is not contact");
    }
    // The same pads do report contact when they close.
    for _ in 0..40 {
        let joints = physics.joint_state();
        let torques = controller.torques(&physics.kinematics(&joints.q), &joints.q, &joints.qd);
        physics.step(&torques, [-20.0; 2]);
    }
    assert!(physics.pad_forces(cube).iter().all(|force| *force > 5.0), "closed pads touch");
}
