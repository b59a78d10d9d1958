//! A table task of one's own, written with what is public, enters everything that ours enter.

use handful::env::arm::Primitive;
use handful::env::physics::Physics;
use handful::env::scene::Body;
use handful::env::tabletop::helpers::{
    action_towards, cube_features, difference_features, object_values, pose_on_table, reaching_reward, vector_at,
};
use handful::env::tabletop::{
    ActionKind, HAND_VELOCITY, ObservationKind, Setup, TableTask, Tabletop, TaskOutcome, TaskView,
};
use handful::nalgebra::Vector3;
use handful::prelude::*;
use handful::rng::Rng;

const CUBE: usize = HAND_VELOCITY.end;
const HAND_TO_CUBE: usize = CUBE + 12;

/// Bring the fingertips to a point just above a cube of any size.
#[derive(Clone)]
struct Touch {
    name: String,
    half: f64,
    /// Bodies that it leaves out of the drawing, and numbers that it observes too many: mistakes to be found.
    forgotten: usize,
    superfluous: usize,
}

impl Touch {
    fn new(half: f64) -> Self {
        Self { name: format!("touch-{:.0}-mm", 2000.0 * half), half, forgotten: 0, superfluous: 0 }
    }

    fn way(&self, obs: &[f32]) -> Vector3<f64> {
        vector_at(obs, HAND_TO_CUBE) + Vector3::z() * (self.half + 0.01)
    }
}

impl TableTask for Touch {
    fn name(&self) -> &str {
        &self.name
    }

    fn horizon(&self) -> usize {
        60
    }

    fn stages(&self) -> Vec<String> {
        vec!["near".into(), format!("on a cube of {:.0} mm", 2000.0 * self.half)]
    }

    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup {
        let pose = pose_on_table(rng, 0.1, self.half, 0.0);
        Setup { objects: vec![physics.add_box([self.half; 3], 1000.0, 1.0, &pose)], goal: None }
    }

    fn features(&self) -> Vec<Feature> {
        cube_features("cube").chain(difference_features("hand", "cube")).collect()
    }

    fn observe(&self, view: &TaskView) -> Vec<f64> {
        let mut values = object_values(view, 0);
        values.extend((Vector3::new(values[0], values[1], values[2]) - view.hand.translation.vector).iter());
        values.extend(vec![0.0; self.superfluous]);
        values
    }

    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        let distance = self.way(obs).norm();
        let (near, success) = (distance < 0.05, distance < 0.015);
        TaskOutcome { shaped: reaching_reward(distance), success, stage: usize::from(near) + usize::from(success) }
    }

    fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> {
        let way = self.way(obs);
        // From above: a finger that comes from the side tips the cube over.
        Some(action_towards(way + Vector3::z() * way.xy().norm(), 0.0))
    }

    fn drawn(&self, _setup: &Setup) -> Vec<Body> {
        let cube = Body::solid("cube", "#8a5cd0", vec![Primitive::cuboid([self.half; 3], [0.0; 3])]);
        std::iter::repeat_n(cube, 1 - self.forgotten).collect()
    }
}

fn touch() -> Tabletop {
    Tabletop::new(Touch::new(0.025), TableOptions::default()).expect("a task in order")
}

#[test]
fn its_script_solves_it() {
    for seed in 0..10 {
        let mut env = touch();
        let mut obs = env.reset(seed);
        let last = loop {
            let action = env.scripted_action(&obs).expect("touch has a script");
            assert_eq!(action, env.scripted_policy().expect("touch has a script")(&obs));
            let step = env.step(&action).expect("a valid action");
            if step.done() {
                break step;
            }
            obs = step.observation;
        };
        assert!(last.success && last.stage == 2, "seed {seed}");
    }
}

#[test]
fn its_spec_is_what_it_says() {
    let env = touch();
    let spec = env.spec();
    assert_eq!((spec.name.as_str(), spec.horizon, spec.observation_size()), ("touch-50-mm", 60, 21));
    assert_eq!(spec.stages, ["near", "on a cube of 50 mm"]);
    assert!(spec.observation.iter().any(|feature| feature.cube.is_some()));
    let options = TableOptions { action: ActionKind::Pose, horizon: Some(7), ..TableOptions::default() };
    let env = Tabletop::new(Touch::new(0.02), options).expect("a task in order");
    assert_eq!((env.spec().action_size, env.spec().horizon), (7, 7));
}

#[test]
fn its_reward_follows_from_observations_and_its_state_can_be_restored() {
    let mut env = World::from(touch());
    assert!(env.is_known());
    let mut obs = env.reset(3);
    let half_way: Vec<f32> = vec![0.4, -0.2, -0.5, 0.0];
    for _ in 0..10 {
        obs = env.step(&half_way).expect("a valid action").observation;
    }
    let state = env.snapshot();
    let step = env.step(&half_way).expect("a valid action");
    assert_eq!(env.reward(&obs, &half_way, &step.observation), step.reward);
    env.step(&[1.0; 4]).expect("a valid action");
    env.restore(&state);
    assert_eq!(env.step(&half_way).expect("a valid action"), step);
}

#[test]
fn it_is_drawn() {
    let mut env = touch();
    let obs = env.reset(1);
    let (scene, poses) = (env.scene(), env.poses());
    assert_eq!(scene.len(), poses.len());
    assert_eq!(scene.last().expect("bodies").name, "cube");
    let cube = poses.last().expect("bodies").translation.vector;
    assert!((cube - vector_at(&obs, CUBE)).norm() < 1e-6);
    let drawn = env.position_of(&obs).expect("the hand");
    assert!((Vector3::from(drawn) - Vector3::from(env.hand().expect("the hand"))).norm() < 1e-6);
}

#[test]
fn many_run_side_by_side() {
    let mut envs = VectorEnv::new(3, touch);
    envs.reset(&[1, 2, 3]).expect("in order");
    let actions = vec![Some(vec![0.5, 0.5, 0.0, 0.0]); 3];
    for i in 1..=60 {
        let steps = envs.step(&actions).expect("in order");
        assert!(steps.iter().flatten().all(|step| step.truncated == (i == 60)));
    }
}

#[test]
fn what_does_not_fit_together_is_refused_when_it_is_made() {
    let robosuite = TableOptions { observation: ObservationKind::Robosuite, ..TableOptions::default() };
    let forgetful = Touch { forgotten: 1, ..Touch::new(0.025) };
    let talkative = Touch { superfluous: 2, ..Touch::new(0.025) };
    let never = TableOptions { horizon: Some(0), ..TableOptions::default() };
    for (task, options, expected) in [
        (
            Touch::new(0.025),
            robosuite,
            "touch-50-mm: there is no robosuite observation of it (`TableTask::object_state`)",
        ),
        (forgetful, TableOptions::default(), "touch-50-mm: `drawn` gives 0 bodies, objects and goal together are 1"),
        (talkative, TableOptions::default(), "touch-50-mm: `observe` gives 17 numbers, `features` names 15"),
        (Touch::new(0.025), never, "`env.horizon` is 0; it must lie in 1..=10000"),
    ] {
        let error = Tabletop::new(task, options).expect_err(expected);
        assert!(matches!(error, Error::Config(_)));
        assert_eq!(error.to_string(), expected);
    }
}

/// Our own tasks' robosuite observations do not tell the reward, nor what the script would do.
#[test]
fn what_observations_do_not_tell_can_be_asked() {
    let robosuite = TableOptions { observation: ObservationKind::Robosuite, ..TableOptions::default() };
    let mut env = Task::Lift.make_with(robosuite).expect("lift is robosuite's");
    let obs = env.reset(0);
    assert!(!env.is_known());
    let table = env.tabletop().expect("an arm task");
    assert!(table.scripted_action(&obs).is_none() && table.scripted_policy().is_none());
    assert!(Task::Pendulum.make().is_known());
}

/// Registered, it is planned in by the oracle, acted in by its script, trained on, and drawn, all by name.
#[test]
fn it_is_run_by_name() {
    let touch = Touch::new(0.02);
    let name = touch.name.clone();
    let registry = Registry::standard()
        .env(EnvEntry::table_task(touch))
        .preset("script", "agent = \"scripted\"\nsteps = 0\ntest_episodes = 5\n")
        .preset(
            "planner",
            "agent = \"oracle\"\nsteps = 0\n[oracle.control]\naction_repeat = 2\n\
             [oracle.planner.icem]\nhorizon = 6\npopulation = 16\nelites = 4\niterations = 2\n",
        )
        .preset(
            "small",
            "agent = \"sac\"\nsteps = 120\nevaluation_episodes = 1\ntest_episodes = 2\n[sac]\nhidden = [8]\n",
        );
    let folder = tempfile::tempdir().expect("a folder");
    for method in ["script", "small"] {
        let config = registry.config(&name, method, 0, None, None).expect("a preset");
        let mut run = registry.open_run(&config, &folder.path().join(method)).expect("a new run");
        let test = loop {
            if let handful::study::run::Event::Tested(test) = run.step().expect("a healthy run") {
                break test.summary();
            }
        };
        assert!(method == "small" || test.success == 1.0, "the script solves it: {test:?}");
    }
    let config = registry.config(&name, "planner", 0, None, None).expect("a preset");
    let mut oracle = registry.method(&config).expect("an oracle");
    let mut evaluator = Evaluator::new(|| registry.make_env(&config)).expect("the task");
    let evaluation = evaluator.evaluate(&mut oracle, 1, EvalSeeds::Test).expect("valid actions");
    let first_half = |range: std::ops::Range<usize>| evaluation.episodes[0].rewards[range].iter().sum::<f32>();
    assert!(first_half(30..60) > first_half(0..30), "it comes nearer");
}
