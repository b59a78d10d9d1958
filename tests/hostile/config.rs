//! Configuration files.

use std::cell::Cell;
use std::collections::BTreeSet;

use handful::agent::{PetsConfig, Preset};
use handful::model::uncertainty::Risk;
use handful::plan::PlannerConfig;
use handful::prelude::*;
use handful::study::config::RunConfig;
use handful::study::registry::AgentContext;
use handful::study::run::Event;
use proptest::prelude::*;
use proptest::sample::Index;
use proptest::test_runner::TestCaseError;
use toml::{Table, Value};

use super::{brief, runner, timed};

/// A preset of each method that learns or plans, so small that a few steps take milliseconds.
pub(super) const SMALL: [(&str, &str); 6] = [
    (
        "small-sac",
        "base = 'sac'
         evaluation_episodes = 1
         env.horizon = 5
         [sac]
         hidden = [8]
         batch = 8
         warm_up = 10
         warm_up_noise_beta = 1.0
         exploration_noise_beta = 1.0
         max_gradient_norm = 1.0",
    ),
    (
        "small-pets",
        "base = 'pets'
         evaluation_episodes = 1
         env.horizon = 5
         [pets]
         warm_up = 10
         fit_every = 10
         particles = 4
         risk.mean-std = 0.5
         [pets.ensemble]
         members = 2
         elites = 2
         hidden = [8]
         batch = 8
         first_steps = 5
         steps = 5
         check_every = 5
         [pets.planner.icem]
         horizon = 3
         population = 8
         elites = 2
         iterations = 2",
    ),
    (
        "small-dreamer",
        "base = 'dreamer'
         evaluation_episodes = 1
         env.horizon = 5
         [dreamer]
         batch = 2
         length = 4
         dreams = 2
         warm_up = 10
         train_ratio = 8.0
         [dreamer.world]
         units = 8
         bins = 15
         [dreamer.world.rssm]
         deter = 8
         hidden = 8
         stoch = 2
         classes = 4
         [dreamer.behaviour]
         units = 8
         layers = 1
         horizon = 3
         target_entropy = 0.5",
    ),
    (
        "small-tdmpc2",
        "base = 'tdmpc2'
         evaluation_episodes = 1
         env.horizon = 5
         [tdmpc2]
         horizon = 2
         batch = 2
         warm_up = 10
         exploration_noise_beta = 1.0
         [tdmpc2.model]
         latent = 8
         group = 4
         encoder = 8
         units = 8
         bins = 15
         [tdmpc2.planner]
         population = 8
         proposals = 2
         elites = 2
         iterations = 2",
    ),
    (
        "small-planet",
        "base = 'small-dreamer'
         dreamer.planner.mppi = { horizon = 3, population = 8 }",
    ),
    (
        "small-oracle",
        "base = 'oracle'
         test_episodes = 1
         env.horizon = 5
         oracle.planner.gradient = { horizon = 2, starts = 2, iterations = 1 }",
    ),
];

/// The planners that no run in [`SMALL`] has.
const PLANNERS: [(&str, &str); 3] = [
    ("cem-oracle", "base = 'small-oracle'\noracle.planner.cem = { horizon = 2, population = 4, elites = 2 }"),
    ("shooting-oracle", "base = 'small-oracle'\noracle.planner.shooting = { horizon = 2, population = 4 }"),
    (
        "hybrid-oracle",
        "base = 'small-oracle'\noracle.planner.hybrid.icem = { horizon = 2, population = 8, elites = 2 }",
    ),
];

fn config_of(method: &str, text: &str) -> Result<RunConfig> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("file.toml");
    std::fs::write(&path, text).expect("a writable folder");
    registry().config("reach", method, 0, None, Some(&path))
}

pub(super) fn registry() -> Registry {
    SMALL
        .iter()
        .chain(&PLANNERS)
        .fold(Registry::standard(), |registry, (method, preset)| registry.preset(method, preset))
}

/// All settings of a small run, in the form of a file for `--config`.
fn whole_file(method: &str) -> Table {
    let config = config_of(method, "").expect("a small run");
    let mut table = Table::try_from(&config).expect("a configuration is TOML");
    table.retain(|key, _| !["task", "method", "seed", "shake", "agent"].contains(&key));
    table.insert(config.agent, Value::Table(config.settings));
    table
}

/// The paths of all values, the numbers of a list included.
fn paths(table: &Table) -> Vec<Vec<String>> {
    let below = |(key, value): (&String, &Value)| -> Vec<Vec<String>> {
        match value {
            Value::Table(inner) => paths(inner).into_iter().map(|path| [vec![key.clone()], path].concat()).collect(),
            _ => vec![vec![key.clone()]],
        }
    };
    table.iter().flat_map(below).collect()
}

fn at<'a>(table: &'a mut Table, path: &[String]) -> &'a mut Value {
    let (last, tables) = path.split_last().expect("a path");
    let inner = tables.iter().fold(table, |table, key| table[key].as_table_mut().expect("a table"));
    inner.entry(last.as_str()).or_insert(Value::Boolean(false))
}

#[test]
fn every_number_has_a_range_that_names_it() {
    let registry = Registry::standard();
    let mut checked = BTreeSet::new();
    // Planners have the same settings whoever plans with them.
    let of_a_planner = |name: &str| name.find("planner.").map_or(name, |at| &name[at..]).to_string();
    for (method, _) in SMALL.into_iter().chain(PLANNERS) {
        let whole = whole_file(method);
        let said = |path: &[String], value: Value| {
            let mut table = whole.clone();
            *at(&mut table, path) = value;
            let text = toml::to_string(&table).expect("TOML");
            config_of(method, &text).err().map(|problem| problem.to_string()).unwrap_or_default()
        };
        for path in paths(&whole) {
            let name = path.join(".");
            let value = at(&mut whole.clone(), &path).clone();
            // The parser does not tell which planner it is in.
            let kinds = [".icem", ".mppi", ".gradient", ".cem", ".shooting", ".hybrid"];
            let mut parsed: Vec<String> = kinds.iter().map(|kind| name.replacen(kind, "", 1)).collect();
            parsed.push(kinds.iter().fold(name.clone(), |name, kind| name.replace(kind, "")));
            let names_it = |said: &str, value: &str| {
                parsed.iter().any(|name| said.contains(&format!("`{name}"))) && said.contains(value)
            };
            let outside = match value {
                Value::Float(_) => {
                    let nan = said(&path, Value::Float(f64::NAN));
                    assert!(names_it(&nan, "is NaN; it must lie in"), "{name}: {nan}");
                    let (_, range) = nan.split_once("must lie in ").expect("a range");
                    let (low, high) = range.split_once("..=").expect("a range");
                    let [low, high]: [f64; 2] = [low, high].map(|bound| bound.trim().parse().expect("a number"));
                    vec![Value::Float(low - 1e-5 * low.abs().max(1.0)), Value::Float(high + 1e-5 * high.abs().max(1.0))]
                }
                // A whole number; those of a run itself have the bounds of their seeds.
                Value::Integer(_) if path.len() == 1 => vec![Value::Integer(-1)],
                Value::Integer(_) => {
                    let huge = said(&path, Value::Integer(i64::from(u32::MAX)));
                    assert!(names_it(&huge, "it must lie in"), "{name}: {huge}");
                    let (_, range) = huge.split_once("must lie in ").expect("a range");
                    let (low, high) = range.split_once("..=").expect("a range");
                    let [low, high]: [i64; 2] = [low, high].map(|bound| bound.trim().parse().expect("a number"));
                    vec![Value::Integer(low - 1), Value::Integer(high + 1), Value::Integer(-1)]
                }
                Value::Array(_) => vec![
                    Value::Array(vec![]),
                    Value::Array(vec![Value::Integer(0)]),
                    Value::Array(vec![Value::Integer(1 << 20)]),
                    Value::Array(vec![Value::Integer(8); 100]),
                ],
                _ => continue,
            };
            for value in outside {
                let said = said(&path, value.clone());
                assert!(names_it(&said, ""), "{name} = {value}: {said}");
            }
            checked.insert(of_a_planner(&name));
        }
    }
    // The library's own callers are told the same.
    let config = SacConfig { learning_rate: f32::NAN, ..SacConfig::default() };
    let problem = Sac::new(Task::Pendulum.make().spec(), config, 0).expect_err("not a number").to_string();
    assert_eq!(problem, "`sac.learning_rate` is NaN; it must lie in 0.0..=1.0");
    assert!(checked.len() > 70, "{checked:?}");
    // No preset has a number that no small run has.
    for method in registry.method_names() {
        let config = registry.config("push", method, 0, None, None).expect("a preset");
        let mut table = Table::new();
        table.insert(config.agent, Value::Table(config.settings));
        for path in paths(&table) {
            let number = matches!(at(&mut table, &path), Value::Float(_) | Value::Integer(_) | Value::Array(_));
            assert!(!number || checked.contains(&of_a_planner(&path.join("."))), "{path:?}");
        }
    }
}

#[test]
fn numbers_must_fit_together() {
    for (method, text, expected) in [
        ("pets", "pets.ensemble.elites = 6", "`pets.ensemble`: `elites` must not exceed `members`"),
        ("pets", "pets.particles = 7", "`pets`: `particles` must be a multiple of `ensemble.elites`"),
        ("pets", "pets.planner.icem.elites = 100", "`pets.planner.icem`: `elites` must not exceed `population`"),
        ("pets", "pets.control.replan_every = 9", "`pets`: `control.replan_every` must not exceed"),
        ("pets", "pets.planner.icem.population = 1000000\npets.particles = 10000", "do not fit into memory"),
        ("sac", "sac.hidden = [4096, 4096]\nsac.critics = 32", "too many weights"),
        ("dreamer", "dreamer.replay = 20", "`dreamer`: `replay` must hold at least `length` decisions"),
        ("dreamer", "dreamer.train_ratio = 1e6", "`dreamer`: `train_ratio` must not exceed"),
        ("tdmpc2", "tdmpc2.model.group = 7", "`tdmpc2.model`: `group` must divide `latent`"),
        ("tdmpc2", "tdmpc2.planner.elites = 1000", "`tdmpc2.planner`: `elites` must not exceed `population`"),
        ("tdmpc2", "tdmpc2.replay = 3", "`tdmpc2`: `replay` must hold more decisions than `horizon`"),
        ("dreamer", "dreamer.world.bins = 4", "`dreamer.world`: `bins` must be odd"),
    ] {
        let problem = config_of(method, text).expect_err(text).to_string();
        assert!(problem.contains(expected), "{text}: {problem}");
    }
}

/// Another planner takes the place of the preset's; the same one keeps what the file does not change.
#[test]
fn a_file_can_choose_any_planner_that_suits_the_agent() {
    let kinds = ["shooting", "cem", "icem", "mppi", "guided", "gradient", "hybrid"];
    for (method, agent) in [("pets", "pets"), ("oracle", "oracle"), ("planet", "dreamer")] {
        for kind in kinds {
            let horizon = if kind == "hybrid" { "icem.horizon" } else { "horizon" };
            for table in [format!("[{agent}.planner.{kind}]"), format!("[for.reach.{agent}.planner.{kind}]")] {
                let config = config_of(method, &format!("{table}\n{horizon} = 7"));
                if agent == "dreamer" && ["gradient", "hybrid"].contains(&kind) {
                    // Its sequences have random numbers of their own, so there are no gradients.
                    let problem = config.expect_err(kind).to_string();
                    assert!(problem.contains("must not be `gradient` or `hybrid`"), "{problem}");
                    continue;
                }
                let config = config.expect(kind);
                let planner: PlannerConfig = config.settings["planner"].clone().try_into().expect("a planner");
                assert_eq!((planner.horizon(), config.settings["planner"].as_table().map(Table::len)), (7, Some(1)));
                assert!(config.settings["planner"].get(kind).is_some(), "{planner:?}");
            }
        }
    }
    let config = config_of("pets", "pets.planner.hybrid.icem.horizon = 7").expect("iCEM and gradients");
    let population = config.settings["planner"]["hybrid"]["icem"]["population"].as_integer();
    assert_eq!(population, Some(24), "the preset's for reach");
    // Risk measures are a choice too.
    for risk in ["'neutral'", "{ cvar = 0.5 }", "{ mean-std = 0.5 }", "{ entropic = 2.0 }"] {
        let config = config_of("pets", &format!("pets.risk = {risk}\n[for.reach.pets]\nrisk = {{ cvar = 0.25 }}"));
        assert_eq!(config.expect(risk).settings["risk"]["cvar"].as_float(), Some(0.25));
    }
    // Also where a preset replaces that of its base.
    let risk = |method: &str| PetsConfig::preset_for(method, "lift").expect("a preset").risk;
    assert_eq!([risk("pets"), risk("pets-learned")], [Risk::MeanStd(1.0), Risk::Neutral]);
    let problem = config_of("pets", "pets.planner = { cem = {}, mppi = {} }").expect_err("two planners").to_string();
    assert!(problem.contains("`pets.planner`") && problem.contains("cem, mppi"), "{problem}");
}

#[test]
fn nothing_is_ignored() {
    for (method, text, expected) in [
        ("pets", "[for.pendulm]", "unknown task `pendulm` (did you mean `pendulum`?)"),
        ("pets", "for = 3", "`for` must hold a table for each task"),
        ("pets", "for.reach = 3", "`for` must hold a table for each task"),
        ("pets", "seed = 3", "`seed` cannot be set in a file; set it by --seed"),
        ("pets", "[for.reach]\nseed = 3", "`seed` cannot be set in a file; set it by --seed"),
        ("pets", "task = 'push'", "--task"),
        ("pets", "method = 'sac'", "--method"),
        ("pets", "shake = 1", "HANDFUL_SHAKE"),
        ("pets", "agent = 'sac'", "`agent` cannot be changed, it is \"pets\"; choose another method by --method"),
        ("random", "steps = 100", "`steps` is 100, but random does not learn; leave it out"),
        ("pets", "base = 'sac'", "unknown field `base`"),
        ("pets", "[pets]\nplanner = 'cem'", "`pets.planner`: a name alone is not enough: write `{ NAME = VALUE }`"),
        ("pets", "[pets]\nrisk = 'cvar'", "`pets.risk`: a name alone is not enough"),
        ("pets", "[sac]\nbatch = 3", "[sac] is for another kind of agent; settings of this one stand in [pets]"),
        ("pets", "pets.ensemble.batch = -1", "`pets.ensemble.batch`: invalid value: integer `-1`"),
        ("pets", "[pets.ensemble]\nbatchh = 3", "`pets.ensemble`: unknown field `batchh` (did you mean `batch`?)"),
    ] {
        let problem = config_of(method, text).expect_err(text);
        assert!(problem.to_string().contains(expected) && brief(&problem), "{text}: {problem}");
    }
    config_of("pets", "agent = 'pets'").expect("nothing is changed by it");
    let circle = Registry::standard().preset("hen", "base = 'egg'").preset("egg", "base = 'hen'");
    let problem = circle.config("reach", "hen", 0, None, None).expect_err("no first preset").to_string();
    assert!(problem.contains("its own `base`"), "{problem}");
    let long = "k".repeat(10_000_000);
    for text in [
        format!("{long} = 1"),
        format!("[for.{long}]"),
        format!("pets = '{long}'"),
        format!("pets.risk = '{long}'"),
        format!("pets.risk = {{ cvar = 0.5, {long} = 1 }}"),
        "pets.risk = { cvar = 0.5, \"\\n\\n\\n\" = 1 }".into(),
    ] {
        let problem = config_of("pets", &text).expect_err("ten megabytes");
        assert!(brief(&problem), "{} bytes", problem.to_string().len());
    }
}

/// A reward that is not known is told before anything is made; with `learn_reward` the same run works.
#[test]
fn pets_cannot_plan_without_a_reward() {
    let folder = tempfile::tempdir().expect("a folder");
    let robosuite = "env.observation = 'robosuite'\n";
    let config = config_of("small-pets", robosuite).expect("settings in range");
    let problem = Registry::standard().open_run(&config, &folder.path().join("run")).expect_err("no reward");
    assert!(problem.to_string().contains("set `pets.ensemble.learn_reward = true`"), "{problem}");
    assert!(!folder.path().join("run").exists(), "nothing was made");
    let learned = format!("{robosuite}pets.ensemble.learn_reward = true");
    few_steps(&config_of("small-pets", &learned).expect("settings in range")).expect("a run");
}

/// Each beginning of a run's own `config.toml` is refused, rather than completed with defaults.
#[test]
fn a_run_does_not_read_half_of_its_configuration() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = config_of("small-pets", "").expect("a small run");
    drop(Registry::standard().open_run(&config, folder.path()).expect("a new run"));
    let path = folder.path().join("config.toml");
    let whole = std::fs::read_to_string(&path).expect("a configuration");
    assert_eq!(RunConfig::read(&path).expect("the whole"), config);
    for end in (0..whole.len()).filter(|end| end % 5 == 0 || end + 40 > whole.len()) {
        std::fs::write(&path, &whole[..end]).expect("a writable folder");
        let problem = RunConfig::read(&path).err().unwrap_or_else(|| panic!("cut after {end} bytes"));
        assert!(brief(&problem), "{problem}");
    }
    // A file of an earlier version does not tell how many values it has.
    let (_, old) = whole.split_once('\n').expect("several lines");
    std::fs::write(&path, old).expect("a writable folder");
    assert_eq!(RunConfig::read(&path).expect("an old file"), config);
    // But it ends where a line ends.
    std::fs::write(&path, old.trim_end()).expect("a writable folder");
    let problem = RunConfig::read(&path).expect_err("the end may be missing");
    assert!(brief(&problem) && problem.to_string().contains("its last line has no end"), "{problem}");
}

/// Learns for one step too many.
struct Diverging {
    steps: usize,
    loss: f32,
    weight: f32,
}

impl Agent for Diverging {
    fn act(&mut self, _obs: &[f32], _mode: Mode) -> Vec<f32> {
        vec![self.weight]
    }

    fn update(&mut self) -> Option<Losses> {
        self.steps += 1;
        if self.steps == 3 {
            self.weight = f32::NAN * self.weight.max(self.loss);
        }
        Some(Losses::from([("loss", if self.steps == 3 { self.loss } else { 0.0 })]))
    }
}

impl Checkpoint for Diverging {
    fn weights(&self) -> handful::checkpoint::Weights {
        let mut weights = handful::checkpoint::Weights::default();
        weights.insert("policy", vec![self.weight], [1, 1, 1]);
        weights
    }
}

impl Diagnostics for Diverging {}

#[test]
fn training_that_diverges_is_told() {
    for (loss, expected) in [(f32::NAN, "`loss` is NaN at step 3"), (0.0, "a weight of `policy` is NaN at step 3")] {
        let make = move |_: &AgentContext, NoOptions {}| Ok(Diverging { steps: 0, loss, weight: 0.0 });
        let registry = Registry::standard().agent("diverging", make);
        let config = registry.config("pendulum", "diverging", 0, None, None).expect("a method");
        let config = RunConfig { evaluation_episodes: 1, ..config };
        let folder = tempfile::tempdir().expect("a folder");
        let mut run = registry.open_run(&config, folder.path()).expect("a new run");
        let problem = (0..10).find_map(|_| run.step().err()).expect("it diverges");
        assert!(problem.to_string().starts_with(expected), "{problem}");
        assert!(matches!(problem, Error::Diverged { step: 3, .. }));
    }
}

/// Until the agent has learned a few times and was evaluated.
fn few_steps(config: &RunConfig) -> Result<()> {
    let folder = tempfile::tempdir().expect("a folder");
    let mut run = Registry::standard().open_run(config, folder.path())?;
    for _ in 0..25 {
        if matches!(run.step()?, Event::Tested(_)) {
            break;
        }
    }
    run.save()
}

/// How a file is made hostile.
#[derive(Clone, Debug)]
enum Mutation {
    /// A value becomes another one.
    Replace(Index, Index),
    Remove(Index),
    Unknown(Index, String),
    /// A line of the text stands there twice.
    Twice(Index),
    Cut(Index),
}

fn mutations() -> impl Strategy<Value = Vec<Mutation>> {
    let mutation = prop_oneof![
        12 => any::<(Index, Index)>().prop_map(|(path, value)| Mutation::Replace(path, value)),
        2 => any::<Index>().prop_map(Mutation::Remove),
        1 => (any::<Index>(), "[a-z_.`\"\n]{1,12}").prop_map(|(path, name)| Mutation::Unknown(path, name)),
        1 => any::<Index>().prop_map(Mutation::Twice),
        1 => any::<Index>().prop_map(Mutation::Cut),
    ];
    prop::collection::vec(mutation, 1..3)
}

/// What takes the place of a value: most of the time one of its kind.
fn hostile_values(like: &Value) -> Vec<Value> {
    let wild = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300, -1e300, 1e-300, -1.0, 1e30];
    let bounds = [0.0, 1e-6, 1e-4, 1e-3, 0.1, 0.5, 0.9, 1.0, 2.0, 10.0, 100.0, 1e3, 1e4, 1e6];
    let whole = [-1, 0, 1, 2, 3, 4, 5, 6, i64::MAX, i64::MIN, 1 << 32, 1_000_000_000];
    let floats = wild.into_iter().chain(bounds).map(Value::Float);
    let numbers: Vec<Value> = floats.chain(whole.into_iter().map(Value::Integer)).collect();
    let of_its_kind = numbers.iter().filter(|number| number.same_type(like)).cloned().cycle();
    let others = [
        Value::String("text".into()),
        Value::String("long ".repeat(10_000)),
        Value::Boolean(true),
        Value::Array(vec![]),
        Value::Array(vec![Value::Integer(i64::MAX); 2]),
        Value::Array(vec![Value::Integer(0); 2]),
        Value::Table(Table::new()),
        "cem = { horizon = 2, population = 4, elites = 2 }".parse::<Table>().expect("a planner").into(),
        "cvar = nan".parse::<Table>().expect("a risk").into(),
        Value::Datetime("1979-05-27".parse().expect("a date")),
    ];
    let others = numbers.iter().cloned().chain(others);
    of_its_kind.take(100).chain(others).collect()
}

/// The text of the file, and whether it holds anything that must be refused.
fn mutated(mut table: Table, mutations: &[Mutation]) -> (String, bool) {
    let mut must_fail = false;
    for mutation in mutations {
        let paths = paths(&table);
        match mutation {
            Mutation::Replace(path, value) => {
                let path: &Vec<String> = path.get(&paths);
                let place = at(&mut table, path);
                *place = value.get(&hostile_values(place)).clone();
            }
            Mutation::Remove(path) => {
                let path = path.get(&paths);
                let (last, tables) = path.split_last().expect("a path");
                let inner = tables.iter().fold(&mut table, |table, key| table[key].as_table_mut().expect("a table"));
                inner.remove(last);
            }
            Mutation::Unknown(path, name) => {
                let mut path = path.get(&paths).clone();
                *path.last_mut().expect("a path") = name.clone();
                at(&mut table, &path);
            }
            Mutation::Twice(_) | Mutation::Cut(_) => {}
        }
    }
    for path in paths(&table) {
        // These are numbers at no place, and no field of ours has such a name.
        must_fail |= at(&mut table, &path).as_float().is_some_and(|x| !x.is_finite() || x.abs() > 1e20);
    }
    let mut text = toml::to_string(&table).expect("TOML");
    for mutation in mutations {
        match mutation {
            Mutation::Twice(line) if !text.is_empty() => {
                let lines: Vec<&str> = text.lines().collect();
                text = format!("{text}{}\n", line.get(&lines));
            }
            Mutation::Cut(end) if !text.is_empty() => {
                let ends: Vec<usize> = text.char_indices().map(|(end, _)| end).collect();
                text.truncate(*end.get(&ends));
                must_fail = false;
            }
            _ => {}
        }
    }
    (text, must_fail)
}

/// What came of a file.
enum Outcome {
    Refused(Error),
    Used(Result<()>),
}

/// As `train` takes it.
fn outcome(method: &'static str, text: String) -> Result<Outcome, TestCaseError> {
    timed(move || match config_of(method, &text) {
        Ok(config) => Outcome::Used(few_steps(&config)),
        Err(problem) => Outcome::Refused(problem),
    })
}

#[test]
fn hostile_files_are_used_or_refused() {
    let files = SMALL.map(|(method, _)| (method, whole_file(method)));
    let counts = [const { Cell::new(0) }; 3];
    let checked = runner(60).run(&(any::<Index>(), mutations()), |(file, mutations)| {
        let (method, table) = file.get(&files).clone();
        let (text, must_fail) = mutated(table, &mutations);
        let (count, problem) = match outcome(method, text.clone())? {
            Outcome::Used(Ok(())) => (0, None),
            Outcome::Used(Err(problem)) => (1, Some(problem)),
            Outcome::Refused(problem) => (2, Some(problem)),
        };
        counts[count].set(counts[count].get() + 1);
        prop_assert!(count == 2 || !must_fail, "{method} accepted\n{text}");
        prop_assert!(problem.iter().all(brief), "{method}: {}", problem.expect("one"));
        Ok(())
    });
    println!("files used, ended in an error, refused at once: {counts:?}");
    checked.unwrap_or_else(|problem| panic!("{problem}"));
}
