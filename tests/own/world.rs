//! An environment of one's own enters everything: agents, evaluation, the oracle, replays, studies.

#[path = "../../examples/own_world.rs"]
#[allow(dead_code)] // its `main`
mod own_world;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use handful::agent::ImaginedTrajectory;
use handful::checkpoint::Weights;
use handful::prelude::*;
use handful::study::run::{Event, is_complete};
use handful::study::runner::{StudyPlan, carry_out_all};
use handful::watch::Recording;
use own_world::{Puck, registry};

/// The whole protocol in small: six methods train on the puck, are tested, compared and drawn.
#[test]
fn a_study_of_the_puck_ends_in_a_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let small = "steps = 500\nevaluate_every = 250\nevaluation_episodes = 2\ntest_episodes = 4\n";
    let pets = "warm_up = 100\nfit_every = 200\n[pets.ensemble]\nhidden = [16]\nfirst_steps = 20\nsteps = 10\n\
                [pets.planner.icem]\nhorizon = 4\npopulation = 10\nelites = 4\niterations = 1\n";
    let registry = with_copycat(true)
        .preset("copycat", &format!("agent = \"copycat\"\n{small}"))
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
        methods: ["random", "pets", "pets-learned", "dreamer", "sac", "copycat"].map(String::from).into(),
        seeds: 0..1,
        budget: None,
        folder: folder.path().into(),
    };
    let runs = plan.runs(&registry).expect("known names");
    carry_out_all(&registry, &runs, 2, &(), &AtomicBool::new(false)).expect("healthy runs");
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
        let told = [("pets", Some(true)), ("pets-learned", Some(false)), ("dreamer", Some(false)), ("copycat", None)];
        for (method, told) in told {
            assert_eq!(tables.is_told_the_reward("puck", method).expect("configurations"), told, "{method}");
        }
        let text = handful::study::report::write(folder.path(), folder.path()).expect("a report");
        assert!(text.contains("puck") && text.contains("pets-learned"), "{text}");
        let report = std::fs::read_to_string(folder.path().join("report.md")).expect("a report");
        let terms = "`pets` is given a reward function; for `copycat`, this is not known.";
        assert!(report.contains(terms), "{report}");
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
    let misspelt = bare.preset("mine", "base = \"sac\"\n[for.baer.sac]\nbatch = 8\n");
    let problem = misspelt.config("bare", "mine", 0, None, None).expect_err("no such task").to_string();
    assert!(problem.contains("the preset `mine`: unknown task `baer`") && problem.contains("`bare`"), "{problem}");
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
    let healthy = registry.config("pendulum", "small", 0, Some(200), None).expect("a preset");
    let run = [(config, folder.path().join("run")), (healthy, folder.path().join("other"))];
    let problem = carry_out_all(&registry, &run, 1, &(), &AtomicBool::new(false)).expect_err("it is broken");
    assert!(is_complete(&run[1].1, &run[1].0), "the other run goes on");
    let Error::Run { folder, source } = &problem else { panic!("of a run: {problem}") };
    assert_eq!(*folder, run[0].1);
    assert!(matches!(**source, Error::Contract { .. }), "{problem}");
    assert!(problem.to_string().contains("reward"), "{problem}");
    let episodes = std::fs::read_to_string(run[0].1.join("episodes.csv")).expect("the episodes before");
    assert_eq!(episodes.lines().count(), 1 + 4, "four episodes of 50 steps, and the header");
    assert!(run[0].1.join("weights.safetensors").exists());
}

/// A replay of a world that draws nothing would be an empty page.
#[test]
fn a_world_that_draws_nothing_is_not_visible() {
    /// Imagines that nothing moves.
    struct Still;
    impl Policy for Still {
        fn actions(&mut self, slots: &[Slot]) -> Result<Vec<Vec<f32>>> {
            Ok(vec![vec![0.0; 2]; slots.len()])
        }
        fn explained_action(&mut self, slot: &Slot) -> Result<(Vec<f32>, Vec<ImaginedTrajectory>)> {
            let observations = vec![slot.obs.to_vec(); 2];
            Ok((vec![0.0; 2], vec![ImaginedTrajectory { observations, value: 1.0, disagreement: 0.0 }]))
        }
    }
    let broken = Broken { puck: Puck::default(), steps: 0 };
    for (env, visible) in [(Box::new(Puck::default()) as Box<dyn Env>, true), (Box::new(broken), false)] {
        let recording = Recording::of_episode("puck".into(), env, &mut Still, 0).expect("valid actions");
        assert_eq!(recording.is_visible(), visible);
    }
}

/// A variant of an agent has the settings of the preset that it is based on, also those for the task.
#[test]
fn a_variant_builds_on_a_preset() {
    let registry = Registry::standard()
        .agent("pets-mine", |context, config: PetsConfig| {
            Pets::new(context.spec, context.known_reward()?, config, context.seed)
        })
        .preset("pets-mine", "base = \"pets\"\nagent = \"pets-mine\"\n[pets-mine]\nwarm_up = 77\n");
    let config = |method| registry.config("reach", method, 0, None, None).expect("a preset").settings;
    let (mut base, variant) = (config("pets"), config("pets-mine"));
    base.insert("warm_up".into(), 77.into());
    assert_eq!(variant, base);
}

/// Repeats the action that earned most.
struct Copycat {
    best: (f32, Vec<f32>),
    rng: handful::rng::Rng,
    /// Whether it saves anything.
    saves: bool,
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

impl Checkpoint for Copycat {
    fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        if self.saves {
            let (reward, action) = &self.best;
            weights.insert("reward", vec![*reward], [1, 1, 1]);
            weights.insert("action", action.clone(), [1, 1, action.len()]);
        }
        weights
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        let (reward, action) = &mut self.best;
        *reward = weights.get("reward", [1, 1, 1])?[0];
        *action = weights.get("action", [1, 1, action.len()])?.to_vec();
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        if self.saves {
            state.insert_rng("rng", &self.rng);
        }
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        self.rng = state.rng("rng")?;
        Ok(())
    }
}

impl Diagnostics for Copycat {}

/// With the agent `copycat`, which saves what it has learned or not.
fn with_copycat(saves: bool) -> Registry {
    registry().agent("copycat", move |context, _: NoOptions| {
        let best = (f32::NEG_INFINITY, vec![0.0; context.spec.action_size]);
        Ok(Copycat { best, rng: handful::rng::stream(context.seed, "copycat"), saves })
    })
}

/// An agent of one's own is a few lines, and enters the protocol by name: it is trained, resumed and used.
#[test]
fn an_agent_of_ones_own_is_trained_by_name() {
    let registry = with_copycat(true);
    let folders = [tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("a folder")];
    let [whole, resumed] = folders.each_ref().map(|folder| folder.path());
    let config = registry.config("puck", "copycat", 0, Some(100), None).expect("a method of its own name");
    let to_the_end = |folder: &Path| {
        let mut run = registry.open_run(&config, folder).expect("a run");
        while !matches!(run.step().expect("a healthy run"), Event::Tested(_)) {}
    };
    to_the_end(whole);
    let mut run = registry.open_run(&config, resumed).expect("a new run");
    while run.steps_done() < 50 {
        run.step().expect("a healthy run");
    }
    run.save().expect("a writable folder");
    drop(run);
    to_the_end(resumed);
    for file in ["weights.safetensors", "episodes.csv", "test.csv"] {
        assert!(whole.join(file).exists());
    }
    let (_, method) = registry.trained_method(whole).expect("a complete run");
    let (_, again) = registry.trained_method(resumed).expect("a complete run");
    let best = |method: &Method| method.downcast_ref::<Copycat>().expect("a copycat").best.clone();
    assert_eq!(best(&method), best(&again));
    assert!(method.downcast_ref::<Random>().is_none());
}

/// An agent that learns and saves nothing is not resumed, nor evaluated, as if it had learned nothing.
#[test]
fn an_agent_that_saves_nothing_is_refused() {
    let registry = with_copycat(false);
    let folder = tempfile::tempdir().expect("a folder");
    let config = registry.config("puck", "copycat", 0, Some(100), None).expect("a method of its own name");
    let mut run = registry.open_run(&config, folder.path()).expect("a new run");
    while !matches!(run.step().expect("a healthy run"), Event::Tested(_)) {}
    drop(run);
    for problem in [
        registry.trained_method(folder.path()).map(|_| ()).expect_err("it has forgotten everything"),
        registry.open_run(&config, folder.path()).map(|_| ()).expect_err("it has forgotten everything"),
    ] {
        assert!(problem.to_string().contains("saves nothing"), "{problem}");
    }
}

/// A checkpoint with NaN in it could not be read again, so it does not replace a good one.
#[test]
fn a_training_state_with_nan_is_not_saved() {
    struct Forgetful(f32);
    impl Agent for Forgetful {
        fn act(&mut self, _obs: &[f32], _mode: Mode) -> Vec<f32> {
            vec![0.0; 2]
        }
        fn observe(&mut self, transition: &Transition) {
            if transition.truncated {
                self.0 = f32::NAN;
            }
        }
    }
    impl Checkpoint for Forgetful {
        fn training_state(&self) -> Weights {
            let mut state = Weights::default();
            state.insert("mean", vec![self.0], [1, 1, 1]);
            state
        }
    }
    impl Diagnostics for Forgetful {}
    let registry = registry().agent("forgetful", |_, _: NoOptions| Ok(Forgetful(0.0)));
    let folder = tempfile::tempdir().expect("a folder");
    let config = registry.config("puck", "forgetful", 0, Some(100), None).expect("a method of its own name");
    let mut run = registry.open_run(&config, folder.path()).expect("a new run");
    run.save().expect("nothing is wrong yet");
    let checkpoint = folder.path().join("checkpoint/state.safetensors");
    let good = std::fs::read(&checkpoint).expect("a checkpoint");
    let mut train = || -> Result<()> {
        while run.steps_done() < 50 {
            run.step()?;
        }
        run.save()
    };
    let problem = train().expect_err("NaN").to_string();
    assert!(problem.contains("the training state's `mean` is NaN at step 50"), "{problem}");
    assert!(std::fs::read(&checkpoint).expect("a checkpoint") == good);
}

/// What was renamed in the settings of this crate's agents keeps its name in those of others.
#[test]
fn settings_of_ones_own_keep_their_names() {
    #[derive(Default, serde::Serialize, serde::Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Settings {
        propagation: String,
        control: BTreeMap<String, f32>,
    }
    let own = "agent = \"mine\"\nsteps = 50\n[mine]\npropagation = \"mean\"\n[mine.control]\nhold = 2.0\n";
    let registry = with_copycat(true)
        .agent("mine", |context, settings: Settings| {
            assert_eq!((settings.propagation.as_str(), settings.control["hold"]), ("mean", 2.0));
            let best = (f32::NEG_INFINITY, vec![0.0; context.spec.action_size]);
            Ok(Copycat { best, rng: handful::rng::stream(context.seed, "copycat"), saves: true })
        })
        .preset("mine", own);
    let folder = tempfile::tempdir().expect("a folder");
    let config = registry.config("puck", "mine", 0, None, None).expect("a preset");
    drop(registry.open_run(&config, folder.path()).expect("a new run"));
    let mut run = registry.open_run(&config, folder.path()).expect("the same run");
    while !matches!(run.step().expect("a healthy run"), Event::Tested(_)) {}
    assert!(handful::study::run::is_complete(folder.path(), &config));

    let named = with_copycat(true).agent("steps", |_, _: NoOptions| -> Result<Copycat> { unreachable!("not a name") });
    let problem = named.config("puck", "steps", 0, None, None).expect_err("not a name").to_string();
    assert!(problem.contains("an agent cannot be called `steps`"), "{problem}");
}
