//! An environment of one's own enters everything: agents, evaluation, the oracle, replays, studies.

#[path = "../../examples/own_world.rs"]
#[allow(dead_code)] // its `main`
mod own_world;

use std::sync::atomic::AtomicBool;

use handful::prelude::*;
use handful::study::config::RunConfig;
use handful::study::run::Event;
use handful::study::runner::{StudyObserver, StudyPlan, carry_out_all};
use handful::watch::Recording;
use own_world::{Puck, registry};

struct Silent;

impl StudyObserver for Silent {
    fn started(&self, _run: usize, _config: &RunConfig, _done: usize) {}
    fn happened(&self, _run: usize, _config: &RunConfig, _done: usize, _event: &Event) {}
}

/// The whole protocol in small: five methods train on the puck, are tested, compared and drawn.
#[test]
fn a_study_of_the_puck_ends_in_a_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let small = "steps = 500\nevaluate_every = 250\nevaluation_episodes = 2\ntest_episodes = 4\n";
    let pets = "warm_up = 100\nfit_every = 200\n[pets.ensemble]\nhidden = [16]\nfirst_steps = 20\nsteps = 10\n\
                [pets.planner.icem]\nhorizon = 4\npopulation = 10\nelites = 4\niterations = 1\n";
    let registry = registry()
        .preset("pets", &format!("agent = \"pets\"\n{small}[pets]\n{pets}"))
        .preset("sac", &format!("agent = \"sac\"\n{small}[sac]\nhidden = [16]\nwarm_up = 200\n"))
        .preset(
            "dreamer",
            &format!(
                "agent = \"dreamer\"\n{small}[dreamer]\nbatch = 2\nlength = 8\ntrain_ratio = 4.0\nwarm_up = 100\n\
                 [dreamer.world]\nunits = 16\nlayers = 1\n\
                 [dreamer.world.rssm]\ndeter = 16\nblocks = 2\nhidden = 8\nstoch = 4\nclasses = 4\n\
                 [dreamer.behaviour]\nunits = 16\nlayers = 1\n"
            ),
        );
    let plan = StudyPlan {
        tasks: vec!["puck".into()],
        methods: ["random", "pets", "pets-learned", "dreamer", "sac"].map(String::from).into(),
        seeds: 0..1,
        budget: None,
        folder: folder.path().into(),
    };
    let runs = plan.runs(&registry).expect("known names");
    carry_out_all(&registry, &runs, 2, &Silent, &AtomicBool::new(false)).expect("healthy runs");
    let learned = folder.path().join("puck/pets-learned/seed0");
    let (config, mut method) = registry.trained_method(&learned).expect("a complete run");
    assert_eq!(config.steps, 500);
    let recording = Recording::of_episode("puck".into(), Puck::default(), &mut method, 0).expect("valid actions");
    assert_eq!(recording.steps(), 50);
    assert!(recording.to_html().contains("\"post\""), "its own bodies are drawn");
    #[cfg(feature = "study")]
    {
        let folders = runs.iter().map(|(_, folder)| folder.as_path());
        let tables = handful::study::tables::Tables::gather(folders).expect("the runs' tables");
        tables.write(folder.path()).expect("a writable folder");
        let text = handful::study::report::write(folder.path(), folder.path()).expect("a report");
        assert!(text.contains("puck") && text.contains("pets-learned"), "{text}");
        assert!(folder.path().join("puck-learning.svg").exists());
    }
}

/// The oracle plans in the true puck: with the planner's preset it comes to nearly every goal.
#[test]
fn the_oracle_brings_the_puck_home() {
    let registry = registry();
    let config = registry.config("puck", "oracle", 0, None, None).expect("a preset");
    let mut oracle = registry.method(&config).expect("an oracle");
    let mut evaluator = Evaluator::new(|| Ok(Puck::default())).expect("a puck");
    let summary = evaluator.evaluate(&mut oracle, 100, EvalSeeds::Test).expect("valid actions").summary();
    assert!(summary.success > 0.9, "{summary:?}");
}

/// What an environment lacks is said by name.
#[test]
fn what_is_missing_is_named() {
    let bare = Registry::standard().env(EnvEntry::new("bare", || Ok(Puck::default())));
    let refusal = |method: &str| {
        let config = bare.config("bare", method, 0, None, None).expect("a preset");
        bare.method(&config).expect_err("something is missing").to_string()
    };
    assert!(refusal("oracle").contains("with_oracle"), "{}", refusal("oracle"));
    assert!(refusal("scripted").contains("no scripted policy"), "{}", refusal("scripted"));
    assert!(refusal("pets").contains("learn_reward"), "{}", refusal("pets"));
}

/// Names become folders, figures and Markdown; one that cannot is told when it is used.
#[test]
fn names_are_identifiers() {
    let registry = registry()
        .env(EnvEntry::new("../puck", || Ok(Puck::default())))
        .preset("<b>", "agent = \"sac\"\nsteps = 100\n");
    for (task, method, what) in [("../puck", "sac", "a task"), ("puck", "<b>", "a method")] {
        let problem = registry.config(task, method, 0, None, None).expect_err("not a name").to_string();
        assert!(problem.contains(&format!("cannot be the name of {what}")), "{problem}");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("config.toml");
    let config = "task = \"../../x\"\nmethod = \"sac\"\nseed = 0\nagent = \"sac\"\nsteps = 100\n";
    std::fs::write(&path, config).expect("a writable folder");
    let problem = handful::study::config::RunConfig::read(&path).expect_err("not a name").to_string();
    assert!(problem.contains("config.toml") && problem.contains("`../../x` cannot be the name of a task"), "{problem}");
}

/// The puck, but after 230 steps its rewards are not numbers.
struct Broken {
    puck: Puck,
    steps: usize,
}

impl Env for Broken {
    fn spec(&self) -> &Spec {
        self.puck.spec()
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        self.puck.reset(seed)
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        self.steps += 1;
        let mut step = self.puck.step(action)?;
        if self.steps > 230 {
            step.reward = f32::NAN;
        }
        Ok(step)
    }
}

/// A broken contract is told at once, with its rule, and what was recorded so far is kept.
#[test]
fn a_broken_contract_is_told_and_nothing_is_lost() {
    let folder = tempfile::tempdir().expect("a folder");
    let sac = "agent = \"sac\"\nsteps = 500\nevaluation_episodes = 1\n[sac]\nhidden = [16]\nwarm_up = 100\n";
    let registry = Registry::standard()
        .env(EnvEntry::new("broken", || Ok(Broken { puck: Puck::default(), steps: 0 })))
        .preset("small", sac);
    let config = registry.config("broken", "small", 0, None, None).expect("a preset");
    let run = [(config, folder.path().join("run"))];
    let problem = carry_out_all(&registry, &run, 1, &Silent, &AtomicBool::new(false)).expect_err("it is broken");
    assert!(matches!(problem, Error::Contract { .. }), "{problem}");
    assert!(problem.to_string().contains("reward"), "{problem}");
    let episodes = std::fs::read_to_string(run[0].1.join("episodes.csv")).expect("the episodes before");
    assert_eq!(episodes.lines().count(), 1 + 4, "four episodes of 50 steps, and the header");
    assert!(run[0].1.join("weights.safetensors").exists());
}

/// An agent of one's own is a few lines, and enters the protocol by name.
#[test]
fn an_agent_of_ones_own_is_trained_by_name() {
    /// Repeats the action that earned most.
    struct Copycat {
        best: (f32, Vec<f32>),
        rng: handful::rng::Rng,
    }
    impl Agent for Copycat {
        fn act(&mut self, _obs: &[f32], mode: Mode) -> Vec<f32> {
            let noise = |_| handful::rng::uniform(&mut self.rng, -1.0, 1.0) as f32;
            if mode == Mode::Evaluate { self.best.1.clone() } else { (0..2).map(noise).collect() }
        }
        fn observe(&mut self, transition: &Transition) {
            if transition.reward > self.best.0 {
                self.best = (transition.reward, transition.action.clone());
            }
        }
    }
    impl Checkpoint for Copycat {}
    impl Diagnostics for Copycat {}

    let registry = registry().agent("copycat", |context, _: NoOptions| {
        let best = (f32::NEG_INFINITY, vec![0.0; context.spec.action_size]);
        Ok(Copycat { best, rng: handful::rng::stream(context.seed, "copycat") })
    });
    let folder = tempfile::tempdir().expect("a folder");
    let config = registry.config("puck", "copycat", 0, Some(100), None).expect("a method of its own name");
    let mut run = registry.open_run(&config, folder.path()).expect("a new run");
    while !matches!(run.step().expect("a healthy run"), Event::Tested(_)) {}
    assert!(folder.path().join("test.csv").exists() && folder.path().join("evaluations.csv").exists());
}
