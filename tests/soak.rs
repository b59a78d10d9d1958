//! Runs that are killed at random moments, again and again, end as if nothing had happened.
//!
//! `cargo test` kills a small study five times. `cargo test --test soak -- --ignored --nocapture` kills runs of every method 200 times,
//! which takes a quarter of an hour; the environment variable `SOAK_KILLS` sets another number.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use handful::rng;
use rand::RngExt;

/// A run that takes a few seconds, of each method that learns.
const SMALL: [(&str, &str, &str); 5] = [
    ("pendulum", "sac", "steps = 4000\nsac = { hidden = [32, 32], batch = 32, warm_up = 400 }"),
    (
        "reach",
        "pets",
        "steps = 1500
         [pets]
         warm_up = 200
         ensemble = { hidden = [16], first_steps = 50, steps = 20, check_every = 10 }
         planner.icem = { horizon = 4, population = 10, elites = 4, iterations = 2 }",
    ),
    (
        "reach",
        "dreamer",
        "steps = 2000
         [dreamer]
         batch = 2
         length = 8
         train_ratio = 1.0
         warm_up = 200
         world = { units = 16, layers = 1, rssm = { deter = 16, blocks = 2, hidden = 8, stoch = 4, classes = 4 } }
         behaviour = { units = 16, layers = 1, horizon = 5 }",
    ),
    (
        "reach",
        "tdmpc2",
        "steps = 2000
         [tdmpc2]
         batch = 8
         updates_per_step = 0.2
         warm_up = 200
         model = { latent = 16, encoder = 16, units = 16, bins = 21 }
         planner = { population = 20, proposals = 5, elites = 5, iterations = 2 }",
    ),
    ("reach", "debug", "steps = 4000"),
];

const COMMON: &str = "evaluate_every = 500\nevaluation_episodes = 2\ntest_episodes = 50\n";

/// A process that is killed has no time for anything; one that is asked to stop saves first.
const KILL: &str = "-KILL";
const SIGNALS: [&str; 6] = [KILL, KILL, KILL, "-TERM", "-INT", "-HUP"];

/// Columns of wall-clock time.
const TIMES: [&str; 3] = ["seconds", "seconds_to_80", "action_ms"];

/// No command takes longer, or it hangs.
const PATIENCE: Duration = Duration::from_secs(300);

/// A command, and the folder in which it works.
struct Job {
    args: Vec<String>,
    folder: PathBuf,
}

impl Job {
    fn start(&self) -> Child {
        let mut command = Command::new(env!("CARGO_BIN_EXE_handful"));
        command.args(&self.args).arg("--out").arg(&self.folder);
        command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the program starts")
    }

    /// Kills it by one of these signals after another, each after a random while, until it is done or `most` of them have ended it: then it
    /// is left in peace. Returns the signals that found it at work.
    fn harassed(
        &self,
        signals: &[&'static str],
        most: usize,
        longest: Duration,
        rng: &mut rng::Rng,
    ) -> Vec<&'static str> {
        let mut sent = Vec::new();
        loop {
            let child = self.start();
            let next = (sent.len() < most).then(|| {
                let signal = signals[rng.random_range(0..signals.len())];
                (signal, Instant::now() + longest.mul_f64(rng.random()))
            });
            let (status, said) = outcome(child, next);
            assert!(!said.contains("panicked"), "{:?}: {said}", self.args);
            match (status.code(), next) {
                (Some(0), _) => return sent,
                // 130: saved and stopped, as it was asked to; no code: killed.
                (Some(130) | None, Some((signal, _))) => sent.push(signal),
                _ => panic!("{:?} ended with {status}: {said}", self.args),
            }
        }
    }
}

/// How a process ended, and what it said. If it is still there at the given moment, it gets a signal.
fn outcome(mut child: Child, mut signal: Option<(&str, Instant)>) -> (ExitStatus, String) {
    let began = Instant::now();
    while child.try_wait().expect("a process").is_none() {
        assert!(began.elapsed() < PATIENCE, "a hang");
        if let Some((name, _)) = signal.take_if(|(_, at)| Instant::now() > *at) {
            // It may have ended in this very moment.
            let _ = Command::new("kill").args([name, &child.id().to_string()]).stderr(Stdio::null()).status();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let output = child.wait_with_output().expect("a process");
    (output.status, String::from_utf8_lossy(&output.stderr).into_owned())
}

/// All results in a folder and those below: weights, figures, and tables without running times. Checkpoints and profiles have times in
/// them. Next to a study's tables, and among its recordings, the temporary files of a killed process stay for an hour, because they might
/// be another's.
fn results(folder: &Path, killed: bool) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let shared = folder.ends_with("replays") || folder.join("replays.csv").exists();
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        let name = path.file_name().and_then(|name| name.to_str()).expect("a name").to_string();
        if shared && name.starts_with(".handful-") {
            assert!(killed, "{}: left behind", path.display());
            continue;
        }
        if path.is_dir() {
            let below = if name == "checkpoint" { BTreeMap::new() } else { results(&path, killed) };
            found.extend(below.into_iter().map(|(file, bytes)| (Path::new(&name).join(file), bytes)));
        } else if name.ends_with(".csv") {
            found.insert(name.into(), without_times(&fs::read_to_string(&path).expect("a table")).into());
        } else if !["summary.toml", "report.md", "report.html", "events.out.tfevents.handful"].contains(&name.as_str())
            && !name.ends_with("-profile.svg")
        {
            found.insert(name.into(), fs::read(&path).expect("a file"));
        }
    }
    found
}

/// A table without its columns of wall-clock time. One that has none stays as it is: there may be commas and ends of lines in its cells.
fn without_times(table: &str) -> String {
    let head: Vec<&str> = table.lines().next().unwrap_or_default().split(',').collect();
    if !head.iter().any(|name| TIMES.contains(name)) {
        return table.into();
    }
    let kept = |line: &str| -> String {
        let cells = line.split(',').zip(&head).filter(|(_, name)| !TIMES.contains(name));
        cells.map(|(cell, _)| cell).collect::<Vec<_>>().join(",") + "\n"
    };
    table.lines().map(kept).collect()
}

fn command(words: &str) -> Vec<String> {
    words.split(' ').map(String::from).collect()
}

/// Carries out each command once without disturbance; then all of them in turn, killed by these signals at random moments, until so many
/// signals have found a process at work. One that comes too late is no kill, and another round makes up for it. Each time the folder ends
/// with what the undisturbed command left there.
///
/// A process is killed at the latest after half of the time that the undisturbed command took. So the moments lie anywhere in its work,
/// which each kill prolongs by what was not saved yet; and on every machine, N kills of one command and its two whole runs take at most
/// about N / 2 + 2 times as long as the command alone, on average N / 4 + 2 times.
fn kills_leave_no_trace(commands: &[Vec<String>], folder: &Path, signals: &[&'static str], wanted: usize) {
    let job = |args: &[String], name: &str| Job { args: args.to_vec(), folder: folder.join(name) };
    let whole: Vec<_> = commands
        .iter()
        .map(|args| {
            let job = job(args, "whole");
            let began = Instant::now();
            let (status, said) = outcome(job.start(), None);
            assert!(status.success(), "{args:?}: {said}");
            let whole = (results(&job.folder, false), began.elapsed());
            fs::remove_dir_all(&job.folder).expect("a writable folder");
            whole
        })
        .collect();
    let mut kills: BTreeMap<&str, usize> = BTreeMap::new();
    let (mut rounds, mut rng) = (0, rng::stream(0, "soak"));
    while kills.values().sum::<usize>() < wanted {
        for (args, (whole, took)) in commands.iter().zip(&whole) {
            let job = job(args, "killed");
            let left = wanted - kills.values().sum::<usize>();
            let sent = job.harassed(signals, left, took.mul_f64(0.5), &mut rng);
            println!("{}: {sent:?}", args.join(" "));
            sent.into_iter().for_each(|signal| *kills.entry(signal).or_default() += 1);
            let killed = results(&job.folder, true);
            assert_eq!(killed.keys().collect::<Vec<_>>(), whole.keys().collect::<Vec<_>>(), "{args:?}");
            for (file, bytes) in whole {
                assert!(&killed[file] == bytes, "{args:?}: {} differs", file.display());
            }
            fs::remove_dir_all(&job.folder).expect("a writable folder");
        }
        rounds += 1;
    }
    println!(
        "{rounds} rounds of {} commands, killed by {kills:?}: the same weights and tables each time",
        commands.len()
    );
}

/// `debug` is SAC with small networks and few steps. All four runs at a time: with few cores, each then takes longer than the second after
/// which it first saves, so that kills find several runs that have saved on the way.
#[test]
fn a_study_killed_five_times_ends_with_the_same_tables() {
    let folder = tempfile::tempdir().expect("a folder");
    let study = command("study --methods random,debug --seeds 3 --jobs 4");
    kills_leave_no_trace(&[study], folder.path(), &[KILL], 5);
}

#[test]
#[ignore = "a quarter of an hour"]
fn killed_runs_end_as_if_nothing_had_happened() {
    let wanted = std::env::var("SOAK_KILLS").map_or(200, |kills| kills.parse().expect("a number of kills"));
    let folder = tempfile::tempdir().expect("a folder");
    let mut commands = Vec::new();
    for (task, method, settings) in SMALL {
        let config = folder.path().join(format!("{method}.toml"));
        fs::write(&config, format!("{COMMON}{settings}")).expect("a writable folder");
        let mut train = command(&format!("train --task {task} --method {method} --config"));
        train.push(config.to_str().expect("text").into());
        commands.push(train);
    }
    commands.push(command("study --tasks reach,pendulum --methods random,debug --seeds 3 --jobs 2"));
    kills_leave_no_trace(&commands, folder.path(), &SIGNALS, wanted);
}
