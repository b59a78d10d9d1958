//! Reports on studies whose tables were cut, mixed, or put into each other's place.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, SystemTime};

use handful::study::tables::Tables;
use handful::study::{replays, report};
use tempfile::TempDir;

const ALL: [&str; 3] = ["pole,random,0", "pole,debug,0", "pole,debug,1"];

/// A study by hand of these runs: `debug` learns for 1,000 steps and is evaluated every 500; tests have three episodes.
fn study(runs: &[&str], starts: &str) -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let mut tests =
        String::from("task,method,seed,episode,return,success,length,stage,sparc,ldlj,action_change,starts\n");
    let mut evaluations = String::from("task,method,seed,step,episodes,success\n");
    let mut values = String::from("task,method,seed,step,expected,realised,rmse,correlation\n");
    let mut configurations = String::from("task,method,seed,version,configuration\n");
    for run in runs {
        for episode in 1..=3 {
            tests += &format!("{run},{episode},-{episode}.5,true,200,0,,,,{starts}\n");
        }
        let steps = if run.contains("debug") { 1000 } else { 0 };
        for step in (0..=steps).step_by(500).filter(|_| steps > 0) {
            evaluations += &format!("{run},{step},20,0.5\n");
            values += &format!("{run},{step},1.0,2.0,1.0,0.5\n");
        }
        let seed = run.rsplit(',').next().expect("a seed");
        let settings = format!(
            "seed = {seed}\nsteps = {steps}\nevaluate_every = 500\ntest_episodes = 3\nstarts = \"\"{starts}\"\"\n"
        );
        configurations += &format!("{run},1,\"{settings}\"\n");
    }
    for (file, text) in [
        ("tests.csv", tests),
        ("evaluations.csv", evaluations),
        ("runs.csv", configurations),
        ("models.csv", String::new()),
        ("values.csv", values),
    ] {
        fs::write(folder.path().join(file), text).expect("a writable folder");
    }
    folder
}

/// Changes the text of a file.
fn edit(folder: &TempDir, file: &str, change: impl Fn(String) -> String) {
    let path = folder.path().join(file);
    let before = fs::read_to_string(&path).expect(file);
    let after = change(before.clone());
    assert_ne!(before, after, "{file} is changed");
    fs::write(path, after).expect("a writable folder");
}

fn paths(studies: &[&TempDir]) -> Vec<PathBuf> {
    studies.iter().map(|study| study.path().into()).collect()
}

/// The names of all runs that count.
fn runs(tables: &Tables) -> Vec<String> {
    let runs = tables.runs().expect("the runs");
    runs.iter().map(|run| format!("{},{},{}", run.task, run.method, run.seed)).collect()
}

#[test]
fn a_run_that_is_not_whole_is_left_out_by_name() {
    let whole = study(&ALL, "test");
    let tables = Tables::read(whole.path()).expect("a study");
    assert!(runs(&tables) == ALL && tables.missing_runs().expect("a table").is_empty());
    let last_line_less = |text: String| text.trim_end().rsplit_once('\n').expect("several lines").0.to_string() + "\n";
    let middle_less = |text: String| text.replace("pole,debug,1,500,20,0.5\n", "");
    let other = |text: String| text.replace("seed = 1\n", "seed = 1\nreward = 2\n");
    let elsewhere = |text: String| {
        let (before, last) = text.rsplit_once("starts = ").expect("a configuration");
        format!("{before}starts = {}", last.replace("test", "development"))
    };
    for (file, change, reason) in [
        ("evaluations.csv", &last_line_less as &dyn Fn(String) -> String, "is at step 500 of 1000"),
        ("evaluations.csv", &middle_less, "its evaluation at step 500 is not in"),
        ("tests.csv", &last_line_less, "its test in `tests.csv` has 2 of 3 episodes"),
        ("values.csv", &last_line_less, "its last evaluation, at step 1000, is not in `values.csv`"),
        ("runs.csv", &elsewhere, "tested on the starts `development`, `tests.csv` says `test`"),
        ("runs.csv", &other, "it has another configuration than with seed 0 (its `reward` is 2, not nothing)"),
    ] {
        let folder = study(&ALL, "test");
        edit(&folder, file, change);
        let tables = Tables::read(folder.path()).expect("two whole runs");
        assert_eq!(runs(&tables), ALL[..2], "{file}");
        assert_eq!(tables.value("pole", "debug", "seeds").expect("a column"), Some(1.0), "{file}");
        let [(run, why)] = &tables.missing_runs().expect("a table")[..] else { panic!("one run is left out: {file}") };
        assert!(run.ends_with("debug on pole with seed 1") && why.contains(reason), "{run}: {why}");
        report::write(folder.path(), folder.path()).expect("a report");
        let text = fs::read_to_string(folder.path().join("report.md")).expect("a report");
        assert!(
            text.contains("**no**: everything that was found among the runs is included. Exceptions: `")
                && text.contains("seed 1"),
            "{text}"
        );
        // It does not come back in a joined study.
        let joined = Tables::read_all(&paths(&[&folder])).expect("two whole runs");
        assert_eq!(runs(&joined), ALL[..2]);
        assert_eq!(joined.missing_runs().expect("a table").len(), 1);
    }
    let none = study(&ALL[2..], "test");
    edit(&none, "tests.csv", last_line_less);
    let said = Tables::read(none.path()).expect_err("no whole run").to_string();
    assert!(said.contains("no run can be reported; `debug` on `pole` with seed 1: its test in"), "{said}");
}

/// What was written a minute ago may be another process's that is still writing.
#[test]
fn a_report_removes_what_killed_processes_left_long_ago() {
    let folder = study(&ALL, "test");
    fs::create_dir(folder.path().join("replays")).expect("a writable folder");
    let temporary = |name: &str, age: u64| {
        let path = folder.path().join(name);
        let written = SystemTime::now() - Duration::from_secs(age);
        fs::File::create(&path).and_then(|file| file.set_modified(written)).expect("a writable folder");
        path
    };
    let old = [".handful-a1B2c3", "replays/.handful-a1B2c3"].map(|name| temporary(name, 7200));
    let young = [".handful-d4E5f6", "replays/.handful-d4E5f6"].map(|name| temporary(name, 60));
    report::write(folder.path(), folder.path()).expect("a report");
    assert!(!old.iter().any(|file| file.exists()));
    assert!(young.iter().all(|file| file.exists()));
}

/// Without the column, the tests would count as those on the test's starts.
#[test]
fn tuning_runs_stay_tuning_runs() {
    let tuning = study(&ALL, "development");
    edit(&tuning, "tests.csv", |text| text.replace(",starts\n", "\n").replace(",development\n", "\n"));
    let said = Tables::read(tuning.path()).expect_err("other starts").to_string();
    assert!(said.contains("tested on the starts `development`, `tests.csv` says `test`"), "{said}");
}

#[test]
fn a_run_that_is_not_in_a_table_is_refused() {
    let without = |run: &'static str| {
        move |text: String| {
            let kept = text.split_inclusive('\n').filter(|line| !line.starts_with(run));
            kept.collect::<String>()
        }
    };
    let folder = study(&ALL, "test");
    edit(&folder, "evaluations.csv", without("pole,debug"));
    let said = Tables::read(folder.path()).expect_err("no curve").to_string();
    assert!(said.contains("`debug` on `pole` with seed 0 is not in its evaluations.csv"), "{said}");
    let folder = study(&ALL, "test");
    // Its configuration has several lines.
    edit(&folder, "runs.csv", |text| text.split("pole,debug,1").next().expect("a beginning").into());
    let said = Tables::read(folder.path()).expect_err("no configuration").to_string();
    assert!(said.contains("`debug` on `pole` with seed 1 is not in its runs.csv"), "{said}");
    // Earlier versions had no such table.
    fs::remove_file(folder.path().join("runs.csv")).expect("a writable folder");
    Tables::read(folder.path()).expect("the tables of an earlier version");
}

#[test]
fn studies_on_other_starts_are_not_joined() {
    let (reported, tuning) = (study(&ALL, "test"), study(&ALL, "development"));
    let said = Tables::read_all(&paths(&[&reported, &tuning])).expect_err("two kinds of runs").to_string();
    assert!(said.contains("`test`") && said.contains("on `development`; compare them separately"), "{said}");
}

#[test]
fn what_was_not_recorded_is_no_other_configuration() {
    let (old, new) = (study(&ALL[..2], "test"), study(&ALL[2..], "test"));
    fs::remove_file(old.path().join("runs.csv")).expect("a writable folder");
    for (studies, reason) in [
        ([&new, &old], "it cannot be compared with seed 1: its configuration is not recorded"),
        ([&old, &new], "it cannot be compared with seed 0: the configuration of that is not recorded"),
    ] {
        let joined = Tables::read_all(&paths(&studies)).expect("a study");
        let [(_, why)] = &joined.missing_runs().expect("a table")[..] else { panic!("one run is left out") };
        assert_eq!(why, reason);
        // The joined tables name all of their runs, and can be read again.
        let to = tempfile::tempdir().expect("a folder");
        joined.write(to.path()).expect("a writable folder");
        assert_eq!(runs(&Tables::read(to.path()).expect("a study")).len(), 2);
        report::write(to.path(), to.path()).expect("a report");
    }
}

#[test]
fn the_tables_of_another_study_are_not_replaced() {
    let (first, second, other) = (study(&ALL[..2], "test"), study(&ALL[2..], "test"), study(&["pole,sac,0"], "test"));
    let to = tempfile::tempdir().expect("a folder");
    for _ in 0..2 {
        report::join(&paths(&[&first, &second]), to.path()).expect("a study");
    }
    let before = fs::read(to.path().join("tests.csv")).expect("a table");
    let join = report::join(&paths(&[&first, &other]), to.path()).map(drop);
    for (outcome, expected) in [
        (join, "holds the tables of another study (with `debug` on `pole`, seed 1)"),
        (report::write(first.path(), to.path()).map(drop), "holds a study of its own"),
    ] {
        let said = outcome.expect_err("another study").to_string();
        assert!(said.contains(expected) && said.contains("choose another --out"), "{said}");
    }
    assert_eq!(fs::read(to.path().join("tests.csv")).expect("a table"), before);
    assert!(!to.path().join("report.md").exists());
}

/// A recording in one place and its table in another.
fn with_recording(file: &str) -> TempDir {
    let folder = study(&ALL, "test");
    let table =
        format!("task,method,seed,which,episode,return,success,file\npole,random,0,median,2,-2.5,true,{file}\n");
    fs::write(folder.path().join("replays.csv"), table).expect("a writable folder");
    folder
}

#[test]
fn recordings_stay_in_their_folder() {
    for file in ["../esc.json.gz", "replays/../../esc.json.gz", "/tmp/esc.json.gz", "replays/.json.gz", "replays/a.svg"]
    {
        let folder = with_recording(file);
        let to = tempfile::tempdir().expect("a folder");
        let outcome = report::write(folder.path(), &to.path().join("to")).map(drop);
        let said = outcome.expect_err(file).to_string();
        assert!(said.contains("replays.csv: line 2: `file` is `") && said.contains(file), "{said}");
        assert!(!to.path().join("esc.json.gz").exists());
        assert!(report::join(&paths(&[&folder]), &to.path().join("joined")).is_err());
    }
}

/// Tables are often copied without what belongs to them.
#[test]
fn a_report_is_made_without_its_recordings() {
    let folder = with_recording("replays/pole-random-median.json.gz");
    let to = tempfile::tempdir().expect("a folder");
    report::write(folder.path(), to.path()).expect("a report");
    let text = fs::read_to_string(to.path().join("report.md")).expect("a report");
    assert!(!text.contains("json.gz"), "{text}");
    let problems = report::join(&paths(&[&folder]), &to.path().join("joined")).expect("a study");
    assert!(problems.len() == 1 && problems[0].contains("cannot read"), "{problems:?}");
}

#[test]
fn another_recording_of_the_same_name_is_recorded_anew() {
    use handful::prelude::*;
    use handful::study::config::RunConfig;
    use handful::study::run::Event;
    use handful::study::starts::Starts;
    let registry = Registry::standard();
    let root = tempfile::tempdir().expect("a folder");
    let config = registry.config("pendulum", "random", 0, None, None).expect("a preset");
    let config = RunConfig { test_episodes: 3, ..config };
    let others = [RunConfig { seed: 1, ..config.clone() }, RunConfig { starts: Starts::Development, ..config.clone() }];
    let never = AtomicBool::new(false);
    let recorded = |name: &str, config: &RunConfig| -> PathBuf {
        let (run, folder) = (root.path().join(name).join("run"), root.path().join(name));
        let mut open = registry.open_run(config, &run).expect("a run");
        while !matches!(open.step().expect("a healthy run"), Event::Tested(_)) {}
        let problems =
            replays::record(&registry, &[(config.clone(), run)], &folder, &never).expect("a writable folder");
        assert!(problems.is_empty(), "{problems:?}");
        folder.join("replays/pendulum-random-median.json.gz")
    };
    let ours = recorded("ours", &config);
    let before = fs::read(&ours).expect("a recording");
    for (name, other) in ["seed", "starts"].iter().zip(&others) {
        let foreign = fs::read(recorded(name, other)).expect("a recording");
        assert_ne!(foreign, before);
        for bytes in [&foreign[..], &before[..before.len() / 2], b""] {
            fs::write(&ours, bytes).expect("a writable folder");
            recorded_again(&registry, &config, root.path());
            assert!(fs::read(&ours).expect("a recording") == before, "{name}");
        }
    }
    // None is begun once it is to stop.
    fs::remove_file(&ours).expect("a writable folder");
    let run = (config.clone(), root.path().join("ours/run"));
    let stopped = replays::record(&registry, &[run], &root.path().join("ours"), &AtomicBool::new(true));
    assert!(matches!(stopped, Err(Error::Interrupted)) && !ours.exists());

    fn recorded_again(registry: &Registry, config: &RunConfig, root: &Path) {
        let run = (config.clone(), root.join("ours/run"));
        replays::record(registry, &[run], &root.join("ours"), &AtomicBool::new(false)).expect("a writable folder");
    }
}

/// It stands in no table, and no checksum covers it.
#[test]
fn a_damaged_summary_is_named_and_gives_no_recording() {
    use handful::prelude::*;
    use handful::study::config::RunConfig;
    use handful::study::run::{Event, read_summary};
    let registry = Registry::standard();
    let root = tempfile::tempdir().expect("a folder");
    let runs = [0, 1].map(|seed| {
        let config = registry.config("pendulum", "random", seed, None, None).expect("a preset");
        let (config, folder) = (RunConfig { test_episodes: 2, ..config }, root.path().join(format!("seed{seed}")));
        let mut open = registry.open_run(&config, &folder).expect("a run");
        while !matches!(open.step().expect("a healthy run"), Event::Tested(_)) {}
        let file = folder.join("summary.toml");
        let text = fs::read_to_string(&file).expect("a summary");
        let mean = text.lines().find(|line| line.starts_with("return_mean")).expect("a mean");
        fs::write(&file, text.replace(mean, "return_mean = nan")).expect("a writable folder");
        let problem = read_summary(&folder).expect_err("a mean that is no number").to_string();
        assert!(problem.contains("summary.toml") && problem.contains("not finite"), "{problem}");
        (config, folder)
    });
    replays::record(&registry, &runs, root.path(), &AtomicBool::new(false)).expect("a writable folder");
    assert!(!root.path().join("replays/pendulum-random-median.json.gz").exists());
}

/// What the program says about folders that are none, and about what a report is without.
#[cfg(feature = "cli")]
#[test]
fn the_program_says_what_a_report_is_without() {
    use std::process::Command;
    let handful = |folder: &Path, args: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_handful")).current_dir(folder).args(args).output();
        let output = output.expect("the program starts");
        (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let folder = with_recording("replays/pole-random-median.json.gz");
    edit(&folder, "runs.csv", |text| text.replace("seed = 1\n", "seed = 1\nreward = 2\n"));
    let here = folder.path();
    let (made, said) = handful(here, &["report", "--from", "."]);
    assert!(made && said.lines().count() == 2, "{said}");
    assert!(said.contains("left out: .: debug on pole with seed 1 (it has another configuration"), "{said}");
    assert!(said.contains("no replay: cannot read ./replays/pole-random-median.json.gz"), "{said}");
    let (made, said) = handful(here, &["report", "--from", ".", "--from", ".", "--out", "joined"]);
    assert!(made && said.contains("left out: .: debug on pole with seed 0 (it is there twice)"), "{said}");

    fs::create_dir(here.join("run")).expect("a writable folder");
    fs::write(here.join("run/config.toml"), "").expect("a writable folder");
    for (args, expected) in [
        (&["report"][..], ["cannot read runs/quick: there is no such folder", "handful study --out runs/quick"]),
        (&["report", "--from", "a", "--from", "b", "--out", "c"], ["cannot read a: there is no such folder", "--from"]),
        (&["report", "--from", "run"], ["run: this folder holds a run", "handful evaluate --run run"]),
    ] {
        let (made, said) = handful(here, args);
        assert!(!made && said.lines().count() == 1, "{said}");
        assert!(expected.iter().all(|part| said.contains(part)), "{args:?}: {said}");
    }
}

/// A world may have no success, only a return.
#[test]
fn a_task_without_success_is_drawn_by_its_return() {
    for (by_return, what) in [(false, "success rate"), (true, "return")] {
        let folder = study(&ALL, "test");
        edit(&folder, "evaluations.csv", |text| {
            let text = text.replace("episodes,success\n", "episodes,success,return_mean\n");
            text.replace(",20,0.5\n", if by_return { ",20,0,-1.5\n" } else { ",20,0.5,-1.5\n" })
        });
        let text =
            report::write(folder.path(), folder.path()).map(|_| fs::read_to_string(folder.path().join("report.md")));
        let text = text.expect("a report").expect("a file");
        assert_eq!(text.contains("Return (no evaluation succeeds) over environment steps"), by_return);
        let figure = fs::read_to_string(folder.path().join("pole-learning.svg")).expect("a figure");
        assert!(figure.contains(&format!("pole: {what}")), "{figure}");
    }
}
