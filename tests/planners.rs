//! Every planner finds known optima, and none needs to know what it plans for.

use std::sync::Arc;

use handful::model::EnsembleConfig;
use handful::plan::{
    ActionSequences, Cem, CemConfig, ControlConfig, GradientConfig, GuidedConfig, HybridConfig, IcemConfig, Iteration,
    MakePlanner, MppiConfig, Objective, Plan, PlanObserver, Planner, PlannerConfig, RecedingHorizon, ShootingConfig,
};
use handful::prelude::*;
use handful::rng::{self, Rng};

const HORIZON: usize = 8;

/// The planners that climb, and know their slopes only by differences.
fn climbers() -> [(&'static str, PlannerConfig); 2] {
    let gradient = GradientConfig { horizon: HORIZON, iterations: 60, rate: 0.05, ..GradientConfig::default() };
    let icem = IcemConfig { horizon: HORIZON, population: 60, ..IcemConfig::default() };
    [
        ("gradient", PlannerConfig::Gradient(gradient)),
        ("hybrid", PlannerConfig::Hybrid(HybridConfig { icem, iterations: 60, rate: 0.05 })),
    ]
}

/// A slope that leads astray: the hybrid keeps what iCEM found.
#[test]
fn the_hybrid_trusts_no_slope_that_does_not_keep_its_word() {
    struct Liar(Vec<f32>);
    impl Objective for Liar {
        fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
            bowl(sequences, &self.0)
        }
        fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
            (self.returns(sequences), vec![1.0; sequences.values.len()])
        }
    }
    let [_, (name, config)] = climbers();
    let PlannerConfig::Hybrid(HybridConfig { icem, .. }) = &config else { unreachable!() };
    let mut liar = Liar(target());
    let honest = PlannerConfig::Icem(icem.clone()).build(2).plan(&mut liar, &mut |_| {}, &mut rng::stream(0, name));
    let plan = config.build(2).plan(&mut liar, &mut |_| {}, &mut rng::stream(0, name));
    assert!(plan.best_return >= honest.best_return, "{} after {}", plan.best_return, honest.best_return);
}

#[test]
fn a_receding_horizon_plans_only_when_it_is_time() {
    let config = PlannerConfig::Shooting(ShootingConfig { horizon: HORIZON, population: 50 });
    let mut control = RecedingHorizon::new(
        config.build(2),
        2,
        &ControlConfig { action_repeat: 2, replan_every: 3, ..ControlConfig::default() },
    );
    let mut rng = rng::stream(0, "receding");
    let mut plans = 0;
    let target = target();
    let mut before = Vec::new();
    for step in 0..13 {
        let mut objective = |c: &ActionSequences| {
            plans += 1;
            assert!(
                c.horizon == 2 * HORIZON && c.rows().all(|row| row[..2] == row[2..4]),
                "actions are held for two steps"
            );
            bowl(c, &target)
        };
        let action = control.act(&mut objective, &mut |_| {}, &mut rng);
        assert_eq!(plans, step / 6 + 1);
        if step % 2 == 1 {
            assert_eq!(action, before, "each is held");
        }
        before = action;
    }
    control.reset();
    control.act(&mut |c: &ActionSequences| bowl(c, &target), &mut |_| plans += 1, &mut rng);
    assert_eq!(plans, 4, "a new episode begins with a new plan");
}

/// The planners that search, each with the distance (largest over all numbers) within which it must come to an
/// optimum.
fn planners() -> [(&'static str, PlannerConfig, f32); 4] {
    let cem = CemConfig { horizon: HORIZON, population: 800, elites: 80, iterations: 12, ..CemConfig::default() };
    let icem = IcemConfig {
        horizon: HORIZON,
        population: 500,
        elites: 40,
        iterations: 15,
        noise_beta: 1.0,
        ..IcemConfig::default()
    };
    let mppi = MppiConfig {
        horizon: HORIZON,
        population: 2000,
        iterations: 20,
        smoothing: 1.0,
        deviation: 0.3,
        ..MppiConfig::default()
    };
    let guided = GuidedConfig {
        horizon: HORIZON,
        population: 1000,
        iterations: 30,
        temperature: 0.4,
        min_deviation: 0.02,
        max_deviation: 1.0,
        ..GuidedConfig::default()
    };
    [
        ("CEM", PlannerConfig::Cem(cem), 0.1),
        ("iCEM", PlannerConfig::Icem(icem), 0.25),
        ("MPPI", PlannerConfig::Mppi(mppi), 0.15),
        ("guided MPPI", PlannerConfig::Guided(guided), 0.1),
    ]
}

/// Minus the squared distance from a target within the bounds.
fn bowl(candidates: &ActionSequences, target: &[f32]) -> Vec<f32> {
    let worth = |row: &[f32]| -row.iter().zip(target).map(|(a, t)| (a - t).powi(2)).sum::<f32>();
    candidates.rows().map(worth).collect()
}

fn target() -> Vec<f32> {
    (0..2 * HORIZON).map(|i| 0.7 * (i as f32 * 0.9).sin()).collect()
}

fn farthest(plan: &Plan, target: &[f32]) -> f32 {
    plan.actions.iter().zip(target).map(|(a, t)| (a - t).abs()).fold(0.0, f32::max)
}

#[test]
fn planners_find_the_bottom_of_a_bowl() {
    let target = target();
    let climbers = climbers().map(|(name, config)| (name, config, 0.05));
    for (name, config, tolerance) in planners().into_iter().chain(climbers) {
        let mut planner = config.build(2);
        let mut rng = rng::stream(0, name);
        let mut iterations = 0;
        let mut watch = |iteration: &Iteration| {
            assert_eq!(iteration.index, iterations);
            assert_eq!(iteration.candidates.count(), iteration.returns.len());
            assert!(iteration.candidates.values.iter().all(|a| (-1.0..=1.0).contains(a)), "{name}: within bounds");
            iterations += 1;
        };
        let plan = planner.plan(&mut |candidates: &ActionSequences| bowl(candidates, &target), &mut watch, &mut rng);
        assert!(iterations > 0);
        let distance = farthest(&plan, &target);
        assert!(distance < tolerance, "{name}: {distance} from the optimum");
    }
}

/// A search that is too short to find the optimum by itself finds what the objective proposes, held actions included.
#[test]
fn proposals_guide_a_short_search() {
    struct Knowing(Vec<f32>);
    impl Objective for Knowing {
        fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
            bowl(sequences, &self.0)
        }
        fn proposals(&mut self, count: usize, like: &ActionSequences) -> ActionSequences {
            ActionSequences { values: self.0[..like.horizon * like.actions].repeat(count), ..like.clone() }
        }
    }
    let config = GuidedConfig { horizon: HORIZON, population: 40, elites: 4, iterations: 1, ..GuidedConfig::default() };
    let mut planner = PlannerConfig::Guided(GuidedConfig { proposals: 4, ..config.clone() }).build(2);
    let plan = planner.plan(&mut Knowing(target()), &mut |_| {}, &mut rng::stream(0, "proposals"));
    assert!(farthest(&plan, &target()) == 0.0 && plan.best_return == 0.0);
    let alone = PlannerConfig::Guided(GuidedConfig { proposals: 0, ..config.clone() }).build(2);
    let mut alone = RecedingHorizon::new(alone, 2, &ControlConfig::default());
    alone.act(
        &mut Knowing(target()),
        &mut |i| assert!(i.returns.iter().all(|r| *r < -0.5)),
        &mut rng::stream(0, "alone"),
    );

    let held: Vec<f32> = target().chunks(2).flat_map(|action| action.repeat(3)).collect();
    let planner = PlannerConfig::Guided(GuidedConfig { proposals: 4, ..config }).build(2);
    let mut control = RecedingHorizon::new(planner, 2, &ControlConfig { action_repeat: 3, ..ControlConfig::default() });
    let action = control.act(&mut Knowing(held), &mut |_| {}, &mut rng::stream(0, "held"));
    assert_eq!(action, target()[..2]);
}

#[test]
fn shooting_takes_the_best_of_what_it_tried() {
    let target = target();
    let config = PlannerConfig::Shooting(ShootingConfig { horizon: HORIZON, population: 300 });
    let mut tried = None;
    let mut watch = |i: &Iteration| tried = Some((i.candidates.clone(), i.returns.to_vec()));
    let plan =
        config.build(2).plan(&mut |c: &ActionSequences| bowl(c, &target), &mut watch, &mut rng::stream(0, "shooting"));
    let (candidates, returns) = tried.expect("one iteration");
    assert_eq!(candidates.count(), 300);
    assert!(returns.iter().all(|r| *r <= plan.best_return));
    assert!(candidates.rows().any(|row| row == plan.actions));
}

/// An optimum on the bounds, as when full speed is best.
#[test]
fn planners_reach_the_bounds() {
    for (name, config, _) in planners() {
        let mut planner = config.build(2);
        let sum = |candidates: &ActionSequences| candidates.rows().map(|row| row.iter().sum()).collect();
        let plan = planner.plan(&mut |c: &ActionSequences| sum(c), &mut |_| {}, &mut rng::stream(1, name));
        let mean = plan.actions.iter().sum::<f32>() / plan.actions.len() as f32;
        // CEM's spread vanishes on the way to a bound, so it stops short of it: between 0.76 and 0.85 over 1000 seeds.
        assert!(mean > 0.7, "{name}: {mean}");
    }
}

/// What was found helps the next search: with few samples, a second plan is better than the first.
#[test]
fn a_warm_start_helps() {
    let target: Vec<f32> = vec![0.6; 2 * HORIZON];
    for (name, config) in [
        (
            "CEM",
            PlannerConfig::Cem(CemConfig { horizon: HORIZON, population: 40, elites: 8, iterations: 2, momentum: 0.1 }),
        ),
        (
            "iCEM",
            PlannerConfig::Icem(IcemConfig {
                horizon: HORIZON,
                population: 30,
                iterations: 2,
                ..IcemConfig::default()
            }),
        ),
    ] {
        let mut planner = config.build(2);
        let mut rng = rng::stream(2, name);
        let mut distances = Vec::new();
        for _ in 0..6 {
            let plan = planner.plan(&mut |c: &ActionSequences| bowl(c, &target), &mut |_| {}, &mut rng);
            distances.push(plan.actions.iter().zip(&target).map(|(a, t)| (a - t).powi(2)).sum::<f32>());
            planner.shift(1);
        }
        assert!(distances[5] < 0.6 * distances[0], "{name}: {distances:?}");
        planner.reset();
        let anew = planner.plan(&mut |c: &ActionSequences| bowl(c, &target), &mut |_| {}, &mut rng);
        let distance = anew.actions.iter().zip(&target).map(|(a, t)| (a - t).powi(2)).sum::<f32>();
        assert!(distance > distances[5], "{name}: forgets when it is told to");
    }
}

#[test]
fn not_a_number_is_never_chosen() {
    let shooting = PlannerConfig::Shooting(ShootingConfig { horizon: HORIZON, population: 300 });
    let all = planners().into_iter().chain([("shooting", shooting, 0.0)]);
    for (name, config, _) in all {
        let mut planner = config.build(2);
        let half = |candidates: &ActionSequences| -> Vec<f32> {
            candidates.rows().map(|row| if row[0] > 0.0 { f32::NAN } else { row[1] }).collect()
        };
        let plan = planner.plan(&mut |c: &ActionSequences| half(c), &mut |_| {}, &mut rng::stream(3, name));
        assert!(plan.actions.iter().all(|a| a.is_finite()), "{name}");
        assert!(plan.actions[0] <= 0.0 && plan.best_return.is_finite(), "{name}: {:?}", &plan.actions[..2]);
    }
}

/// A planner of the test's own: always the same action, one of three, whichever has the highest return.
struct BangBang {
    horizon: usize,
    action_size: usize,
}

impl Planner for BangBang {
    fn reset(&mut self) {}

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, _rng: &mut Rng) -> Plan {
        let mut candidates = ActionSequences::new(self.horizon, self.action_size);
        let width = self.horizon * self.action_size;
        for action in [-1.0, 0.0, 1.0] {
            candidates.values.extend(vec![action; width]);
        }
        let returns = objective.returns(&candidates);
        let winner = (0..3).max_by(|a, b| returns[*a].total_cmp(&returns[*b])).expect("three candidates");
        let actions = candidates.row(winner).to_vec();
        let mean: Vec<f64> = actions.iter().map(|a| f64::from(*a)).collect();
        observer(&Iteration { index: 0, candidates: &candidates, returns: &returns, mean: &mean });
        Plan { actions, best_return: returns[winner] }
    }

    fn shift(&mut self, _steps: usize) {}
}

fn bang_bang(action_size: usize) -> BangBang {
    BangBang { horizon: 4, action_size }
}

#[test]
fn a_planner_of_ones_own_enters_receding_horizon_control() {
    let config = ControlConfig { action_repeat: 2, replan_every: 4, ..ControlConfig::default() };
    let mut control = RecedingHorizon::new(bang_bang.make(1), 1, &config);
    let mut plans = 0;
    for _ in 0..16 {
        let mut left = |candidates: &ActionSequences| -> Vec<f32> {
            plans += 1;
            assert_eq!((candidates.count(), candidates.horizon), (3, 8));
            candidates.rows().map(|row| -row.iter().sum::<f32>()).collect()
        };
        assert_eq!(control.act(&mut left, &mut |_| {}, &mut rng::stream(0, "own planner")), [-1.0]);
    }
    assert_eq!(plans, 2);
}

/// As agents do that read their settings from a file.
#[test]
fn settings_out_of_range_are_refused() {
    let icem = IcemConfig { horizon: 1, ..IcemConfig::default() };
    let hybrid = HybridConfig { icem: icem.clone(), ..HybridConfig::default() };
    let most = ShootingConfig { horizon: 1000, population: 1_000_000 };
    for (config, action_size, expected) in [
        (
            PlannerConfig::Shooting(ShootingConfig { horizon: 2, population: 0 }),
            1,
            "`planner.shooting.population` is 0",
        ),
        (
            PlannerConfig::Cem(CemConfig { momentum: f64::NAN, ..CemConfig::default() }),
            1,
            "`planner.cem.momentum` is NaN; it must lie in 0.0..=1.0",
        ),
        (
            PlannerConfig::Cem(CemConfig { elites: 500, ..CemConfig::default() }),
            1,
            "`planner.cem`: `elites` must not exceed `population`",
        ),
        (PlannerConfig::Icem(icem), 1, "`planner.icem.horizon` is 1"),
        (
            PlannerConfig::Mppi(MppiConfig { temperature: 0.0, ..MppiConfig::default() }),
            1,
            "`planner.mppi.temperature` is 0.0",
        ),
        (
            PlannerConfig::Guided(GuidedConfig { iterations: 0, ..GuidedConfig::default() }),
            1,
            "`planner.guided.iterations` is 0",
        ),
        (
            PlannerConfig::Gradient(GradientConfig { rate: -1.0, ..GradientConfig::default() }),
            1,
            "`planner.gradient.rate` is -1.0",
        ),
        (PlannerConfig::Hybrid(hybrid), 1, "`planner.hybrid.icem.horizon` is 1"),
        (PlannerConfig::Shooting(most), 1, "do not fit into memory"),
        (PlannerConfig::Cem(CemConfig::default()), 0, "`action_size` is 0"),
    ] {
        let problem = config.try_build(action_size).err().expect(expected).to_string();
        assert!(problem.contains(expected), "{problem}");
    }
    assert!(PlannerConfig::Cem(CemConfig::default()).try_build(2).is_ok());
}

#[test]
#[should_panic(expected = "`cem.momentum` is NaN; it must lie in 0.0..=1.0")]
fn a_planner_without_answer_to_its_settings_says_which() {
    Cem::new(CemConfig { momentum: f64::NAN, ..CemConfig::default() }, 1);
}

#[test]
#[should_panic(expected = "`replan_every` is 5")]
fn a_plan_that_is_too_short_is_told_so() {
    let config = ControlConfig { replan_every: 5, ..ControlConfig::default() };
    let mut control = RecedingHorizon::new(bang_bang.make(1), 1, &config);
    let mut any = |candidates: &ActionSequences| vec![0.0; candidates.count()];
    control.act(&mut any, &mut |_| {}, &mut rng::stream(0, "own planner"));
}

#[test]
fn a_planner_of_ones_own_enters_pets_and_the_oracle() {
    let extremes = |action: &[f32]| [-1.0, 0.0, 1.0].contains(&action[0]);
    let mut env = Task::Pendulum.make();

    let oracle = Oracle::new(|| Ok(Task::Pendulum.make()), OracleConfig::default(), 0).expect("usable settings");
    let mut oracle = oracle.with_planner(bang_bang);
    env.reset(0);
    assert!(extremes(&oracle.plan(0, &env.snapshot()).expect("a plan")));

    let ensemble =
        EnsembleConfig { members: 2, elites: 2, hidden: vec![16], first_steps: 50, ..EnsembleConfig::default() };
    // White noise: coloured noise can stay beyond the bounds, where it is clipped, for all of the warm-up.
    let config = PetsConfig { ensemble, particles: 2, warm_up: 40, warm_up_noise_beta: 0.0, ..PetsConfig::default() };
    let reward = Arc::new(Task::Pendulum.make());
    let pets = Pets::new(env.spec(), Some(reward), config, 0).expect("usable settings");
    let mut pets = pets.with_planner(bang_bang);
    let mut obs = env.reset(0);
    let mut in_between = 0;
    for step in 0..60 {
        let action = pets.act(&obs, Mode::Explore);
        in_between += usize::from(!extremes(&action));
        assert!(extremes(&action) || step < 40, "random first, planned then: {action:?}");
        let Step { observation, reward, .. } = env.step(&action).expect("a step");
        let (terminated, truncated) = (false, false);
        pets.observe(&Transition { obs, action, reward, next_obs: observation.clone(), terminated, truncated });
        pets.update();
        obs = observation;
    }
    assert!(in_between > 0);
    let slots = [Slot::single(true, &obs, &env)];
    assert!(extremes(&pets.act_batch(&slots)[0]), "in evaluations, too");
    // Training goes on with the same planner.
    let state = pets.training_state();
    pets.load_training_state(&state).expect("its own state");
    assert!(extremes(&pets.act(&obs, Mode::Explore)));
}

/// The observer sees candidates, of which none need be the plan.
#[test]
fn the_last_plan_is_the_one_that_is_executed() {
    struct Fixed;
    impl Planner for Fixed {
        fn plan(&mut self, _: &mut dyn Objective, observer: &mut PlanObserver, _: &mut Rng) -> Plan {
            let candidates = ActionSequences { horizon: 2, actions: 1, values: vec![1.0, 1.0] };
            observer(&Iteration { index: 0, candidates: &candidates, returns: &[5.0], mean: &[0.0, 0.0] });
            Plan { actions: vec![0.5, -0.5], best_return: 5.0 }
        }
        fn shift(&mut self, _: usize) {}
        fn reset(&mut self) {}
    }
    let config = ControlConfig { action_repeat: 2, ..ControlConfig::default() };
    let mut controller = RecedingHorizon::new(Box::new(Fixed), 1, &config);
    let mut rng = rng::stream(0, "last plan");
    let mut act = |controller: &mut RecedingHorizon| {
        controller.act(&mut |c: &ActionSequences| vec![0.0; c.count()], &mut |_| {}, &mut rng)
    };
    assert!(controller.last_plan().is_empty());
    assert_eq!(act(&mut controller), [0.5]);
    assert_eq!(controller.last_plan(), [0.5, 0.5, -0.5, -0.5]);
    assert_eq!(act(&mut controller), [0.5]);
    assert!(controller.last_plan().is_empty(), "it went on with the plan before");
}
