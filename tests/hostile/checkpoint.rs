//! Checkpoints and weights, and the folders that they stand in.

use std::cell::Cell;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use handful::checkpoint::Weights;
use handful::prelude::*;
use handful::study::config::RunConfig;
use handful::study::run::{Event, Run, is_complete};
use handful::study::runner::carry_out_all;
use handful::study::status::{RunState, status};
use handful::study::tables::Tables;
use proptest::prelude::*;
use proptest::sample::Index;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use tempfile::TempDir;

use super::config::{SMALL, registry};
use super::{brief, runner, timed};

const STATE: &str = "checkpoint/state.safetensors";
const WEIGHTS: &str = "weights.safetensors";

/// Steps before the checkpoint is damaged: enough to have learned.
const BEFORE: usize = 30;

fn small(method: &str, seed: u64) -> RunConfig {
    let config = registry().config("reach", method, seed, None, None).expect("a small run");
    RunConfig { steps: if config.learns() { 50 } else { 0 }, test_episodes: 2, evaluate_every: 50, ..config }
}

fn open(config: &RunConfig, folder: &Path) -> Result<Run<Box<dyn Env>>> {
    registry().open_run(config, folder)
}

/// A run that was stopped on the way.
fn begun(config: &RunConfig) -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let mut run = open(config, folder.path()).expect("a new run");
    while config.learns() && (run.steps_done() < BEFORE || !run.between_episodes()) {
        run.step().expect("a healthy run");
    }
    run.save().expect("a writable folder");
    folder
}

fn finish(config: &RunConfig, folder: &Path) -> Result<()> {
    let mut run = open(config, folder)?;
    while !matches!(run.step()?, Event::Tested(_)) {}
    Ok(())
}

fn copy(from: &Path, to: &Path) {
    for file in ["config.toml", STATE, WEIGHTS] {
        let to = to.join(file);
        fs::create_dir_all(to.parent().expect("a folder")).expect("a writable folder");
        if from.join(file).exists() {
            fs::copy(from.join(file), to).expect("a writable folder");
        }
    }
}

fn problem<T>(result: Result<T>) -> String {
    let problem = result.err().expect("an error");
    assert!(brief(&problem), "{problem}");
    problem.to_string()
}

/// Two processes that train in one folder would each overwrite what the other has learned.
#[test]
fn a_run_is_open_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = small("small-sac", 0);
    let state = || status(&[(config.clone(), folder.path().into())])[0].state;
    assert_eq!(state(), RunState::Waiting);
    let run = open(&config, folder.path()).expect("a new run");
    assert!(problem(open(&config, folder.path())).contains("this run is being carried out elsewhere"));
    assert_eq!(state(), RunState::Running);
    drop(run);
    assert_eq!(state(), RunState::Stopped);
    open(&config, folder.path()).expect("the same run");
}

/// Also if the other run differs in nothing but its seed, so that all arrays have the same shapes.
#[test]
fn a_checkpoint_knows_its_run() {
    let [first, second] = [0, 1].map(|seed| begun(&small("small-sac", seed)));
    for file in [STATE, WEIGHTS] {
        fs::copy(second.path().join(file), first.path().join(file)).expect("a writable folder");
    }
    let said = problem(open(&small("small-sac", 0), first.path()));
    assert!(said.contains("state.safetensors: it belongs to another run (its `seed` is 1, not 0)"), "{said}");
    let said = problem(registry().trained_method(first.path()));
    assert!(said.contains("weights.safetensors: it belongs to another run (its `seed` is 1, not 0)"), "{said}");
}

/// A folder with weights but no checkpoint, such as one of `data/trained`, is not trained in from the start. A command that is
/// refused leaves nothing behind.
#[test]
fn what_was_learned_is_not_overwritten() {
    let config = small("small-sac", 0);
    let folder = begun(&config);
    let here = folder.path();
    fs::remove_file(here.join("config.toml")).expect("a writable folder");
    let said = problem(open(&small("small-sac", 1), here));
    assert!(said.contains("it belongs to another run") && !here.join("config.toml").exists(), "{said}");
    drop(open(&config, here).expect("the run to which the checkpoint belongs"));
    let weights = fs::read(here.join(WEIGHTS)).expect("weights");
    fs::remove_file(here.join(STATE)).expect("a writable folder");
    let said = problem(open(&config, here));
    assert!(said.contains("trained weights without a checkpoint"), "{said}");
    assert_eq!(fs::read(here.join(WEIGHTS)).expect("weights"), weights);
}

/// A run is complete, and remains one of its version, also if settings have been added since.
#[test]
fn a_complete_run_of_an_earlier_version_is_left_alone() {
    let (folder, config) = (tempfile::tempdir().expect("a folder"), small("small-sac", 0));
    let here = folder.path();
    finish(&config, here).expect("a healthy run");
    let edit = |file: &str, change: &dyn Fn(&str) -> Option<String>| {
        let text = fs::read_to_string(here.join(file)).expect(file);
        let lines = text.lines().filter_map(change).map(|line| line + "\n");
        fs::write(here.join(file), lines.collect::<String>()).expect("a writable folder");
    };
    let not = |start: &'static str| move |line: &str| (!line.starts_with(start)).then(|| line.to_string());
    edit("config.toml", &not("hindsight ="));
    edit("config.toml", &not("values ="));
    let version = "version = \"0.0.9\"";
    edit("summary.toml", &|line| Some(if line.starts_with("version =") { version.into() } else { line.into() }));
    let summary = || fs::read_to_string(here.join("summary.toml")).expect("a summary");
    let before = summary();
    assert!(before.contains(version) && !is_complete(here, &config), "the configurations differ: {before}");
    let runs = [(config.clone(), here.to_path_buf())];
    let carry_out = || carry_out_all(&registry(), &runs, 1, &(), &AtomicBool::new(false)).expect("a healthy run");
    carry_out();
    assert_eq!(summary(), before);
    // What is written anew is still what that version made.
    fs::remove_file(here.join("values.csv")).expect("a writable folder");
    fs::remove_file(here.join(STATE)).expect("a writable folder");
    carry_out();
    assert_eq!(summary(), before);
}

/// A study writes anew what a finished run has lost, without training again.
#[test]
fn what_a_finished_run_lost_comes_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let (here, config) = (folder.path(), small("small-pets", 0));
    finish(&config, here).expect("a healthy run");
    assert!(is_complete(here, &config) && !is_complete(here, &small("small-pets", 1)));
    let runs = [(config.clone(), here.to_path_buf())];
    let checkpoint = fs::read(here.join(STATE)).expect("a checkpoint");
    let mut files = vec!["config.toml", "summary.toml", WEIGHTS];
    files.extend(["episodes.csv", "evaluations.csv", "losses.csv", "model.csv", "values.csv", "test.csv"]);
    for file in &files[1..] {
        let whole = fs::read(here.join(file)).expect(file);
        let flipped = whole.iter().enumerate().map(|(i, byte)| byte ^ u8::from(i == whole.len() / 2)).collect();
        for damaged in [None, Some(Vec::new()), Some(flipped)] {
            match damaged {
                None => fs::remove_file(here.join(file)).expect("a writable folder"),
                // Half of a number is a number.
                Some(_) if *file == "summary.toml" && damaged != Some(Vec::new()) => continue,
                Some(bytes) => fs::write(here.join(file), bytes).expect("a writable folder"),
            }
            if file.ends_with("csv") {
                let said = problem(Tables::gather([here]));
                assert!(said.contains(file) && said.contains("lost or changed after the run had ended"), "{said}");
            }
            // What a kill in the middle of a write leaves behind.
            fs::write(here.join("checkpoint/.handful-a1B2c3"), "half").expect("a writable folder");
            assert!(!is_complete(here, &config), "{file}");
            carry_out_all(&registry(), &runs, 1, &(), &AtomicBool::new(false)).expect("a healthy run");
            assert!(is_complete(here, &config) && fs::read(here.join(file)).expect(file) == whole, "{file}");
            assert!(!here.join("checkpoint/.handful-a1B2c3").exists());
        }
    }
    let [before, after] = [checkpoint, fs::read(here.join(STATE)).expect("a checkpoint")].map(|bytes| bytes.len());
    assert!(before.abs_diff(after) < 100, "nothing was learned anew: {before} and {after} bytes");
    // Without a checkpoint nothing can be written anew: the run has ended as it is.
    fs::remove_file(here.join(STATE)).expect("a writable folder");
    fs::remove_file(here.join("values.csv")).expect("a writable folder");
    assert!(is_complete(here, &config));
}

/// Runs that cannot be used are in no table, and the report names each with the reason.
#[test]
fn runs_that_cannot_be_used_are_left_out_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let study = folder.path().join("study");
    let run = |name: &str, config: &RunConfig| {
        let place = folder.path().join(name);
        finish(config, &place).expect("a healthy run");
        place
    };
    let mut runs: Vec<PathBuf> = (0..3).map(|seed| run(&format!("seed{seed}"), &small("small-sac", seed))).collect();
    let whole = fs::read(runs[1].join("test.csv")).expect("a table");
    fs::write(runs[1].join("test.csv"), &whole[..whole.len() / 2]).expect("a writable folder");
    let other = RunConfig { evaluation_episodes: 3, ..small("small-sac", 3) };
    runs.extend([run("other", &other), runs[0].clone(), folder.path().join("nothing")]);
    let gathered = Tables::gather(runs.iter().map(PathBuf::as_path)).expect("two healthy runs");
    gathered.write(&study).expect("a writable folder");
    handful::study::report::write(&study, &study).expect("a report");
    let tables = Tables::read(&study).expect("the tables");
    let seeds = tables.seeds_of_learners().expect("the tables").into_values().next().expect("a method");
    assert_eq!(seeds.into_iter().collect::<Vec<_>>(), [0, 2]);
    let configurations = tables.runs().expect("the tables");
    let written = fs::read_to_string(runs[2].join("config.toml")).expect("a configuration");
    assert_eq!(configurations[1].configuration.trim(), written.trim());
    let report = fs::read_to_string(study.join("report.md")).expect("a report");
    for part in [
        "**no**: everything that was found among the runs is included. Exceptions: `",
        "seed1/test.csv: it was lost or changed after the run had ended",
        "with seed 3 has another configuration than with seed 0 (its  evaluation_episodes  is ",
        "with seed 0 is there twice",
        "nothing/config.toml",
        ": seeds 0, 2; version 0.",
    ] {
        assert!(report.contains(part), "no `{part}` in: {report}");
    }
    // The next attempt finds nothing to complain of.
    Tables::gather([runs[0].as_path()]).expect("a healthy run").write(&study).expect("a writable folder");
    assert!(!study.join("left_out.csv").exists());
}

/// Arrays, by their places, and what becomes of them. The checksum is right: somebody made this file.
#[derive(Clone, Debug)]
enum Forgery {
    /// A number of an array becomes another one.
    Number(Index, Index, Index),
    /// All of them do.
    All(Index, Index),
    /// An array has other numbers of rows.
    Rows(Index, usize),
    /// A whole number.
    Count(Index, Index, Index),
    /// The list of whole numbers is shorter or longer.
    Counts(Index, usize),
    /// A number in the progress.
    Progress(Index, Index),
}

fn forgeries() -> impl Strategy<Value = Forgery> {
    let index = any::<Index>;
    prop_oneof![
        3 => (index(), index(), index()).prop_map(|(array, place, value)| Forgery::Number(array, place, value)),
        2 => (index(), index()).prop_map(|(array, value)| Forgery::All(array, value)),
        1 => (index(), 0..3_usize).prop_map(|(array, rows)| Forgery::Rows(array, rows)),
        4 => (index(), index(), index()).prop_map(|(array, place, value)| Forgery::Count(array, place, value)),
        1 => (index(), 0..5_usize).prop_map(|(array, count)| Forgery::Counts(array, count)),
        2 => (index(), index()).prop_map(|(place, value)| Forgery::Progress(place, value)),
    ]
}

const FLOATS: [f32; 10] = [0.0, -1.0, 1.0, 0.5, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 1e-40, f32::NAN];
const COUNTS: [u64; 9] = [0, 1, 7, 50, 1 << 20, 1 << 32, 1 << 47, 1 << 63, u64::MAX];
const TEXTS: [&str; 7] = ["0", "-1", "9223372036854775807", "1e300", "nan", "'text'", "[]"];

fn forge(path: &Path, forgery: &Forgery) {
    let bytes = fs::read(path).expect("a checkpoint");
    let file = SafeTensors::deserialize(&bytes).expect("a checkpoint");
    let names = |dtypes: &[Dtype]| {
        let chosen = |view: &TensorView| dtypes.contains(&view.dtype()) && !view.data().is_empty();
        let all = file.tensors().into_iter().filter(|(_, view)| chosen(view));
        let mut names: Vec<String> = all.map(|(name, _)| name).collect();
        names.sort();
        names
    };
    let mut weights = Weights::read(path).expect("a checkpoint");
    let array = |weights: &Weights, index: &Index| {
        let name = index.get(&names(&[Dtype::F32, Dtype::F16])).clone();
        let shape = weights.shape(&name).expect("an array");
        let numbers = weights.get(&name, shape).expect("an array").to_vec();
        (name, numbers, shape)
    };
    let counts = |weights: &Weights, index: &Index| {
        let name = index.get(&names(&[Dtype::U64])).clone();
        let count = file.tensor(&name).expect("an array").shape()[0];
        (weights.counts(&name, count).expect("whole numbers"), name)
    };
    match forgery {
        Forgery::Number(which, place, value) => {
            let (name, mut numbers, shape) = array(&weights, which);
            let place = place.index(numbers.len());
            numbers[place] = *value.get(&FLOATS);
            weights.insert(name, numbers, shape);
        }
        Forgery::All(which, value) => {
            let (name, mut numbers, shape) = array(&weights, which);
            numbers.fill(*value.get(&FLOATS));
            weights.insert(name, numbers, shape);
        }
        Forgery::Rows(which, rows) => {
            let (name, mut numbers, [members, _, columns]) = array(&weights, which);
            numbers.resize(members * rows * columns, 0.5);
            weights.insert(name, numbers, [members, *rows, columns]);
        }
        Forgery::Count(which, place, value) => {
            let (mut numbers, name) = counts(&weights, which);
            let place = place.index(numbers.len());
            numbers[place] = *value.get(&COUNTS);
            weights.insert_counts(name, &numbers);
        }
        Forgery::Counts(which, count) => {
            let (mut numbers, name) = counts(&weights, which);
            numbers.resize(*count, 0);
            weights.insert_counts(name, &numbers);
        }
        Forgery::Progress(place, value) => {
            let progress = weights.note("progress").expect("progress").to_string();
            let lines: Vec<&str> = progress.lines().collect();
            let values: Vec<usize> = (0..lines.len()).filter(|i| lines[*i].contains(" = ")).collect();
            let place = place.get(&values);
            let (key, _) = lines[*place].split_once(" = ").expect("a key and its value");
            let line = format!("{key} = {}", value.get(&TEXTS));
            let lines: Vec<&str> = (0..lines.len()).map(|i| if i == *place { &line } else { lines[i] }).collect();
            weights.set_note("progress", lines.join("\n"));
        }
    }
    weights.write(path).expect("a writable folder");
}

/// What came of a run whose checkpoint, and whose weights, were damaged: it may go on, or end in an error that can be read.
fn attempt(config: RunConfig, folder: TempDir) -> Result<(usize, Option<Error>), TestCaseError> {
    timed(move || {
        let acted = registry().trained_method(folder.path()).and_then(|(config, mut method)| {
            let mut evaluator = Evaluator::new(|| registry().make_env(&config))?;
            evaluator.evaluate(&mut method, 1, EvalSeeds::Development).map(|_| ())
        });
        match (open(&config, folder.path()), acted) {
            (Err(problem), _) => (2, Some(problem)),
            (Ok(_), Err(problem)) => (1, Some(problem)),
            (Ok(run), Ok(())) => {
                drop(run);
                let problem = finish(&config, folder.path()).err();
                (usize::from(problem.is_some()), problem)
            }
        }
    })
}

/// Whatever the numbers in a checkpoint are.
#[test]
fn forged_checkpoints_are_used_or_refused() {
    let learners = SMALL.map(|(method, _)| small(method, 0));
    let runs: Vec<(RunConfig, TempDir)> = learners.into_iter().map(|config| (config.clone(), begun(&config))).collect();
    let counts = [const { Cell::new(0) }; 3];
    let checked = runner(30).run(&(any::<Index>(), any::<bool>(), forgeries()), |(run, state, forgery)| {
        let (config, saved) = run.get(&runs);
        let folder = tempfile::tempdir().expect("a folder");
        copy(saved.path(), folder.path());
        let state = state || !config.learns() || matches!(forgery, Forgery::Progress(..));
        let path = folder.path().join(if state { STATE } else { WEIGHTS });
        let unforgeable = !config.learns() && !matches!(forgery, Forgery::Progress(..))
            || !state && matches!(forgery, Forgery::Count(..) | Forgery::Counts(..)) && config.agent != "pets";
        if !unforgeable {
            forge(&path, &forgery);
        }
        let (outcome, problem) = attempt(config.clone(), folder)?;
        counts[outcome].set(counts[outcome].get() + 1);
        prop_assert!(problem.iter().all(brief), "{}: {}", config.method, problem.expect("one"));
        prop_assert!(!unforgeable || outcome == 0);
        Ok(())
    });
    println!("checkpoints used, ended in an error, refused at once: {counts:?}");
    checked.unwrap_or_else(|problem| panic!("{problem}"));
}

/// Accidents: bits that flip, ends that are missing, blocks that are zero or another file's. What they change is told.
#[test]
fn damaged_checkpoints_are_refused() {
    let methods = ["small-sac", "small-pets", "small-dreamer", "small-tdmpc2"];
    let runs = methods.map(|method| begun(&small(method, 0)));
    let others = methods.map(|method| begun(&small(method, 1)));
    let read = |folder: &TempDir, file: &str| fs::read(folder.path().join(file)).expect("a checkpoint");
    let path = tempfile::tempdir().expect("a folder").keep().join("damaged.safetensors");
    let damage = prop_oneof![
        4 => prop::collection::vec((any::<Index>(), 0..8_u32), 1..4).prop_map(Damage::Flips),
        1 => any::<Index>().prop_map(Damage::Cut),
        1 => any::<(Index, Index)>().prop_map(|(from, to)| Damage::Zeros(from, to)),
        2 => any::<(Index, Index)>().prop_map(|(from, to)| Damage::Splice(from, to)),
    ];
    let counts = [const { Cell::new(0) }; 2];
    let checked = runner(300).run(&(0..methods.len(), any::<bool>(), damage), |(run, state, damage)| {
        let file = if state { STATE } else { WEIGHTS };
        let whole = read(&runs[run], file);
        fs::write(&path, damage.of(whole.clone(), &read(&others[run], file))).expect("a writable folder");
        let damaged = Weights::read(&path);
        fs::write(&path, &whole).expect("a writable folder");
        counts[usize::from(damaged.is_ok())].set(counts[usize::from(damaged.is_ok())].get() + 1);
        match damaged {
            // Nothing but spaces or the like was changed.
            Ok(read) => prop_assert_eq!(read, Weights::read(&path).expect("the whole")),
            Err(problem) => prop_assert!(brief(&problem), "{problem}"),
        }
        Ok(())
    });
    fs::remove_dir_all(path.parent().expect("a folder")).expect("a writable folder");
    println!("damaged checkpoints refused, the same as before: {counts:?}");
    checked.unwrap_or_else(|problem| panic!("{problem}"));
}

#[derive(Clone, Debug)]
enum Damage {
    Flips(Vec<(Index, u32)>),
    Cut(Index),
    Zeros(Index, Index),
    /// A block of another run's file.
    Splice(Index, Index),
}

impl Damage {
    fn of(&self, mut bytes: Vec<u8>, other: &[u8]) -> Vec<u8> {
        let length = bytes.len();
        let block = |from: &Index, to: &Index| {
            let (from, to) = (from.index(length), to.index(length));
            from.min(to)..from.max(to) + 1
        };
        match self {
            Self::Flips(bits) => {
                for (byte, bit) in bits {
                    let byte = byte.index(bytes.len());
                    bytes[byte] ^= 1 << bit;
                }
            }
            Self::Cut(end) => bytes.truncate(end.index(bytes.len())),
            Self::Zeros(from, to) => bytes[block(from, to)].fill(0),
            Self::Splice(from, to) => {
                let block = block(from, to);
                let end = block.end.min(other.len());
                if block.start < end {
                    bytes[block.start..end].copy_from_slice(&other[block.start..end]);
                }
            }
        }
        bytes
    }
}
