//! Simulators that can be differentiated: every way to a gradient leads to the same one, and good actions are found with it.

use std::f64::consts::PI;

use handful::diff::arm;
use handful::diff::derivatives::{gradient, gradient_by_differences, gradient_forward, linearise};
use handful::diff::pusher::STATE;
use handful::diff::{
    AnalyticPolicyGradient, AnalyticPolicyGradientConfig, CartPoleSwing, FreeArm, Ilqr, IlqrConfig, IlqrControl,
    PendulumSwing, Pusher, PusherTask, ReachTask, RecordedLift, RecordedPush, Solution, System,
};
use handful::env::arm::{ArmDescription, Inertia, JointVector};
use handful::env::cartpole::CartPoleState;
use handful::env::osc::{Goal, OperationalSpaceController};
use handful::env::pendulum::{Pendulum, PendulumState};
use handful::env::physics::{Physics, STEPS_PER_CONTROL};
use handful::env::scene::Body;
use handful::env::tabletop::helpers::{grasped, pose_on_table, vector_at};
use handful::env::tabletop::{
    HAND_POSITION, HAND_VELOCITY, Lift, Reach, Setup, TableOptions, TableTask, Tabletop, TaskOutcome, TaskView,
};
use handful::env::{Env, Feature, Snapshot};
use handful::plan::noise::ColoredNoise;
use handful::rng::{self, Rng, uniform};
use nalgebra::{SMatrix, SVector, Vector3};
use rayon::prelude::*;

const STEPS: usize = 50;

fn actions<const M: usize>(rng: &mut Rng) -> Vec<SVector<f64, M>> {
    (0..STEPS).map(|_| SVector::from_fn(|_, _| uniform(rng, -0.9, 0.9))).collect()
}

fn close(what: &str, a: f64, b: f64, scale: f64, tolerance: f64) {
    assert!((a - b).abs() <= tolerance * scale, "{what}: {a} and {b}, where {scale} is large");
}

/// Forward mode, reverse mode and differences of a rollout; Jacobians and differences of its first step.
fn gradients_agree<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    start: &SVector<f64, N>,
    actions: &[SVector<f64, M>],
) {
    let (_, reverse, by_start) = gradient(system, start, actions);
    let forward = gradient_forward(system, start, actions);
    let differences = gradient_by_differences(system, start, actions, 1e-6);
    let scale = reverse.iter().map(|g| g.amax()).fold(1e-9, f64::max);
    for t in 0..actions.len() {
        for i in 0..M {
            close("forward and reverse", forward[t][i], reverse[t][i], scale, 1e-10);
            close("differences and reverse", differences[t][i], reverse[t][i], scale, 1e-5);
        }
    }
    assert!(by_start.iter().all(|slope| slope.is_finite()));

    let line = linearise(system, start, &actions[0]);
    for i in 0..N {
        const H: f64 = 1e-6;
        let at = |by: f64| {
            let mut start = *start;
            start[i] += by;
            system.step(&start, &actions[0])
        };
        let column = (at(H) - at(-H)) / (2.0 * H);
        let scale = line.by_state.column(i).amax().max(1e-3);
        (0..N).for_each(|j| close("a step's Jacobian", line.by_state[(j, i)], column[j], scale, 1e-5));
    }
}

#[test]
fn every_way_to_a_gradient_leads_to_the_same_one() {
    let mut rng = rng::stream(0, "diff");
    for _ in 0..5 {
        let start = SVector::from([uniform(&mut rng, -3.0, 3.0), uniform(&mut rng, -1.0, 1.0)]);
        gradients_agree(&PendulumSwing, &start, &actions::<1>(&mut rng));
        let start = SVector::from([0; 4].map(|_| uniform(&mut rng, -1.0, 1.0)));
        gradients_agree(&CartPoleSwing, &start, &actions::<1>(&mut rng));
    }
}

/// The hand runs into the block: contact lies within the rollout.
#[test]
fn so_it_does_through_contact() {
    let mut rng = rng::stream(1, "diff");
    for _ in 0..5 {
        let task = PusherTask { pusher: Pusher::default(), goal: [0.1, uniform(&mut rng, -0.03, 0.03)] };
        let mut start = SVector::<f64, STATE>::zeros();
        start[0] = uniform(&mut rng, -0.06, -0.04);
        start[1] = uniform(&mut rng, -0.008, 0.008);
        start[4] = uniform(&mut rng, -0.3, 0.3);
        let push: Vec<_> =
            (0..STEPS).map(|_| SVector::from([uniform(&mut rng, 0.1, 0.5), uniform(&mut rng, -0.2, 0.2)])).collect();
        let (states, _) = handful::diff::roll_out(&task, &start, &push);
        let moved = states[STEPS][2].hypot(states[STEPS][3]);
        assert!(moved > 0.02, "the block is pushed, not missed: {moved} m");
        gradients_agree(&task, &start, &push);
    }
}

/// The equations are the environments' own.
#[test]
fn the_classics_are_those_of_the_environments() {
    let mut rng = rng::stream(2, "diff");
    for _ in 0..100 {
        let (angle, speed, torque) =
            (uniform(&mut rng, -3.0, 3.0), uniform(&mut rng, -7.0, 7.0), uniform(&mut rng, -1.0, 1.0));
        let mut state = PendulumState::new(angle, speed);
        state.step(2.0 * torque);
        let next = PendulumSwing.step(&SVector::from([angle, speed]), &SVector::from([torque]));
        assert_eq!([next[0], next[1]], [state.angle, state.speed]);

        let start = [0; 4].map(|_| uniform(&mut rng, -1.0, 1.0));
        let mut state = CartPoleState::new(start);
        state.step(10.0 * torque);
        let next = CartPoleSwing.step(&SVector::from(start), &SVector::from([torque]));
        assert_eq!(<[f64; 4]>::from(next), [state.position, state.velocity, state.angle, state.spin]);
    }
}

/// A single guess ends upright in two of five cases for the pendulum (nearly always for the cart-pole), the rest in local
/// minima; so the best of many counts.
#[test]
fn ilqr_swings_up_pendulum_and_cart_pole() {
    let mut rng = rng::stream(3, "diff");
    let ilqr = Ilqr::new(IlqrConfig { iterations: 300, ..IlqrConfig::default() });

    let found = best_of_guesses(&ilqr, &PendulumSwing, &SVector::from([PI, 0.0]), 100, &mut rng);
    let end = found.states[100];
    println!("pendulum: {} iterations, {} steps, cost {:.2}, end {end:?}", found.iterations, found.steps, found.cost);
    assert!(end[0].cos() > 0.99 && end[1].abs() < 0.3, "{end}");
    assert!(found.actions.iter().all(|action| action[0].abs() <= 1.0));

    let found = best_of_guesses(&ilqr, &CartPoleSwing, &SVector::from([0.0, 0.0, PI, 0.0]), 150, &mut rng);
    let end = found.states[150];
    println!("cart-pole: {} iterations, {} steps, cost {:.2}, end {end:?}", found.iterations, found.steps, found.cost);
    assert!(end[2].cos() > 0.99 && end[3].abs() < 0.5, "{end}");
    assert!(found.actions.iter().all(|action| action[0].abs() <= 1.0));
}

/// The cheapest solution from 32 small random guesses.
fn best_of_guesses<const N: usize>(
    ilqr: &Ilqr,
    system: &impl System<N, 1>,
    start: &SVector<f64, N>,
    steps: usize,
    rng: &mut Rng,
) -> Solution<N, 1> {
    let mut guess = || (0..steps).map(|_| SVector::from([0.1 * rng::normal(rng)])).collect::<Vec<_>>();
    let solutions = (0..32).map(|_| ilqr.solve(system, start, &guess()));
    solutions.min_by(|a, b| a.cost.total_cmp(&b.cost)).expect("some guesses")
}

/// From wherever the hand is, to goals all around.
#[test]
fn ilqr_pushes_the_block_to_random_goals() {
    const GOALS: usize = 100;
    let mut rng = rng::stream(4, "diff");
    let ilqr = Ilqr::new(IlqrConfig { iterations: 60, tolerance: 1e-4, ..IlqrConfig::default() });
    let mut problem = || {
        let direction = uniform(&mut rng, -PI, PI);
        let distance = uniform(&mut rng, 0.05, 0.15);
        let task =
            PusherTask { pusher: Pusher::default(), goal: [distance * direction.cos(), distance * direction.sin()] };
        let mut start = SVector::<f64, STATE>::zeros();
        let from = uniform(&mut rng, -PI, PI);
        (start[0], start[1]) = (0.07 * from.cos(), 0.07 * from.sin());
        start[4] = uniform(&mut rng, -0.78, 0.78);
        (task, start)
    };
    let problems: Vec<_> = (0..GOALS).map(|_| problem()).collect();
    let solve = |(task, start): &(PusherTask, SVector<f64, STATE>)| {
        let found = ilqr.solve(task, start, &task.guess(start, 60));
        (usize::from(task.distance(&found.states[60]) < 0.01), found.steps)
    };
    let (reached, steps) = problems.par_iter().map(solve).reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
    println!("{reached} of {GOALS} goals within 1 cm, {} steps each", steps / GOALS);
    assert!(reached >= 95, "{reached} of {GOALS} goals are reached within 1 cm");
}

/// A block that the simulator itself has pushed about is found again, from a guess that is wrong by a factor of two and more.
#[test]
fn mass_and_friction_are_found_again() {
    let truth = Pusher { mass: 0.064, friction: 0.5, ..Pusher::default() };
    let task = PusherTask { pusher: truth, goal: [0.1, 0.0] };
    let mut state = SVector::<f64, STATE>::zeros();
    (state[0], state[1]) = (-0.04, 0.006);
    let mut recording = RecordedPush::default();
    for t in 0..40 {
        recording.hand.push([state[0], state[1]]);
        recording.block.push([state[2], state[3], state[4]]);
        // A quick push, a stop, a slower one: the block slides on by itself in between.
        let speed = if t < 12 {
            0.9
        } else if t < 20 {
            -0.3
        } else {
            0.5
        };
        state = task.step(&state, &SVector::from([speed, 0.1]));
    }
    let guess = Pusher { mass: 0.15, friction: 0.2, ..truth };
    let found = recording.identify(guess).expect("a whole recording");
    println!("{found:?}");
    assert!((found.pusher.mass / truth.mass - 1.0).abs() < 0.01, "{found:?}");
    assert!((found.pusher.friction / truth.friction - 1.0).abs() < 0.01, "{found:?}");
    assert!(found.residual < 1e-5, "{found:?}");
    recording.hand[3][0] = f64::NAN;
    for (unusable, said) in [
        (RecordedPush::default(), "0 poses of the hand and 0 of the block"),
        (RecordedPush { block: vec![[0.0; 3]; 3], hand: vec![[0.0; 2]; 2] }, "2 poses of the hand and 3 of the block"),
        (recording, "not finite"),
    ] {
        let problem = unusable.identify(guess).expect_err(said).to_string();
        assert!(problem.contains(said), "{problem}");
    }
}

/// The best of many first guesses, and a little better at every step: the environment's own pendulum is swung up, whatever it
/// starts from.
#[test]
fn ilqr_controls_the_environment_with_a_receding_horizon() {
    const EPISODES: u64 = 20;
    let ilqr = Ilqr::new(IlqrConfig { iterations: 20, tolerance: 1e-4, ..IlqrConfig::default() });
    let mut world = Pendulum::default();
    let (mut total, mut steps) = (0.0, 0);
    for episode in 0..EPISODES {
        world.reset(episode);
        let state = |world: &Pendulum| SVector::from([world.snapshot().angle, world.snapshot().speed]);
        let mut rng = rng::stream(episode, "ilqr");
        let guesses = (0..32).map(|_| {
            let noise = ColoredNoise::new(2.0, 50).sample_actions(1, &mut rng);
            ilqr.solve(
                &PendulumSwing,
                &state(&world),
                &noise.into_iter().map(|a| SVector::from([a])).collect::<Vec<_>>(),
            )
        });
        let best = guesses.min_by(|a, b| a.cost.total_cmp(&b.cost)).expect("some guesses");
        let mut control = IlqrControl::new(ilqr.clone(), best.actions);
        loop {
            let (action, solution) = control.act(&PendulumSwing, &state(&world));
            steps += solution.steps;
            let step = world.step(&[action[0] as f32]).expect("an action within bounds");
            total += f64::from(step.reward) / EPISODES as f64;
            if step.done() {
                break;
            }
        }
    }
    println!("mean return {total:.1}, {} simulated steps an action", steps / (200 * EPISODES as usize));
    // The optimum depends on the start: the mean over 20 starts varies by 20.
    assert!(total > -230.0, "{total}");
}

/// Through network and simulator at once, a policy learns in seconds what takes SAC most of a minute; though in more steps.
#[test]
fn a_policy_learns_through_the_simulator() {
    let mut rng = rng::stream(5, "diff");
    let mut search = AnalyticPolicyGradient::new(&PendulumSwing, AnalyticPolicyGradientConfig::default(), &mut rng);
    while search.steps < 200_000 {
        search.update(&PendulumSwing, &mut rng);
    }
    let mut world = Pendulum::default();
    let mut total = 0.0;
    for episode in 0..20 {
        let mut obs = world.reset(episode);
        loop {
            let action = search.act(&SVector::from_column_slice(&obs));
            let step = world.step(&[action[0]]).expect("an action within bounds");
            total += f64::from(step.reward) / 20.0;
            if step.done() {
                break;
            }
            obs = step.observation;
        }
    }
    println!("mean return {total:.1}");
    assert!(total > -230.0, "{total}");
}

fn reach(seed: u64) -> (Tabletop, ReachTask) {
    let mut env = Tabletop::new(Reach, TableOptions::default()).expect("options for reach");
    env.reset(seed);
    let physics = env.physics();
    let arm = FreeArm::new(physics.arm(), &physics.joint_state().q);
    let goal = env.setup().goal.expect("reach has a goal");
    (env, ReachTask { arm, goal })
}

fn state_of(env: &Tabletop, task: &ReachTask) -> SVector<f64, { arm::STATE }> {
    let joints = env.physics().joint_state();
    task.arm.state(&joints.q, &joints.qd)
}

fn command(action: &Vector3<f64>) -> [f32; 4] {
    [action.x as f32, action.y as f32, action.z as f32, 0.0]
}

/// Two simulators, one of them rapier in f32 with fingers that slide: the hand is where the other has it, half a second later.
#[test]
fn the_free_arm_moves_as_the_world_does() {
    for seed in 0..4 {
        let (mut env, task) = reach(seed);
        let mut state = state_of(&env, &task);
        let mut rng = rng::stream(seed, "free arm");
        let direction = Vector3::from_fn(|i, _| if i == 2 { 0.5 } else { rng::uniform(&mut rng, -0.5, 0.5) });
        for step in 0..10 {
            let action = direction * (0.6 * f64::from(step)).cos();
            env.step(&command(&action)).expect("a valid action");
            state = task.arm.step(&state, &action);
        }
        let apart = (state_of(&env, &task) - state).fixed_rows::<3>(14).norm();
        assert!(apart < 5e-4, "{:.3} mm apart with seed {seed}", apart * 1e3);
    }
}

/// The derivative of the hand's motion by the first action, and by the angles that the joints start from, against differences of
/// rapier's world, which counts in f32. Dry friction, which holds a joint until a force is large enough, and the largest torques of the
/// motors have kinks that the differences would stride over: both are left out.
#[test]
fn derivatives_of_the_free_arm_are_those_of_the_world() {
    const STEPS: usize = 4;
    type Hand = Vector3<f64>;
    let mut panda = ArmDescription::panda();
    panda.links.iter_mut().for_each(|link| (link.friction, link.max_torque) = (0.0, f64::MAX));
    let mut rng = rng::stream(1, "free arm");
    let start = panda.home + JointVector::from_fn(|_, _| 0.02 * rng::normal(&mut rng));
    let action = Vector3::from_fn(|_, _| uniform(&mut rng, -0.4, 0.4));
    // The world from joint angles `q`, under the first action and then none.
    let played = |q: JointVector, first: Hand| -> Hand {
        let mut physics = Physics::new(panda.clone());
        physics.set_joints(&q, [0.0; 2]);
        let home = physics.kinematics(&panda.home).grip;
        let goal = Goal { position: home.translation.vector, orientation: home.rotation };
        let mut controller = OperationalSpaceController::new(&panda, goal, start);
        let mut seen = physics.kinematics(&q).grip;
        for step in 0..STEPS {
            let lead = if step == 0 { first } else { Hand::zeros() };
            controller.goal.position = seen.translation.vector + lead * 0.05;
            for _ in 0..STEPS_PER_CONTROL {
                let joints = physics.joint_state();
                let at = physics.kinematics(&joints.q);
                seen = at.grip;
                physics.step(&controller.torques(&at, &joints.q, &joints.qd), [0.0; 2]);
            }
        }
        physics.kinematics(&physics.joint_state().q).grip.translation.vector
    };
    let task = ReachTask { arm: FreeArm::new(&panda, &start), goal: Hand::zeros() };
    let mut state = task.arm.at_rest(&start);
    let mut by_start = SMatrix::<f64, { arm::STATE }, { arm::STATE }>::identity();
    let mut by_action = SMatrix::<f64, { arm::STATE }, 3>::zeros();
    for step in 0..STEPS {
        let line = linearise(&task, &state, &if step == 0 { action } else { Hand::zeros() });
        by_action = if step == 0 { line.by_action } else { line.by_state * by_action };
        by_start = line.by_state * by_start;
        state = line.next;
    }
    for i in 0..3 {
        let aside = Hand::ith(i, 0.05);
        let difference = (played(start, action + aside) - played(start, action - aside)) / 0.1;
        let exact: Hand = by_action.fixed_view::<3, 1>(14, i).into();
        assert!((exact - difference).norm() < 0.02 * difference.norm(), "action {i}: {exact} {difference}");
    }
    for i in 0..7 {
        let aside = JointVector::ith(i, 2e-3);
        let difference = (played(start + aside, action) - played(start - aside, action)) / 4e-3;
        let exact: Hand = by_start.fixed_view::<3, 1>(14, i).into();
        assert!((exact - difference).norm() < 0.02 * difference.norm().max(0.05), "joint {i}: {exact} {difference}");
    }
}

/// Planned once in the differentiable arm, executed in the world with the plan's own feedback.
#[test]
fn ilqr_brings_the_arm_to_random_goals() {
    const GOALS: u64 = 20;
    let arrives = |seed: u64| {
        let (mut env, task) = reach(seed);
        let ilqr = Ilqr::new(IlqrConfig { iterations: 20, tolerance: 1e-3, ..IlqrConfig::default() });
        let start = state_of(&env, &task);
        let plan = ilqr.solve(&task, &start, &task.guess(&start, 40));
        let mut success = false;
        for step in 0..60 {
            let step = step.min(plan.actions.len() - 1);
            let action = plan.actions[step] + plan.gains[step] * (state_of(&env, &task) - plan.states[step]);
            success = env.step(&command(&action.map(|a| a.clamp(-1.0, 1.0)))).expect("a valid action").success;
        }
        u64::from(success)
    };
    let reached: u64 = (0..GOALS).into_par_iter().map(arrives).sum();
    assert_eq!(reached, GOALS, "goals reached");
}

/// `lift` with a cube of any density, kg/m3.
struct LiftOf {
    density: f64,
    half: [f64; 3],
}

impl TableTask for LiftOf {
    fn name(&self) -> &str {
        "lift of"
    }
    fn horizon(&self) -> usize {
        Lift.horizon()
    }
    fn uses_gripper(&self) -> bool {
        true
    }
    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup {
        let pose = pose_on_table(rng, 0.03, self.half[2], 0.01);
        Setup { objects: vec![physics.add_box(self.half, self.density, 1.0, &pose)], goal: None }
    }
    fn features(&self) -> Vec<Feature> {
        Lift.features()
    }
    fn observe(&self, view: &TaskView) -> Vec<f64> {
        Lift.observe(view)
    }
    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        Lift.outcome(obs)
    }
    fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> {
        Lift.scripted(obs)
    }
    fn drawn(&self, setup: &Setup) -> Vec<Body> {
        Lift.drawn(setup)
    }
}

/// The mass that a scripted lift in the world tells, as a factor on the true one. Recorded are 3 s from the time on when the cube is
/// up and the hand has slowed down to 3 cm/s; where the cube sits between the fingers is seen once, at the start.
fn weighed(seed: u64, densities: [f64; 2]) -> f64 {
    let mut rng = rng::stream(seed, "weighed");
    let half = [0; 3].map(|_| uniform(&mut rng, 0.020, 0.022));
    let density = uniform(&mut rng, densities[0], densities[1]);
    let mut env = Tabletop::new(LiftOf { density, half }, TableOptions::default()).expect("options for lift");
    let mut obs = env.reset(seed);
    let arm = FreeArm::new(env.physics().arm(), &env.physics().joint_state().q);
    let mut held_at = None;
    let mut recording: Option<(RecordedLift, Vector3<f64>)> = None;
    while recording.as_ref().is_none_or(|(lift, _)| lift.steps() < 60) {
        let action = env.scripted_action(&obs).expect("a script");
        let before = env.physics().joint_state();
        let height = vector_at(&obs, HAND_POSITION.start).z;
        if grasped(&obs) && recording.is_none() {
            let up = height > *held_at.get_or_insert(height) + 0.01;
            if up && vector_at(&obs, HAND_VELOCITY.start).norm() < 0.03 {
                let hand = env.physics().kinematics(&before.q).grip;
                let cube = hand.rotation.inverse() * vector_at(&obs, obs.len() - 3);
                recording = Some((RecordedLift::from_start(before.q, before.qd), cube));
            }
        }
        let step = env.step(&action).expect("a valid action");
        if let Some((lift, _)) = &mut recording {
            let after = env.physics().joint_state();
            lift.push(vector_at(&action, 0).map(|a| a.clamp(-1.0, 1.0)), after.q, after.qd);
        }
        assert!(!step.done(), "lifted in time with seed {seed}");
        obs = step.observation;
    }
    let (lift, cube) = recording.expect("a recording");
    let found = lift.identify(&arm, &Inertia::cube(0.1, 0.021, cube)).expect("a complete recording");
    let truth = density * 8.0 * half.iter().product::<f64>();
    println!(
        "{truth:.4} kg: {:.4} kg, deviation {:.4}, residual {:.1e} rad, {} steps",
        found.body.mass, found.deviation, found.residual, found.iterations
    );
    found.body.mass / truth
}

/// From joint angles, velocities and actions alone: of the cubes of `lift`, and of others from wood to stone.
#[test]
fn the_mass_in_the_hand_is_found_from_one_lift() {
    for densities in [[1000.0; 2], [300.0, 3000.0]] {
        let off = (0..20).into_par_iter().map(|seed| (weighed(seed, densities) - 1.0).abs());
        let worst = off.reduce(|| 0.0, f64::max);
        println!("densities {densities:?}: within {:.2} %", 100.0 * worst);
        assert!(worst < 0.02, "densities {densities:?}: {worst}");
    }
}

/// Nothing recorded is an error, not a guess; a recording that is too short to tell leaves the guess with its doubt.
#[test]
fn a_recording_that_tells_nothing_says_so() {
    let panda = ArmDescription::panda();
    let arm = FreeArm::new(&panda, &panda.home);
    let guess = Inertia::cube(0.1, 0.021, Vector3::zeros());
    let mut lift = RecordedLift::from_start(panda.home, JointVector::zeros());
    let error = lift.identify(&arm, &guess).expect_err("no step").to_string();
    assert!(error.contains("no control step"), "{error}");
    lift.push(Vector3::zeros(), panda.home * f64::NAN, JointVector::zeros());
    let error = lift.identify(&arm, &guess).expect_err("not a number").to_string();
    assert!(error.contains("joint state 1"), "{error}");
}
