//! The census of claims: every test under many shakes of its random streams, and how often each held.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

/// The page that holds the table, between two comments.
const PAGE: &str = "chapters/notes/census.md";
const BEGIN: &str = "<!-- census: written by `cargo book census` -->";
const END: &str = "<!-- end of the census -->";

/// A test program that cargo has built.
struct Program {
    /// Its source, relative to the repository.
    source: String,
    file: PathBuf,
    /// Where cargo runs it.
    folder: PathBuf,
}

impl Program {
    /// Whether each of its tests has a row of its own.
    fn has_rows_for_tests(&self) -> bool {
        self.source.contains("tests/")
    }
}

/// A program, or some of its tests, under a shake.
struct Job<'a> {
    program: &'a Program,
    shake: u16,
    /// Only tests whose name contains one of these, or all.
    names: Vec<String>,
}

impl<'a> Job<'a> {
    /// What of a program is asked for: all of it if its source or nothing is named, else the tests of that name. Unit tests are
    /// counted together, so they are run together.
    fn new(program: &'a Program, shake: u16, names: &[String]) -> Option<Self> {
        let whole = names.is_empty() || names.iter().any(|name| program.source.contains(name));
        let names = if whole { Vec::new() } else { names.to_vec() };
        (whole || program.has_rows_for_tests()).then_some(Self { program, shake, names })
    }
}

/// How a test fared over the shakes: which of them broke it, and where.
#[derive(Default)]
struct Record {
    shakes: usize,
    failures: BTreeMap<u16, String>,
}

type Records = BTreeMap<(String, String), Record>;

/// Runs every test under the shakes `1..=shakes` and writes the table. (One kind of kernels is enough: all compute the same bits, as
/// `.ci/run` checks.) What was run before with the same programs is not run again. A failure ends the command with an error, after
/// the table is written.
///
/// If there are `names`, only the programs and tests whose name contains one of them are run, and the other rows stay.
pub fn take(root: &Path, shakes: u16, names: &[String]) -> Result<()> {
    let began = Instant::now();
    let commit = commit(root)?;
    let programs = build(root)?;
    let jobs: Vec<Job> = (1..=shakes)
        .flat_map(|shake| programs.iter().filter_map(move |program| Job::new(program, shake, names)))
        .collect();
    let mut records = Records::new();
    for (job, output) in jobs.iter().zip(outputs(root, &jobs)) {
        count(&mut records, &job.program.source, job.shake, &output?)?;
    }
    let path = root.join(PAGE);
    let page = fs::read_to_string(&path).context(PAGE)?;
    let (before, rest) = page.split_once(BEGIN).with_context(|| format!("{PAGE} lacks `{BEGIN}`"))?;
    let (table, after) = rest.split_once(END).with_context(|| format!("{PAGE} lacks `{END}`"))?;
    let mut rows = if names.is_empty() { BTreeMap::new() } else { rows_of(table) };
    rows.append(&mut rows_of_census(&records, &commit));
    let mut table = String::from("| test | passed | commit |\n| --- | --- | --- |\n");
    rows.iter().for_each(|(label, cells)| table.push_str(&format!("| {label} | {cells} |\n")));
    fs::write(&path, format!("{before}{BEGIN}\n\n{table}\n{END}{after}"))?;
    println!("{PAGE} written; {:.0} minutes", began.elapsed().as_secs_f64() / 60.0);
    let failed = failures(&records);
    ensure!(failed.is_empty(), "not every claim holds:\n{}", failed.join("\n"));
    Ok(())
}

/// Builds all tests but those of the documentation.
fn build(root: &Path) -> Result<Vec<Program>> {
    let output = Command::new("cargo")
        .args(["test", "--locked", "--no-run", "--lib", "--bins", "--tests", "--message-format=json"])
        .current_dir(root)
        .stderr(std::process::Stdio::inherit())
        .output()
        .context("cargo could not be started")?;
    ensure!(output.status.success(), "the tests cannot be built");
    let mut programs = Vec::new();
    for line in String::from_utf8(output.stdout)?.lines() {
        let message: Value = serde_json::from_str(line)?;
        if message["profile"]["test"] != true {
            continue;
        }
        let (Some(file), Some(source)) = (message["executable"].as_str(), message["target"]["src_path"].as_str())
        else {
            continue;
        };
        let manifest = Path::new(message["manifest_path"].as_str().context("a manifest")?);
        let source = Path::new(source).strip_prefix(root).unwrap_or(Path::new(source)).display().to_string();
        programs.push(Program { source, file: file.into(), folder: manifest.parent().context("a folder")?.into() });
    }
    programs.sort_by(|a, b| a.source.cmp(&b.source));
    Ok(programs)
}

/// What each program prints under each shake: as many at once as the machine has cores, each on one thread.
fn outputs(root: &Path, jobs: &[Job]) -> Vec<Result<String>> {
    let next = AtomicUsize::new(0);
    let outputs: Vec<OnceLock<Result<String>>> = jobs.iter().map(|_| OnceLock::new()).collect();
    thread::scope(|scope| {
        for _ in 0..thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some(job) = jobs.get(index) else { break };
                    let _ = outputs[index].set(output(root, job));
                }
            });
        }
    });
    outputs.into_iter().map(|output| output.into_inner().expect("every job was done")).collect()
}

/// What a program prints under a shake; from the last census, if it has not changed since.
fn output(root: &Path, Job { program, shake, names }: &Job) -> Result<String> {
    let mut hash = DefaultHasher::new();
    (fs::read(&program.file)?, names).hash(&mut hash);
    let kept = root.join(format!("target/census/{:016x}-{shake}.txt", hash.finish()));
    if let Ok(output) = fs::read_to_string(&kept) {
        return Ok(output);
    }
    let began = Instant::now();
    let output = Command::new(&program.file)
        .arg("--test-threads=1")
        .args(names)
        .env("HANDFUL_SHAKE", shake.to_string())
        .env("RAYON_NUM_THREADS", "1")
        .env("RUST_BACKTRACE", "0")
        .current_dir(&program.folder)
        .output()
        .with_context(|| program.file.display().to_string())?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    println!("{} under shake {shake}: {}, {:.0} s", program.source, output.status, began.elapsed().as_secs_f64());
    fs::create_dir_all(root.join("target/census"))?;
    fs::write(&kept, &text)?;
    Ok(text)
}

/// Adds the results in the output of a test program to the records.
fn count(records: &mut Records, source: &str, shake: u16, output: &str) -> Result<()> {
    if !output.contains("\ntest result: ") {
        bail!("{source} broke off under shake {shake}:\n{output}");
    }
    for line in output.lines() {
        let Some((test, outcome)) = line.strip_prefix("test ").and_then(|line| line.split_once(" ... ")) else {
            continue;
        };
        let record = records.entry((source.into(), test.into())).or_default();
        record.shakes += usize::from(outcome != "ignored");
        if outcome == "FAILED" {
            record.failures.insert(shake, reason(output, test));
        }
    }
    Ok(())
}

/// Where a test failed, and with which message.
fn reason(output: &str, test: &str) -> String {
    let details = output.split_once(&format!("---- {test} stdout ----\n")).map_or("", |(_, details)| details);
    let details = details.split("\n---- ").next().unwrap_or_default();
    let mut lines = details.lines().skip_while(|line| !line.contains("panicked at "));
    let place = lines.next().and_then(|line| line.split("panicked at ").nth(1)).unwrap_or("an unknown place:");
    let place = place.rsplit('/').next().unwrap_or(place);
    format!("{place} {}", lines.next().unwrap_or_default())
}

fn failures(records: &Records) -> Vec<String> {
    let of_test = |((source, test), record): (&(String, String), &Record)| -> Vec<String> {
        let line = |(shake, why): (&u16, &String)| format!("HANDFUL_SHAKE={shake}: {source}, {test}: {why}");
        record.failures.iter().map(line).collect()
    };
    records.iter().flat_map(of_test).collect()
}

/// The version that is counted, as `git` abbreviates it; with a mark if it has changes that are not committed.
fn commit(root: &Path) -> Result<String> {
    let output = Command::new("git").args(["describe", "--always", "--dirty=*"]).current_dir(root).output();
    let output = output.context("git could not be started")?;
    ensure!(output.status.success(), "git does not know the version of {}", root.display());
    Ok(String::from_utf8(output.stdout)?.trim().into())
}

/// The rows of a table that was written before: label and other cells.
fn rows_of(table: &str) -> BTreeMap<String, String> {
    let cells = |line: &str| {
        let (label, cells) = line.strip_prefix("| ")?.strip_suffix(" |")?.split_once(" | ")?;
        Some((label.to_string(), cells.to_string()))
    };
    table.lines().filter_map(cells).filter(|(label, _)| label.contains(": ")).collect()
}

/// One row for each test of `tests/` and each chapter, one for all unit tests of a program.
fn rows_of_census(records: &Records, commit: &str) -> BTreeMap<String, String> {
    let mut rows = BTreeMap::<String, (usize, BTreeSet<u16>)>::new();
    for ((program, name), record) in records {
        let label =
            if program.contains("tests/") { format!("{program}: `{name}`") } else { format!("{program}: unit tests") };
        let (all, failed) = rows.entry(label).or_default();
        *all = record.shakes.max(*all);
        failed.extend(record.failures.keys());
    }
    let cells = |(all, failed): (usize, BTreeSet<u16>)| format!("{} of {all} | {commit}", all - failed.len());
    rows.into_iter().map(|(label, row)| (label, cells(row))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A program that fails one of its tests under one of two shakes.
    #[test]
    fn failures_are_counted_and_located() {
        let good = "\nrunning 2 tests\ntest learns ... ok\ntest plans ... ok\n\ntest result: ok. 2 passed\n";
        let bad = "\nrunning 2 tests\ntest learns ... FAILED\ntest plans ... ok\n\nfailures:\n\n---- learns stdout ----\n\n\
                   thread 'learns' (1) panicked at tests/learning.rs:98:5:\nmean return -300\nnote: run with\n\n\
                   failures:\n    learns\n\ntest result: FAILED. 1 passed; 1 failed\n";
        let mut records = Records::new();
        count(&mut records, "tests/learning.rs", 1, good).expect("a whole output");
        count(&mut records, "tests/learning.rs", 2, bad).expect("a whole output");
        assert_eq!(
            failures(&records),
            ["HANDFUL_SHAKE=2: tests/learning.rs, learns: learning.rs:98:5: mean return -300"]
        );
        let rows = rows_of_census(&records, "abc");
        let expected = [("learns", "1 of 2 | abc"), ("plans", "2 of 2 | abc")];
        assert_eq!(rows, expected.map(|(test, cells)| (format!("tests/learning.rs: `{test}`"), cells.into())).into());
        let table =
            "\n| test | passed | commit |\n| --- | --- | --- |\n| tests/learning.rs: `plans` | 2 of 2 | abc |\n";
        assert_eq!(rows_of(table), [("tests/learning.rs: `plans`".into(), "2 of 2 | abc".into())].into());
        assert!(count(&mut Records::new(), "tests/learning.rs", 3, "\ntest learns ... ok\n").is_err(), "it broke off");
    }
}
