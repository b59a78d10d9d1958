//! The command line: what it makes, and how it answers bad input.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

fn handful(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_handful")).current_dir(folder).args(args).output().expect("the program starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The command fails with exit code 2 and one or two lines that say all of `expected`.
fn refused(folder: &Path, args: &[&str], expected: &[&str]) {
    let output = handful(folder, args);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args:?} said: {said}");
    assert!(said.lines().count() <= 2, "{args:?} said too much: {said}");
    for part in expected {
        assert!(said.contains(part), "{args:?} did not say `{part}`, but: {said}");
    }
}

/// Only the folders of its runs can restore a study's tables.
#[test]
fn a_study_does_not_replace_the_tables_of_another() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let tables = here.join("kept");
    std::fs::create_dir(&tables).expect("a writable folder");
    let quick = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/study/quick/tests.csv");
    std::fs::copy(&quick, tables.join("tests.csv")).expect("a table");
    let study = |rest: &[&'static str]| [&["study", "--tasks", "pendulum", "--methods", "random"], rest].concat();
    let other = "holds the tables of another study (with `";
    refused(here, &study(&["--out", "kept"]), &["kept", other, "choose another --out"]);
    assert_eq!(std::fs::read_dir(&tables).expect("a folder").count(), 1, "nothing was begun");
    // One that is damaged may be all that there is, or another table may tell whose it is.
    let whole = std::fs::read_to_string(&quick).expect("a table");
    std::fs::write(tables.join("tests.csv"), whole.trim_end()).expect("a writable folder");
    refused(here, &study(&["--out", "kept"]), &["tests.csv"]);
    std::fs::copy(quick.with_file_name("runs.csv"), tables.join("runs.csv")).expect("a table");
    refused(here, &study(&["--out", "kept"]), &["kept", other, "choose another --out"]);

    assert!(handful(here, &study(&["--out", "own"])).status.success());
    let debug = ["study", "--tasks", "pendulum", "--methods", "debug", "--seeds", "1", "--out", "own"];
    let output = handful(here, &debug);
    assert!(output.status.success(), "the folder of the first run is there");
    let left_out = "left out: own/pendulum/random/seed0 (this command did not ask for it";
    assert!(text(&output.stderr).contains(left_out), "{}", text(&output.stderr));
    let weightless = ["export", "--run", "own/pendulum/random/seed0", "--out", "small"];
    refused(here, &weightless, &["own/pendulum/random/seed0", "random learns nothing"]);
    std::fs::remove_dir_all(here.join("own/pendulum/debug")).expect("a folder");
    refused(here, &study(&["--out", "own"]), &["own", other]);
}

/// Whole runs with another task, method or seed, a file, and folders that hold no run: none of them changes a number.
#[test]
fn what_else_lies_among_the_runs_is_left_out_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let read = |file: &str| std::fs::read_to_string(here.join(file)).expect(file);
    // Its report, and what it says.
    let study = |tasks: &str, methods: &str, seeds: &str| {
        let output = ["study", "--tasks", tasks, "--methods", methods, "--seeds", seeds, "--out", "study"];
        let output = handful(here, &output);
        assert!(output.status.success(), "{}", text(&output.stderr));
        (read("study/report.md"), text(&output.stderr))
    };
    let tables =
        || ["evaluations.csv", "tests.csv", "runs.csv", "summary.csv"].map(|file| read(&format!("study/{file}")));
    let (report, _) = study("pendulum", "debug", "1");
    let alone = tables();
    assert!(report.contains("**yes**: everything that was found among the runs is included"), "{report}");
    let (report, _) = study("pendulum,cartpole", "random,debug", "2");
    assert!(report.contains("**yes**: everything that was found among the runs is included"), "{report}");
    assert_ne!(tables(), alone);
    // Tests of other runs where those of a run could be, and what macOS leaves in folders.
    let foreign =
        ["debug/test.csv", "debug/seed7/test.csv", "backup/seed0/test.csv", "../old/test.csv", "debug/.DS_Store"];
    for file in foreign {
        let to = here.join("study/pendulum").join(file);
        std::fs::create_dir_all(to.parent().expect("a folder")).expect("a writable folder");
        std::fs::copy(here.join("study/cartpole/random/seed0/test.csv"), to).expect("a test");
    }
    let (report, said) = study("pendulum", "debug", "1");
    assert_eq!(tables(), alone);
    assert!(report.contains("**no**: everything that was found among the runs is included. Exceptions: `"), "{report}");
    let run = "this command did not ask for it; to include it, name its task, method and seed";
    let no_run = "it is not a run, and was not read";
    let expected = [
        ("cartpole/debug/seed0", run),
        ("cartpole/debug/seed1", run),
        ("cartpole/random/seed0", run),
        ("old", no_run),
        ("pendulum/backup", no_run),
        ("pendulum/debug/seed1", run),
        ("pendulum/debug/seed7", no_run),
        ("pendulum/debug/test.csv", no_run),
        ("pendulum/random/seed0", run),
    ];
    for (other, reason) in expected {
        assert!(report.contains(&format!("`study/{other}` (`{reason}`)")), "no `{other}` in: {report}");
        assert!(said.contains(&format!("left out: study/{other} ({reason})")), "no `{other}` in: {said}");
    }
    assert_eq!(said.matches("left out: ").count(), expected.len(), "{said}");
}

/// Among the methods that nobody asked for.
#[test]
fn what_a_task_does_not_have_is_left_out() {
    let folder = tempfile::tempdir().expect("a folder");
    let output = handful(folder.path(), &["study", "--tasks", "pendulum", "--profile", "full", "--status"]);
    let (said, answered) = (text(&output.stderr), text(&output.stdout));
    assert!(output.status.success(), "{said}");
    assert!(said.contains("without scripted: pendulum has no scripted policy"), "{said}");
    assert!(answered.contains("pendulum oracle") && !answered.contains("scripted"), "{answered}");
}

#[test]
fn whatever_needs_no_training_can_be_watched() {
    let folder = tempfile::tempdir().expect("a folder");
    let watch = |policy: &'static str| ["watch", "--task", "pendulum", "--policy", policy];
    let output = handful(folder.path(), &watch("oracle"));
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(folder.path().join("pendulum-oracle.html").exists());
    refused(folder.path(), &watch("sac"), &["unknown policy `sac`; known: random, scripted, oracle"]);
    refused(folder.path(), &watch("scripted"), &["pendulum has no scripted policy"]);
    refused(folder.path(), &["watch", "--task", "pendulun", "--policy", "oracle"], &["unknown task `pendulun`"]);
}

#[test]
fn bad_input_is_refused_in_one_line() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let train = |rest: &[&str]| -> Vec<String> {
        ["train", "--task", "reach", "--method", "debug"].iter().chain(rest).map(ToString::to_string).collect()
    };
    let check = |args: Vec<String>, expected: &[&str]| {
        refused(here, &args.iter().map(String::as_str).collect::<Vec<_>>(), expected);
    };
    refused(here, &["train", "--task", "raech", "--method", "sac"], &["unknown task `raech`", "`reach`"]);
    refused(here, &["train", "--task", "reach", "--method", "sca"], &["unknown method `sca`", "`sac`"]);
    refused(here, &["study", "--tasks", "lfit"], &["unknown task `lfit`", "`lift`"]);
    refused(here, &["study", "--methods", "random,petz"], &["unknown method `petz`"]);
    refused(here, &["study", "--tasks", "pendulum,pendulum"], &["the task `pendulum` is named twice"]);
    refused(here, &["study", "--methods", "random,debug,debug"], &["the method `debug` is named twice"]);
    refused(here, &["study", "--seeds", "1000000"], &["at most 100000", "fewer seeds"]);
    refused(here, &["study", "--seeds", "0..1000000000"], &["`seed` is 999999999", "it must lie in 0..1048576"]);
    refused(here, &["study", "--seeds", "3..3"], &["no seeds", "3..3"]);
    refused(here, &["study", "--seeds", "0"], &["no seeds"]);
    refused(here, &["study", "--seeds", "few"], &["'few'", "--seeds", "a number of seeds"]);
    refused(here, &["study", "--jobs", "0"], &["--jobs", "at least 1"]);
    refused(here, &["study", "--jobs", "-1"], &["'-1'", "--jobs", "a whole number"]);
    refused(here, &["study", "--tasks", "pendulum", "--methods", "scripted"], &["pendulum has no scripted policy"]);
    let beyond = ["it must lie in 0..1048576"];
    check(train(&["--steps", "-5"]), &["'-5'", "--steps", "a whole number"]);
    check(train(&["--steps", "0"]), &["`steps` is 0, but debug learns"]);
    check(train(&["--steps", "1e3"]), &["'1e3'", "--steps", "a whole number"]);
    check(train(&["--seed", "-1"]), &["'-1'", "--seed", "a whole number"]);
    check(train(&["--seed", "99999999999999999999"]), &["--seed", "too large"]);
    refused(here, &["study", "--seeds", "-1"], &["'-1'", "--seeds", "a number of seeds"]);
    refused(here, &["evaluate", "--run", "run", "--episodes", "-1"], &["'-1'", "--episodes", "a whole number"]);
    check(train(&["--seed", "2097152"]), &["`seed` is 2097152", beyond[0]]);
    check(train(&["--seed", "18446744073709551615"]), &["`seed` is 18446744073709551615", beyond[0]]);
    check(train(&["--steps", "9223372036854775808"]), &["`steps` is 9223372036854775808", "it must lie in 0.."]);
    refused(here, &["study", "--seeds", "1048570..1048580"], &["`seed` is 1048579", beyond[0]]);
    check(train(&["--starts", "elsewhere"]), &["--starts", "unknown starts `elsewhere`", "development"]);
    refused(here, &["watch", "--task", "reach", "--policy", "scriptd"], &["unknown policy `scriptd`", "`scripted`"]);
    refused(here, &["evaluate", "--run", "nowhere"], &["cannot read", "nowhere"]);
    refused(here, &["report", "--from", "nowhere"], &["cannot read", "nowhere"]);

    std::fs::write(here.join("typo.toml"), "[sac]\nlearning_rat = 1e-3\n").expect("a writable folder");
    check(train(&["--config", "typo.toml"]), &["typo.toml", "unknown field `learning_rat`", "`learning_rate`"]);
    std::fs::write(here.join("kind.toml"), "[sac]\nbatch = \"many\"\n").expect("a writable folder");
    check(train(&["--config", "kind.toml"]), &["kind.toml", "many"]);
    std::fs::write(here.join("zero.toml"), "[sac]\nbatch = 0\n").expect("a writable folder");
    check(train(&["--config", "zero.toml"]), &["`sac.batch` is 0", "1..=65536"]);
    std::fs::write(here.join("other.toml"), "[pets]\nwarm_up = 5\n").expect("a writable folder");
    check(train(&["--config", "other.toml"]), &["other.toml", "[pets] is for another kind of agent", "[sac]"]);
    std::fs::write(here.join("broken.toml"), "[sac\n").expect("a writable folder");
    check(train(&["--config", "broken.toml"]), &["broken.toml"]);
    check(train(&["--config", "missing.toml"]), &["cannot read missing.toml"]);
    // A folder that cannot be, because a file stands in its way.
    check(train(&["--out", "typo.toml/run"]), &["cannot", "typo.toml"]);
    assert!(!here.join("runs").exists(), "nothing was made");
    assert_eq!(std::fs::read_to_string(here.join("typo.toml")).expect("still there"), "[sac]\nlearning_rat = 1e-3\n");
}

#[test]
fn a_small_study_from_start_to_report() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let study = ["study", "--tasks", "reach", "--methods", "random,scripted,debug", "--seeds", "2", "--out", "study"];
    let status = || text(&handful(here, &[&study[..], &["--status"]].concat()).stdout);
    let line = |report: &str, name: &str| -> Vec<String> {
        let line = report.lines().find_map(|line| line.strip_prefix(name)).unwrap_or_else(|| panic!("{report}"));
        line.split_whitespace().take(5).map(String::from).collect()
    };
    assert_eq!(line(&status(), "reach debug"), ["0", "0", "0", "2", "0"]);
    assert!(!here.join("study").exists(), "to look at a study begins nothing");
    let output = handful(here, &study);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert_eq!(line(&status(), "reach debug"), ["2", "0", "0", "0", "100"]);
    assert_eq!(line(&status(), "reach scripted"), ["1", "0", "0", "0", "-"]);
    let table = text(&output.stdout);
    assert!(table.contains("scripted") && table.contains("100 % ["), "{table}");
    for file in ["evaluations.csv", "tests.csv", "summary.csv", "report.md", "reach-learning.svg", "reach-test.svg"] {
        assert!(here.join("study").join(file).metadata().expect(file).len() > 100, "{file}");
    }
    for file in [
        "config.toml",
        "episodes.csv",
        "evaluations.csv",
        "losses.csv",
        "test.csv",
        "summary.toml",
        "weights.safetensors",
    ] {
        assert!(here.join("study/reach/debug/seed1").join(file).exists(), "{file}");
    }
    // Two episodes of each method can be replayed in the report, with the returns that they had in the test.
    let read = |file: &str| std::fs::read_to_string(here.join("study").join(file)).expect(file);
    let (tests, replays, page) = (read("tests.csv"), read("replays.csv"), read("report.html"));
    assert_eq!(page.matches("class=\"replay\" value=\"replays/reach-").count(), 6);
    for row in replays.lines().skip(1) {
        let [task, method, seed, _, episode, total, success, file] = row.split(',').collect::<Vec<_>>()[..] else {
            panic!("{row}")
        };
        let tested = format!("\n{task},{method},{seed},{episode},{total},{success},");
        assert!(tests.contains(&tested), "{tested} is not in\n{tests}");
        assert!(page.contains(&format!("id=\"{}\"", file.trim_end_matches(".json.gz"))), "{file}");
    }
    let head = std::fs::read_to_string(here.join("study/reach/debug/seed0/evaluations.csv")).expect("evaluations");
    assert_eq!(
        head.lines().next(),
        Some("step,episodes,success,return_mean,return_std,smoothness_sparc,smoothness_ldlj,action_ms,updates")
    );

    // A second time, nothing is run again, and the table is the same.
    let again = handful(here, &study);
    assert!(again.status.success(), "{}", text(&again.stderr));
    assert_eq!(text(&again.stdout), table);
    assert!(!text(&again.stderr).contains("started"), "{}", text(&again.stderr));

    // Runs that help to choose settings say so, and are not compared with others.
    let tuning = ["study", "--tasks", "reach", "--methods", "debug", "--seeds", "1", "--starts", "development"];
    let output = handful(here, &[&tuning[..], &["--out", "tuning"]].concat());
    assert!(text(&output.stdout).starts_with("Tuning runs"), "{}", text(&output.stderr));
    let report = std::fs::read_to_string(here.join("tuning/report.md")).expect("a report");
    assert!(report.contains("development starts"), "{report}");
    let folders = ["study/reach/debug/seed0", "tuning/reach/debug/seed0"].map(|run| here.join(run));
    let mixed = handful::study::tables::Tables::gather(folders.iter().map(std::path::PathBuf::as_path));
    assert!(mixed.expect_err("two kinds of runs").to_string().contains("compare them separately"));

    // A run and a study have tables of the same names, so neither is written over the other.
    let table = |folder: &str| std::fs::read_to_string(here.join(folder).join("evaluations.csv")).expect("a table");
    let (of_study, of_run) = (table("study"), table("study/reach/debug/seed0"));
    let train = ["train", "--task", "reach", "--method", "debug", "--steps", "200", "--out", "study"];
    refused(here, &train, &["study", "holds a study", "another --out"]);
    let study = ["study", "--tasks", "reach", "--methods", "random", "--out", "study/reach/debug/seed0"];
    refused(here, &study, &["study/reach/debug/seed0", "holds a run", "another --out"]);
    assert_eq!((of_study, of_run), (table("study"), table("study/reach/debug/seed0")));

    // The report is made from the tables alone.
    std::fs::remove_dir_all(here.join("study/reach")).expect("runs to remove");
    let report = handful(here, &["report", "--from", "study", "--out", "elsewhere"]);
    assert!(report.status.success(), "{}", text(&report.stderr));
    for file in ["summary.csv", "report.md", "report.html"] {
        let [first, second] =
            ["study", "elsewhere"].map(|folder| std::fs::read_to_string(here.join(folder).join(file)).expect(file));
        assert_eq!(first, second);
    }
}

/// Runs of several machines, or of several days, make one study.
#[test]
fn studies_are_joined() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let study = |methods: &str, seeds: &str, out: &str| {
        let output = ["study", "--tasks", "cartpole", "--methods", methods, "--seeds", seeds, "--out", out];
        let output = handful(here, &output);
        assert!(output.status.success(), "{}", text(&output.stderr));
    };
    study("random,debug", "0..2", "whole");
    study("random,debug", "0..1", "first");
    study("debug", "1..2", "second");
    let join = |studies: &[&str], out: &str| {
        let from = studies.iter().flat_map(|study| ["--from", study]);
        handful(here, &["report"].into_iter().chain(from).chain(["--out", out]).collect::<Vec<_>>())
    };
    let joined = join(&["first", "second"], "joined");
    assert!(joined.status.success(), "{}", text(&joined.stderr));
    let read = |file: &str| std::fs::read_to_string(here.join(file)).expect(file);
    // White space around a cell is not read.
    let table = |file: &str| read(file).replace("\n\"", "\"");
    for file in ["tests.csv", "runs.csv", "models.csv", "values.csv"] {
        assert_eq!(table(&format!("joined/{file}")), table(&format!("whole/{file}")), "{file}");
    }
    // The methods' numbers of steps and successes; later columns hold seconds.
    let of_summary = |study: &str| -> Vec<String> {
        let columns = |line: &str| line.split(',').take(10).collect::<Vec<_>>().join(",");
        read(&format!("{study}/summary.csv")).lines().map(columns).collect()
    };
    assert_eq!(of_summary("joined"), of_summary("whole"));
    // The median seed of debug is not known; that of random is.
    assert!(read("joined/replays.csv").contains("random") && !read("joined/replays.csv").contains("debug"));

    // A run that is there twice counts once, and the report names it.
    assert!(join(&["first", "whole"], "twice").status.success());
    assert_eq!(read("twice/tests.csv"), read("whole/tests.csv"));
    assert!(read("twice/report.md").contains("whole: debug on cartpole with seed 0` (`it is there twice`)"));

    // So does one of several kinds: the first.
    let other = read("second/runs.csv").replace("evaluate_every = ", "evaluate_every = 7");
    std::fs::write(here.join("second/runs.csv"), other).expect("a writable table");
    assert!(join(&["first", "second"], "mixed").status.success());
    assert!(read("mixed/left_out.csv").contains("another configuration than with seed 0 (its `evaluate_every` is "));

    refused(here, &["report", "--from", "first", "--from", "second"], &["several studies", "--out"]);
    refused(here, &["report", "--from", "first", "--from", "whole", "--out", "whole"], &["whole", "joined", "--out"]);
}

#[test]
fn train_evaluate_and_watch() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let output = handful(here, &["train", "--task", "push", "--method", "debug", "--steps", "300", "--out", "run"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(!text(&output.stderr).contains("learns nothing"), "{}", text(&output.stderr));
    let output = handful(here, &["train", "--task", "pendulum", "--method", "debug", "--steps", "1", "--out", "short"]);
    assert!(
        text(&output.stderr).contains("debug on pendulum learns nothing: `sac.warm_up` is"),
        "{}",
        text(&output.stderr)
    );
    let output = handful(here, &["evaluate", "--run", "run", "--episodes", "3", "--seed", "1", "--json"]);
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(summary["episodes"], 3);
    assert!(summary["return_mean"].is_number() && summary["smoothness_sparc"].is_number(), "{summary}");
    refused(here, &["evaluate", "--run", "run", "--episodes", "0"], &["at least one episode"]);
    refused(
        here,
        &["evaluate", "--run", "run", "--seed", "17592186044415"],
        &["`seed` is 17592186044415", "0..1048576"],
    );
    refused(here, &["evaluate", "--run", "run", "--episodes", "1048577"], &["`episode` is 1048576", "0..1048576"]);
    let both = handful(here, &["evaluate", "--run", "run", "--seed", "1", "--starts", "test"]);
    assert_eq!(both.status.code(), Some(2), "one or the other: {}", text(&both.stderr));
    let returns = [["--starts", "test"], ["--starts", "development"], ["--seed", "0"]].map(|starts| {
        let output = handful(here, &[&["evaluate", "--run", "run", "--episodes", "3", "--json"][..], &starts].concat());
        let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        summary["return_mean"].as_f64().expect("a number")
    });
    assert!(returns[0] != returns[1] && returns[1] != returns[2] && returns[0] != returns[2], "{returns:?}");

    // Other settings for the same weights, if these have the sizes that the settings ask for.
    std::fs::write(here.join("slower.toml"), "[for.push.sac]\naction_repeat = 4\n").expect("a writable folder");
    std::fs::write(here.join("wider.toml"), "[sac]\nhidden = [32, 64]\n").expect("a writable folder");
    std::fs::write(here.join("wrong.toml"), "[sac]\naction_repeats = 4\n").expect("a writable folder");
    let changed = |file| ["evaluate", "--run", "run", "--episodes", "3", "--seed", "0", "--json", "--config", file];
    let output = handful(here, &changed("slower.toml"));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert!(summary["return_mean"].as_f64().is_some_and(|with_repeats| with_repeats != returns[2]), "{summary}");
    // What the run has learned acts, also if the file says that it is not to learn.
    std::fs::write(here.join("steps.toml"), "steps = 0\n").expect("a writable folder");
    let output = handful(here, &changed("steps.toml"));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(summary["return_mean"].as_f64(), Some(returns[2]), "{summary}");
    std::fs::write(here.join("other.toml"), "[sac]\nlatent_features = true\n").expect("a writable folder");
    refused(
        here,
        &changed("other.toml"),
        &["other.toml", "belongs to the run's weights", "its `sac.latent_features` is"],
    );
    refused(here, &changed("wider.toml"), &["weights.safetensors", "has the sizes", "are expected"]);
    refused(here, &changed("wrong.toml"), &["wrong.toml", "action_repeats"]);

    // What was exported acts as the run does, but for rounding; the run itself stays as it is.
    let size = |run: &str| std::fs::metadata(here.join(run).join("weights.safetensors")).expect("weights").len();
    let before = size("run");
    for _ in 0..2 {
        let output = handful(here, &["export", "--run", "run", "--out", "small"]);
        assert!(output.status.success(), "{}", text(&output.stderr));
    }
    assert!(10 * size("small") < 6 * before && size("run") == before, "{} of {before} bytes", size("small"));
    let output = handful(here, &["evaluate", "--run", "small", "--episodes", "3", "--seed", "0", "--json"]);
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let exported = summary["return_mean"].as_f64().expect("a number");
    assert!((exported - returns[2]).abs() < 0.1 * returns[2].abs(), "{exported} and {}", returns[2]);
    for run in ["run", "small"] {
        refused(here, &["export", "--run", run, "--out", run], &[run, "the run itself; choose another --out"]);
    }
    refused(here, &["export", "--run", "short", "--out", "small"], &["small", "another run (its `"]);
    // Neither weights in full precision nor anything else is replaced.
    for (file, text) in [("copy/weights.safetensors", None), ("copied/weights.safetensors", Some("precious"))] {
        std::fs::create_dir(here.join(file).parent().expect("a folder")).expect("a writable folder");
        match text {
            Some(text) => std::fs::write(here.join(file), text).expect("a writable folder"),
            None => _ = std::fs::copy(here.join("run/weights.safetensors"), here.join(file)).expect("weights"),
        }
        let out = file.split('/').next().expect("a folder");
        refused(here, &["export", "--run", "run", "--out", out], &[file, "that were not exported"]);
    }
    refused(here, &["watch", "--run", "run", "--out", "copied/weights.safetensors"], &["not a replay"]);
    assert_eq!(std::fs::read(here.join("copied/weights.safetensors")).expect("the file"), b"precious");
    // A run that has not ended says so.
    std::fs::rename(here.join("run/summary.toml"), here.join("summary.toml")).expect("a summary");
    let output = handful(here, &["export", "--run", "run", "--out", "small"]);
    assert!(output.status.success() && text(&output.stderr).contains("has not ended"), "{}", text(&output.stderr));
    std::fs::rename(here.join("summary.toml"), here.join("run/summary.toml")).expect("a summary");
    refused(here, &["export", "--run", "nowhere", "--out", "small"], &["nowhere", "there is no run"]);

    let output = handful(here, &["watch", "--run", "run", "--seed", "2"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    let page = std::fs::read_to_string(here.join("run/watch.html")).expect("a page");
    assert!(page.contains("push, debug, seed 2") && !page.contains("{{"));
    let json = page.split_once("id=\"recording\">").and_then(|(_, rest)| rest.split_once("</script>"));
    let recording: serde_json::Value = serde_json::from_str(json.expect("a recording").0).expect("JSON");
    let (bodies, frames) =
        (recording["bodies"].as_array().expect("bodies"), recording["frames"].as_array().expect("frames"));
    assert_eq!(frames.len(), 151);
    assert!(frames.iter().all(|frame| frame["poses"].as_array().is_some_and(|poses| poses.len() == bodies.len())));

    // Other random numbers make another run.
    let shaken = Command::new(env!("CARGO_BIN_EXE_handful"))
        .current_dir(here)
        .args(["train", "--task", "push", "--method", "debug", "--steps", "300", "--out", "run"])
        .env(handful::rng::SHAKE, "65535")
        .output()
        .expect("the program starts");
    let said = text(&shaken.stderr);
    assert!(shaken.status.code() == Some(2) && said.contains("another run (its `shake` is"), "{said}");

    // Weights that are not ours: the checkpoint has them, too.
    std::fs::write(here.join("run/weights.safetensors"), b"something else").expect("a writable folder");
    refused(
        here,
        &["evaluate", "--run", "run"],
        &["weights.safetensors", "the command that made the run writes it anew"],
    );
    std::fs::remove_dir_all(here.join("run/checkpoint")).expect("a checkpoint");
    refused(here, &["evaluate", "--run", "run"], &["weights.safetensors", "damaged", "restore it"]);
}

/// The program ends as if all had been read, or says in one line what could not be written.
#[cfg(unix)]
#[test]
fn nobody_has_to_listen() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let shell = |command: &str| {
        let command = command.replace("handful", env!("CARGO_BIN_EXE_handful"));
        Command::new("sh").current_dir(here).args(["-c", &command]).output().expect("a shell")
    };
    let train = "handful train --task pendulum --method debug --out";
    for (run, rest) in [("pipe", "2>&1 | true"), ("closed", ">&- 2>&-"), ("full", "2>/dev/full")] {
        let output = shell(&format!("{train} {run} {rest}"));
        let said = text(&output.stderr);
        assert!(output.status.success() && said.is_empty(), "{rest}: {said}");
        assert!(here.join(run).join("summary.toml").exists(), "{rest}: the run is complete");
    }
    let output = shell("handful watch --task pendulum --policy random --out /dev/stdout | head -c 9");
    let said = text(&output.stdout);
    assert!(said.to_lowercase().starts_with("<!doctype"), "{said}: {}", text(&output.stderr));
    let output = shell("HANDFUL_SHAKE=-1 handful evaluate --run pipe --episodes 1");
    let said = text(&output.stderr);
    assert!(output.status.code() == Some(2) && said.lines().count() == 1, "{said}");
    assert!(said.contains("HANDFUL_SHAKE is \"-1\"; it must be a whole number"), "{said}");
    let output = shell("handful evaluate --run pipe --episodes 1 >/dev/full");
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("cannot write to standard output") && said.lines().count() == 1, "{said}");
}

/// Hears SIGHUP, also if the tests run under `nohup`, which has it ignored.
#[cfg(unix)]
fn program_with_a_terminal() -> Command {
    use std::os::unix::process::CommandExt;
    let mut program = Command::new(env!("CARGO_BIN_EXE_handful"));
    // SAFETY: `signal` may be called between fork and exec.
    unsafe {
        program.pre_exec(|| {
            libc::signal(libc::SIGHUP, libc::SIG_DFL);
            Ok(())
        })
    };
    program
}

/// There is nothing to save.
#[cfg(unix)]
#[test]
fn signals_end_an_evaluation() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let output = handful(here, &["train", "--task", "pendulum", "--method", "debug", "--out", "run"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    for signal in ["-INT", "-TERM", "-HUP"] {
        let mut child = program_with_a_terminal()
            .current_dir(here)
            .args(["evaluate", "--run", "run", "--episodes", "1000000"])
            .spawn()
            .expect("the program starts");
        let began = Instant::now();
        // More than once, since on a busy machine the first may come before the program listens.
        let status = loop {
            std::thread::sleep(Duration::from_millis(300));
            if let Some(status) = child.try_wait().expect("a process") {
                break status;
            }
            assert!(began.elapsed() < Duration::from_secs(30), "{signal} is not heard");
            let kill = Command::new("kill").args([signal, &child.id().to_string()]).status();
            assert!(kill.expect("kill").success());
        };
        assert!(!status.success(), "{signal}");
    }
}

#[cfg(unix)]
#[test]
fn signals_leave_a_run_that_resumes() {
    let folder = tempfile::tempdir().expect("a folder");
    let here = folder.path();
    let train = ["train", "--task", "reach", "--method", "debug", "--steps", "200000", "--out", "run"];
    let start = || {
        program_with_a_terminal()
            .current_dir(here)
            .args(train)
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .expect("the program starts")
    };
    let mut done = 0;
    // Ctrl-C, what a system sends before it kills, and the end of a terminal.
    for signal in ["-INT", "-TERM", "-HUP"] {
        let child = start();
        std::thread::sleep(Duration::from_secs(2));
        // Twice at once, as GNU `timeout` does, which signals the process and its group.
        for _ in 0..2 {
            let kill = Command::new("kill").args([signal, &child.id().to_string()]).status().expect("kill");
            assert!(kill.success());
        }
        let output = child.wait_with_output().expect("the program ends");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(130), "{signal}: {said}");
        assert!(said.contains("the same command resumes it"), "{signal}: {said}");
        let episodes = std::fs::read_to_string(here.join("run/episodes.csv")).expect("episodes");
        let before = std::mem::replace(&mut done, episodes.lines().count() - 1);
        assert!(done > before, "{signal}: {said}");
    }

    // Going on for a moment is enough to see that it starts from there.
    let mut child = start();
    std::thread::sleep(Duration::from_secs(2));
    child.kill().expect("it still runs");
    let said = text(&child.wait_with_output().expect("the program ends").stderr);
    assert!(said.contains(&format!("going on after {} steps", 100 * done)), "{said}");
}

/// `nohup handful train ... &` outlives its terminal.
#[cfg(unix)]
#[test]
fn an_ignored_hang_up_stays_ignored() {
    let folder = tempfile::tempdir().expect("a folder");
    let program = env!("CARGO_BIN_EXE_handful");
    let train = "train --task reach --method debug --steps 200000 --out run";
    let mut child = Command::new("sh")
        .current_dir(folder.path())
        .args(["-c", &format!("trap '' HUP; exec {program} {train}")])
        .stderr(Stdio::piped())
        .spawn()
        .expect("a shell");
    let send = |signal: &str| {
        let kill = Command::new("kill").args([signal, &child.id().to_string()]).status().expect("kill");
        assert!(kill.success(), "it has ended before {signal}");
        std::thread::sleep(Duration::from_secs(2));
    };
    std::thread::sleep(Duration::from_secs(2));
    send("-HUP");
    send("-TERM");
    assert_eq!(child.wait().expect("the program ends").code(), Some(130));
    let mut said = String::new();
    std::io::Read::read_to_string(&mut child.stderr.take().expect("a pipe"), &mut said).expect("text");
    assert_eq!(said.matches("finishing the episodes").count(), 1, "{said}");
}

/// Numbers of threads that a library would panic at, ignore, or spend minutes on.
#[test]
fn numbers_of_threads_are_checked() {
    for (name, value) in [("POLARS_MAX_THREADS", "0"), ("RAYON_NUM_THREADS", "70000"), ("RAYON_NUM_THREADS", "two")] {
        let mut program = Command::new(env!("CARGO_BIN_EXE_handful"));
        let output =
            program.args(["report", "--from", "nowhere"]).env(name, value).output().expect("the program starts");
        let said = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains(&format!("{name} is `{value}`; it must be")), "{said}");
    }
}
