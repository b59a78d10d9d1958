//! What a world or a policy of one's own may get wrong is an error that says so, and neither a panic nor a silent failure.

use std::sync::atomic::{AtomicUsize, Ordering};

use handful::env::{arm::Pose, scene::Body};
use handful::prelude::*;
use handful::watch::Recording;

/// A point on a line, whose reward is its distance from zero, negative.
pub(super) struct Line {
    spec: Spec,
    x: f32,
    elapsed: usize,
    /// Whether it refuses steps after its time limit.
    strict: bool,
    poses: Vec<Pose>,
}

pub(super) fn line(horizon: usize) -> Line {
    let spec = Spec::new("line", [Feature::new("x")], 1, horizon, 0.1);
    Line { spec, x: 0.0, elapsed: 0, strict: false, poses: Vec::new() }
}

impl Env for Line {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        (self.x, self.elapsed) = (handful::rng::uniform(&mut handful::rng::stream(seed, "line"), -1.0, 1.0) as f32, 0);
        vec![self.x]
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        self.spec.check_action(action)?;
        if self.strict && self.elapsed >= self.spec.horizon {
            return Err(Error::action("line", "the episode is over"));
        }
        self.elapsed += 1;
        self.x += 0.2 * action[0].clamp(-1.0, 1.0);
        Ok(Step::new(vec![self.x], -self.x.abs()).truncated(self.elapsed >= self.spec.horizon))
    }

    fn scene(&self) -> Vec<Body> {
        vec![Body::goal(0.1)]
    }

    fn poses(&self) -> Vec<Pose> {
        self.poses.clone()
    }
}

impl Snapshot for Line {
    type State = (f32, usize);

    fn snapshot(&self) -> Self::State {
        (self.x, self.elapsed)
    }

    fn restore(&mut self, state: &Self::State) {
        (self.x, self.elapsed) = *state;
    }
}

/// Plans look beyond the time limit. An oracle that got no returns there would act at random, and look like a bad planner.
#[test]
fn an_oracle_needs_a_world_that_goes_on_after_its_time_limit() {
    for strict in [false, true] {
        let make = || Ok(Line { strict, ..line(5) });
        let mut oracle = Oracle::new(make, OracleConfig::default(), 0).expect("usable settings");
        let mut evaluator = Evaluator::new(make).expect("a sound spec");
        let outcome = evaluator.evaluate(&mut oracle, 2, EvalSeeds::Test);
        match outcome {
            Ok(_) => assert!(!strict),
            Err(problem) => assert!(strict && problem.to_string().contains("the episode is over"), "{problem}"),
        }
    }
}

#[test]
fn a_policy_has_an_action_for_each_environment() {
    struct Short(usize);
    impl Agent for Short {
        fn act(&mut self, _obs: &[f32], _mode: Mode) -> Vec<f32> {
            vec![0.0]
        }
        fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
            vec![vec![0.0]; slots.len().min(self.0)]
        }
    }
    let mut evaluator = Evaluator::new(|| Ok(line(5))).expect("a sound spec");
    for (given, said) in [(0, "gave 0 actions for 1 environments"), (1, "gave 1 actions for 4 environments")] {
        let problem = evaluator.evaluate(&mut Short(given), 4, EvalSeeds::Test).expect_err("too few").to_string();
        assert!(problem.contains(said), "{problem}");
    }
    evaluator.evaluate(&mut Short(4), 4, EvalSeeds::Test).expect("enough");
    let world = Line { poses: vec![Pose::translation(0.1, 0.0, 0.0)], ..line(5) };
    let recording = Recording::of_episode("short".into(), world, &mut Short(0), 0);
    let problem = recording.map(|_| ()).expect_err("no action").to_string();
    assert!(problem.contains("an action has 1 numbers, this one has 0"), "{problem}");
}

/// Such as a simulator with three licences.
#[test]
fn an_environment_that_cannot_be_made_again_is_an_error() {
    let made = AtomicUsize::new(0);
    let make = || match made.fetch_add(1, Ordering::Relaxed) {
        0..3 => Ok(line(5)),
        _ => Err(Error::Config("no licence is left".into())),
    };
    let problem = Evaluator::new(make).map(|_| ()).expect_err("three of twenty").to_string();
    assert!(problem.contains("no licence is left"), "{problem}");
}

#[test]
fn a_replay_has_a_finite_pose_for_each_body() {
    let record = |poses: Vec<Pose>| {
        let mut still = Scripted::new(|_| vec![0.0]);
        Recording::of_episode("line".into(), Line { poses, ..line(5) }, &mut still, 0)
    };
    record(vec![Pose::translation(0.1, 0.0, 0.0)]).expect("a pose for the goal");
    for (poses, said) in [
        (vec![], "`scene` has 1 bodies, `poses` has 0"),
        (vec![Pose::translation(f64::NAN, 0.0, 0.0)], "the pose of body 0 is not finite"),
    ] {
        let problem = record(poses).expect_err("a broken contract").to_string();
        assert!(problem.contains(said), "{problem}");
    }
}

/// An agent whose decisions are longer than an episode would collect nothing to learn from, and say nothing.
#[test]
fn decisions_fit_into_an_episode() {
    let registry = Registry::standard().env(EnvEntry::new("line", || Ok(line(5))));
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("long.toml");
    for (method, agent) in [("sac", "sac"), ("dreamer", "dreamer"), ("tdmpc2", "tdmpc2"), ("pets-learned", "pets")] {
        for (repeat, fits) in [(1, true), (6, false)] {
            std::fs::write(&path, format!("[{agent}]\naction_repeat = {repeat}\n")).expect("a writable folder");
            let config = registry.config("line", method, 0, None, Some(&path)).expect("a preset");
            match registry.method(&config) {
                Ok(_) => assert!(fits, "{method}"),
                Err(problem) => {
                    let problem = problem.to_string();
                    let said = format!("{agent}: an episode of `line` has only 5 time steps");
                    assert!(!fits && problem.contains(&said), "{problem}");
                }
            }
        }
    }
}
