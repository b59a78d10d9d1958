//! The contract of an environment: each rule is enforced, and says so.

use handful::env::contract::Checked;
use handful::env::tabletop::{ObservationKind, TableOptions};
use handful::env::vector::VectorEnv;
use handful::env::{Env, Feature, Spec, Step, Task, World};
use handful::error::{Error, Result};

/// An environment that does what its script says.
struct Scripted {
    spec: Spec,
    first: Vec<f32>,
    steps: Vec<Step>,
    next: usize,
}

impl Env for Scripted {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, _seed: u64) -> Vec<f32> {
        self.next = 0;
        self.first.clone()
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        assert_eq!(action.len(), 1, "checked before");
        self.next += 1;
        Ok(self.steps[self.next - 1].clone())
    }
}

fn spec() -> Spec {
    Spec::new("scripted", [Feature::new("x"), Feature::new("v")], 1, 3, 0.1).stages(["there"])
}

fn good() -> Step {
    Step::new(vec![0.5, 0.5], 1.0)
}

fn env(steps: impl Into<Vec<Step>>) -> Checked<Scripted> {
    Checked::new(Scripted { spec: spec(), first: vec![0.0; 2], steps: steps.into(), next: 0 })
}

/// The rule that is broken by the last of `steps`, and by none before.
fn broken(steps: impl Into<Vec<Step>>) -> String {
    let mut env = env(steps);
    env.reset(0).expect("the reset is in order");
    let count = env.env().steps.len();
    for _ in 1..count {
        env.step(&[0.0]).expect("a step in order");
    }
    rule(env.step(&[0.0]))
}

fn rule<T: std::fmt::Debug>(result: Result<T>) -> String {
    match result.expect_err("a broken rule") {
        Error::Contract { env, rule } => {
            assert_eq!(env, "scripted");
            let in_order = "a step before the first reset, or after the end of an episode; reset first";
            match rule.strip_suffix(" (in the episode of `reset(0)`)") {
                Some(rule) => rule.into(),
                None if rule == in_order => rule,
                None => panic!("which episode? {rule}"),
            }
        }
        other => panic!("not the contract: {other}"),
    }
}

#[test]
fn an_environment_in_order_passes() {
    let mut env = env([good(), good().stage(1).success(true), good().truncated(true)]);
    for _ in 0..2 {
        assert_eq!(env.reset(0).expect("in order"), [0.0, 0.0]);
        for i in 0..3 {
            assert_eq!(env.step(&[0.0]).expect("in order").truncated, i == 2);
        }
    }
}

#[test]
fn each_broken_rule_is_named_with_its_step() {
    assert_eq!(
        broken([good(), Step::new(vec![0.0], 0.0)]),
        "the observation at step 2 has 1 numbers, the spec names 2"
    );
    assert_eq!(broken([Step::new(vec![0.0, f32::NAN], 0.0)]), "`v` in the observation at step 1 is NaN");
    assert_eq!(broken([Step::new(vec![f32::INFINITY, 0.0], 0.0)]), "`x` in the observation at step 1 is inf");
    assert_eq!(broken([good(), Step::new(vec![0.0; 2], f32::NAN)]), "the reward at step 2 is NaN");
    assert_eq!(broken([good().stage(2)]), "the stage at step 1 is 2, the spec names 1 stages");
    let too_long = broken([good(), good(), good()]);
    assert_eq!(too_long, "step 3 neither terminated nor truncated the episode, the spec's horizon is 3 steps");
}

#[test]
fn the_first_observation_is_checked() {
    for (first, expected) in [
        (vec![0.0; 3], "the observation at the reset has 3 numbers, the spec names 2"),
        (vec![0.0, f32::NEG_INFINITY], "`v` in the observation at the reset is -inf"),
    ] {
        let mut env = env([good()]);
        env.env_mut().first = first;
        assert_eq!(rule(env.reset(0)), expected);
        assert!(rule(env.step(&[0.0])).starts_with("a step before the first reset"));
    }
}

/// Models copy a constant and recompute a difference, so an observation that contradicts them would mislead every plan.
#[test]
fn features_are_what_their_roles_say() {
    let features = || {
        let [x, goal] = [Feature::new("x"), Feature::new("goal").constant()];
        [x, goal, Feature::new("way").difference("goal", "x")]
    };
    let env = |first: [f32; 3], then: [f32; 3]| {
        let spec = Spec::new("scripted", features(), 1, 3, 0.1);
        let steps = vec![Step::new(then.to_vec(), 0.0)];
        Checked::new(Scripted { spec, first: first.to_vec(), steps, next: 0 })
    };
    let mut in_order = env([0.0, 1.0, 1.0], [0.3, 1.0, 0.7]);
    in_order.reset(0).expect("in order");
    in_order.step(&[0.0]).expect("in order");
    let swapped = rule(env([0.0, 1.0, -1.0], [0.0; 3]).reset(0));
    assert_eq!(
        swapped,
        "`way` in the observation at the reset is -1, but 1 as `goal` minus `x`, which its role says it is"
    );
    let mut moving = env([0.0, 1.0, 1.0], [0.0, 1.5, 1.5]);
    moving.reset(0).expect("in order");
    let goal = "`goal` in the observation at step 1 is 1.5, but 1 at the reset, and its role is constant";
    assert_eq!(rule(moving.step(&[0.0])), goal);
    moving.reset(1).expect("another episode may have another goal");
}

#[test]
fn no_step_before_a_reset_or_after_the_end() {
    let expected = "a step before the first reset, or after the end of an episode; reset first";
    assert_eq!(rule(env([good()]).step(&[0.0])), expected);
    for last in [good().terminated(true), good().truncated(true)] {
        let mut env = env([last, good()]);
        env.reset(0).expect("in order");
        env.step(&[0.0]).expect("in order");
        assert_eq!(rule(env.step(&[0.0])), expected);
        env.reset(0).expect("a reset helps");
        env.step(&[0.0]).expect("in order");
    }
}

#[test]
fn a_refused_action_does_not_count_as_a_step() {
    let mut env = env([good(), good(), good().truncated(true)]);
    env.reset(0).expect("in order");
    for _ in 0..3 {
        assert!(matches!(env.step(&[0.0, 0.0]), Err(Error::Action { .. })));
        env.step(&[0.0]).expect("in order");
    }
}

#[test]
fn errors_reach_the_user_with_the_name_of_the_environment() {
    let mut env = env([Step::new(vec![0.0; 2], f32::NAN)]);
    env.reset(0).expect("in order");
    assert_eq!(
        env.step(&[0.0]).expect_err("NaN").to_string(),
        "scripted breaks the contract of an environment: the reward at step 1 is NaN (in the episode of `reset(0)`)"
    );
    let lost = std::io::Error::other("the cable is out");
    assert_eq!(Error::environment("arm", lost).to_string(), "arm: the cable is out");
}

#[test]
fn a_spec_that_makes_no_sense_is_refused() {
    let x = || Feature::new("x");
    let y = || Feature::new("y");
    let difference = |a: &str, b: &str| Feature::new("difference").difference(a, b);
    let with = |features: Vec<Feature>| Spec::new("mine", features, 1, 10, 0.1);
    for (spec, expected) in [
        (with(vec![]), "mine: an observation needs at least one feature"),
        (with(vec![x(), Feature::new("")]), "mine: feature 1 has no name"),
        (with(vec![x(), y(), x()]), "mine: two features are called `x`"),
        (with(vec![x().around(f32::NAN, 1.0)]), "mine: the centre of feature `x` must be finite, it is NaN"),
        (with(vec![x().around(0.0, 0.0)]), "mine: the scale of feature `x` must be positive and finite, it is 0"),
        (with(vec![x().around(0.0, -1.0)]), "mine: the scale of feature `x` must be positive and finite, it is -1"),
        (
            with(vec![x().around(0.0, f32::INFINITY)]),
            "mine: the scale of feature `x` must be positive and finite, it is inf",
        ),
        (
            with(vec![x(), difference("x", "z")]),
            "mine: feature `difference` is a difference of `z`, which is no feature",
        ),
        (
            with(vec![x(), y(), difference("x", "y"), Feature::new("twice").difference("x", "difference")]),
            "mine: feature `twice` is a difference of `difference`, itself a difference",
        ),
        (Spec::new("mine", [x()], 0, 10, 0.1), "mine: `action_size` must be at least 1"),
        (Spec::new("mine", [x()], 1, 0, 0.1), "mine: `horizon` must be at least 1"),
        (Spec::new("mine", [x()], 1, 10, 0.0), "mine: `dt` must be positive and finite, it is 0"),
        (Spec::new("mine", [x()], 1, 10, f64::NAN), "mine: `dt` must be positive and finite, it is NaN"),
    ] {
        let error = spec.check().expect_err(expected);
        assert!(matches!(error, Error::Config(_)));
        assert_eq!(error.to_string(), expected);
    }
    with(vec![x(), y(), difference("x", "y")]).check().expect("this one makes sense");
    let mut unusable = env([good()]);
    unusable.env_mut().spec.horizon = 0;
    assert!(matches!(unusable.reset(0), Err(Error::Config(_))));
}

#[test]
fn every_environment_of_this_crate_has_a_sound_spec() {
    let robosuite = TableOptions { observation: ObservationKind::Robosuite, ..TableOptions::default() };
    for task in Task::ALL {
        task.make().spec().check().expect("sound");
        if let Ok(env) = task.make_with(robosuite) {
            env.spec().check().expect("sound");
        }
    }
}

#[test]
fn a_vector_environment_wants_one_action_for_each() {
    let mut envs = VectorEnv::new(4, || Task::Pendulum.make());
    let error = envs.reset(&[0; 5]).expect_err("too many seeds").to_string();
    assert_eq!(error, "reset: 5 seeds for 4 environments");
    envs.reset(&[0, 1, 2, 3]).expect("one seed for each");
    for actions in [1, 5] {
        let error = envs.step(&vec![Some(vec![0.0]); actions]).expect_err("too few or too many").to_string();
        assert!(error.starts_with(&format!("step: {actions} actions for 4 environments")), "{error}");
    }
    let steps = envs.step(&[Some(vec![0.0]), None, None, Some(vec![0.0])]).expect("one entry for each");
    assert_eq!(steps.iter().map(Option::is_some).collect::<Vec<_>>(), [true, false, false, true]);
    // Fewer seeds leave the others where they are, and an environment that has not been reset may not step.
    let mut envs = VectorEnv::new(2, || Task::Pendulum.make());
    envs.reset(&[0]).expect("one seed");
    assert!(matches!(envs.step(&[None, Some(vec![0.0])]), Err(Error::Contract { .. })));
}

#[test]
fn a_boxed_environment_is_one_and_tells_its_type() {
    let mut boxed: Box<dyn Env> = Box::new(Task::Cartpole.make());
    let mut plain = Task::Cartpole.make();
    assert_eq!(Env::reset(&mut boxed, 3), plain.reset(3));
    assert_eq!(Env::step(&mut boxed, &[0.5]).expect("valid"), plain.step(&[0.5]).expect("valid"));
    assert_eq!(boxed.camera(), plain.camera());
    assert!(boxed.as_ref().downcast_ref::<World>().is_some());
    let twice: Box<dyn Env> = Box::new(boxed);
    assert_eq!(twice.position_of(&[0.0; 4]), plain.position_of(&[0.0; 4]));
    assert!(twice.as_ref().downcast_ref::<World>().is_some());
    assert!(twice.as_ref().downcast_ref::<Scripted>().is_none());
}
