#![cfg(feature = "study")]
//! Reports on damaged tables.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::Duration;

use handful::error::{Error, Result};
use handful::study::report;
use proptest::prelude::*;
use proptest::sample::{Index, select};
use proptest::test_runner::RngSeed;

/// A report on these tables takes a tenth of a second, on a busy machine a few.
const LIMIT: Duration = Duration::from_secs(30);

const TABLES: [&str; 4] = ["evaluations.csv", "models.csv", "values.csv", "tests.csv"];

/// Numbers, words and names that were not expected in a cell.
const CELLS: [&str; 32] = [
    "",
    "0",
    "-1",
    "1",
    "1.5",
    "0.5",
    "inf",
    "-inf",
    "NaN",
    "1e308",
    "-1e308",
    "1e300",
    "1e99",
    "1e16",
    "5e-324",
    "1e400",
    "18446744073709551615",
    "9007199254740991",
    "true",
    "text",
    "../../x",
    "/tmp/x",
    "..\\x",
    "a/b",
    "**bold**",
    "_a_",
    "[a](b)",
    "a|b",
    "<script>alert(1)</script>",
    "<b>",
    "\"a,\nb\"",
    "größe\u{202e}",
];

/// The tables of a study, as they stand in their files.
#[derive(Clone, Debug)]
struct Study([Vec<u8>; 4]);

#[derive(Clone, Debug)]
enum Damage {
    Cell {
        table: usize,
        row: Index,
        column: Index,
        text: String,
    },
    Header {
        table: usize,
        column: Index,
        text: String,
    },
    Column {
        table: usize,
        column: Index,
        text: String,
    },
    Double {
        table: usize,
        row: Index,
    },
    Drop {
        table: usize,
        row: Index,
    },
    Swap {
        table: usize,
        rows: [Index; 2],
    },
    Shorten {
        table: usize,
        row: Index,
    },
    Lengthen {
        table: usize,
        row: Index,
    },
    Flip {
        table: usize,
        at: Index,
        bits: u8,
    },
    Cut {
        table: usize,
        at: Index,
    },
    Empty {
        table: usize,
    },
    /// A task (column 0) or method (column 1) with another name everywhere.
    Rename {
        column: usize,
        row: Index,
        text: String,
    },
}

fn damage() -> impl Strategy<Value = Damage> {
    let table = 0..TABLES.len();
    let index = any::<Index>;
    let text = prop_oneof![
        8 => select(&CELLS[..]).prop_map(String::from),
        1 => Just("long".repeat(5000)),
        1 => any::<f64>().prop_map(|number| number.to_string()),
        1 => any::<String>().prop_map(|text| format!("\"{}\"", text.replace('"', "\"\""))),
    ];
    let place = (table.clone(), index());
    prop_oneof![
        8 => (place.clone(), index(), text.clone()).prop_map(|((table, row), column, text)| Damage::Cell { table, row, column, text }),
        1 => (place.clone(), text.clone()).prop_map(|((table, column), text)| Damage::Header { table, column, text }),
        4 => (place.clone(), text).prop_map(|((table, column), text)| Damage::Column { table, column, text }),
        1 => place.clone().prop_map(|(table, row)| Damage::Double { table, row }),
        1 => place.clone().prop_map(|(table, row)| Damage::Drop { table, row }),
        1 => (table.clone(), [index(), index()]).prop_map(|(table, rows)| Damage::Swap { table, rows }),
        1 => place.clone().prop_map(|(table, row)| Damage::Shorten { table, row }),
        1 => place.clone().prop_map(|(table, row)| Damage::Lengthen { table, row }),
        2 => (place.clone(), 1..=255_u8).prop_map(|((table, at), bits)| Damage::Flip { table, at, bits }),
        2 => place.prop_map(|(table, at)| Damage::Cut { table, at }),
        1 => table.prop_map(|table| Damage::Empty { table }),
        4 => (0..2_usize, index(), select(&CELLS[..]))
            .prop_map(|(column, row, text)| Damage::Rename { column, row, text: text.into() }),
    ]
}

impl Study {
    /// A committed study with the first rows of each run: enough for all figures, and soon read.
    fn committed(name: &str) -> Self {
        Self(TABLES.map(|table| {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/study").join(name).join(table);
            let text = std::fs::read_to_string(path).expect("a committed table");
            let mut rows: BTreeMap<String, usize> = BTreeMap::new();
            let first = text.lines().enumerate().filter(|(i, line)| {
                let run = line.split(',').take(3).collect::<Vec<_>>().join(",");
                let row = rows.entry(run).or_default();
                *row += 1;
                *i == 0 || *row <= 6
            });
            first.map(|(_, line)| format!("{line}\n")).collect::<String>().into_bytes()
        }))
    }

    /// Changes the lines of a table, the header first.
    fn lines(&mut self, table: usize, change: impl FnOnce(&mut Vec<String>)) {
        let mut lines: Vec<String> = String::from_utf8_lossy(&self.0[table]).lines().map(String::from).collect();
        if lines.len() > 1 {
            change(&mut lines);
            self.0[table] = lines.iter().map(|line| format!("{line}\n")).collect::<String>().into_bytes();
        }
    }

    fn suffer(&mut self, damage: &Damage) {
        let row = |lines: &[String], index: &Index| 1 + index.index(lines.len() - 1);
        let replace = |line: &mut String, column: &Index, text: &str| {
            let mut cells: Vec<&str> = line.split(',').collect();
            let place = column.index(cells.len());
            cells[place] = text;
            *line = cells.join(",");
        };
        match damage {
            Damage::Cell { table, row: at, column, text } => self.lines(*table, |lines| {
                let at = row(lines, at);
                replace(&mut lines[at], column, text);
            }),
            Damage::Header { table, column, text } => {
                self.lines(*table, |lines| replace(&mut lines[0], column, text));
            }
            Damage::Column { table, column, text } => self.lines(*table, |lines| {
                lines[1..].iter_mut().for_each(|line| replace(line, column, text));
            }),
            Damage::Double { table, row: at } => self.lines(*table, |lines| {
                let at = row(lines, at);
                lines.insert(at, lines[at].clone());
            }),
            Damage::Drop { table, row: at } => self.lines(*table, |lines| {
                let at = row(lines, at);
                lines.remove(at);
            }),
            Damage::Swap { table, rows } => self.lines(*table, |lines| {
                let [a, b] = [row(lines, &rows[0]), row(lines, &rows[1])];
                lines.swap(a, b);
            }),
            Damage::Shorten { table, row: at } => self.lines(*table, |lines| {
                let at = row(lines, at);
                lines[at] = lines[at].rsplit_once(',').map_or("", |(start, _)| start).into();
            }),
            Damage::Lengthen { table, row: at } => self.lines(*table, |lines| {
                let at = row(lines, at);
                lines[at] += ",1";
            }),
            Damage::Flip { table, at, bits } => {
                let bytes = &mut self.0[*table];
                if !bytes.is_empty() {
                    let at = at.index(bytes.len());
                    bytes[at] ^= bits;
                }
            }
            Damage::Cut { table, at } => {
                let bytes = &mut self.0[*table];
                bytes.truncate(at.index(bytes.len() + 1));
            }
            Damage::Empty { table } => self.0[*table].clear(),
            Damage::Rename { column, row: at, text } => {
                let mut name = String::new();
                let name_in = |line: &str| line.split(',').nth(*column).unwrap_or_default().to_string();
                self.lines(3, |lines| name = name_in(&lines[row(lines, at)]));
                for table in 0..TABLES.len() {
                    self.lines(table, |lines| {
                        for line in lines.iter_mut().filter(|line| name_in(line) == name) {
                            let mut cells: Vec<&str> = line.split(',').collect();
                            if let Some(cell) = cells.get_mut(*column) {
                                *cell = text;
                            }
                            *line = cells.join(",");
                        }
                    });
                }
            }
        }
    }

    /// Whether a task or method has the name of a number, which then stands in the report with good reason.
    fn has_number_names(&self) -> bool {
        let text = String::from_utf8_lossy(&self.0[3]);
        let mut names = text.lines().flat_map(|line| line.split(',').take(2));
        names.any(|name| ["inf", "NaN"].contains(&name.trim_matches(['"', ' '])))
    }

    /// Makes the report. Answers with it, or with what is wrong with the tables.
    fn report(&self) -> Result<String> {
        let root = tempfile::tempdir().expect("a folder");
        // Two folders down, so that `../../x` is still in the root.
        let [from, to] = ["a/study", "a/report"].map(|name| root.path().join(name));
        std::fs::create_dir_all(&from).expect("a folder");
        for (name, bytes) in TABLES.iter().zip(&self.0) {
            std::fs::write(from.join(name), bytes).expect("a writable folder");
        }
        let (done, outcome) = mpsc::channel();
        let (read, written) = (from.clone(), to.clone());
        std::thread::spawn(move || done.send(report::write(&read, &written).map(drop)));
        let outcome = outcome.recv_timeout(LIMIT).expect("neither a panic nor a hang");
        let outside = files(root.path()).into_iter().filter(|path| !path.starts_with(&to));
        assert_eq!(outside.count(), TABLES.len(), "nothing is written elsewhere: {:?}", files(root.path()));
        outcome?;
        for path in files(&to).iter().filter(|path| path.extension().is_some_and(|ending| ending == "svg")) {
            let svg = std::fs::read_to_string(path).expect("a figure");
            let is_whole = self.has_number_names() || !svg.contains("NaN");
            assert!(is_whole && svg.len() < 500_000, "{}", path.display());
        }
        let text = std::fs::read_to_string(to.join("report.md")).expect("a report");
        let links = text.split("](").skip(1).map(|rest| rest.split(')').next().unwrap_or_default());
        for link in links {
            assert!(to.join(link).exists() && !link.contains('/'), "a link to `{link}` in: {text}");
        }
        Ok(text)
    }
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").path());
    entries.flat_map(|path| if path.is_dir() { files(&path) } else { vec![path] }).collect()
}

/// One or two lines of sensible length, without control characters.
fn check_message(problem: &Error) {
    let said = problem.to_string();
    assert!(said.lines().count() <= 2 && said.chars().count() < 600, "too much: {said}");
    assert!(!said.contains(|c: char| c.is_control() && c != '\n') && !said.contains('\u{202e}'), "{said:?}");
}

fn config() -> ProptestConfig {
    // A few seconds, unless `PROPTEST_CASES` asks for more.
    let cases = if std::env::var_os("PROPTEST_CASES").is_some() { ProptestConfig::default().cases } else { 16 };
    ProptestConfig {
        cases,
        rng_seed: RngSeed::Fixed(handful::rng::shake()),
        failure_persistence: None,
        ..Default::default()
    }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn damaged_tables_are_reported_or_refused(
        name in select(&["quick", "push", "lift", "dreamer"][..]),
        damages in prop::collection::vec(damage(), 1..4),
    ) {
        let mut study = Study::committed(name);
        damages.iter().for_each(|damage| study.suffer(damage));
        match study.report() {
            Ok(text) => {
                let text: String = text.lines().filter(|line| !folds(line)).map(|line| format!("{line}\n")).collect();
                for raw in ["<", "**b", "_a_", "[a]", "a|b", "../"] {
                    prop_assert!(!text.contains(raw), "`{raw}` in: {text}");
                }
                let mut words = text.split(|c: char| !c.is_alphanumeric());
                let leaks = words.any(|word| ["inf", "NaN"].contains(&word)) && !study.has_number_names();
                prop_assert!(!leaks, "{text}");
            }
            Err(problem) => check_message(&problem),
        }
    }
}

/// Whether this whole line is where the report itself begins or ends a fold.
fn folds(line: &str) -> bool {
    let method = line.strip_prefix("<details><summary>Model and values of <code>");
    let method = method.and_then(|rest| rest.strip_suffix("</code></summary>"));
    line == "</details>"
        || line == "<details><summary>What the columns mean</summary>"
        || method.is_some_and(|name| !name.contains(|c: char| "<>&*[]|/".contains(c)))
}

/// Changes one cell of a table, in this line of the file.
fn set_cell(study: &mut Study, table: &str, line: usize, column: &str, text: &str) {
    let table = TABLES.iter().position(|name| *name == table).expect("a table");
    study.lines(table, |lines| {
        let place = lines[0].split(',').position(|name| name == column).expect("a column");
        let mut cells: Vec<&str> = lines[line - 1].split(',').collect();
        cells[place] = text;
        lines[line - 1] = cells.join(",");
    });
}

#[test]
fn a_cell_that_cannot_be_true_is_named() {
    for (table, column, text, rule) in [
        ("tests.csv", "task", "../../x", "a name has up to 64 letters"),
        ("evaluations.csv", "method", "[a](b)", "a name has up to 64 letters"),
        ("tests.csv", "seed", "-1", "a whole number in 0..1048576"),
        ("tests.csv", "seed", "0.5", "a whole number in 0..1048576"),
        ("evaluations.csv", "success", "1.5", "it must lie in [0, 1]"),
        ("evaluations.csv", "success", "NaN", "it must lie in [0, 1]"),
        ("evaluations.csv", "success", "", "it must be a number"),
        ("evaluations.csv", "step", "1e3", "a whole number"),
        ("evaluations.csv", "return_mean", "inf", "it must be finite"),
        ("evaluations.csv", "seconds", "-1", "it must not be negative"),
        ("evaluations.csv", "return_std", "-1", "it must not be negative"),
        ("evaluations.csv", "action_ms", "NaN", "it must be finite"),
        ("models.csv", "rmse", "-1", "it must not be negative"),
        ("models.csv", "rmse_p90", "-1", "it must not be negative"),
        ("values.csv", "rmse", "-1", "it must not be negative"),
        ("tests.csv", "action_change", "-1", "it must not be negative"),
        ("models.csv", "rmse", "small", "it must be a number"),
        ("models.csv", "coverage90", "1.5", "it must lie in [0, 1]"),
        ("values.csv", "correlation", "inf", "it must lie in [-1, 1]"),
        ("tests.csv", "success", "1", "`true` or `false`"),
        ("tests.csv", "starts", "elsewhere", "`test` or `development`"),
    ] {
        let mut study = Study::committed("quick");
        set_cell(&mut study, table, 4, column, text);
        let said = study.report().expect_err(text).to_string();
        for part in [table, &format!("line 4: `{column}` is `{text}`"), rule] {
            assert!(said.contains(part) && said.lines().count() == 1, "no `{part}` in: {said}");
        }
    }
}

#[test]
fn a_model_that_diverged_is_reported() {
    for number in ["inf", "NaN", "1e308", ""] {
        let mut study = Study::committed("quick");
        for (table, column) in
            [("models.csv", "rmse"), ("values.csv", "expected"), ("values.csv", "realised"), ("tests.csv", "sparc")]
        {
            set_cell(&mut study, table, 2, column, number);
        }
        let text = study.report().expect("a report");
        // One of its model, two of the returns that it expected and got.
        let note = "not finite: 3 of the numbers about `dreamer`";
        assert_eq!(text.contains(note), !number.is_empty(), "`{number}`: {text}");
        assert!(!text.contains("NaN") && !text.contains("inf "), "{text}");
    }
}

/// A model that predicts one outcome has no interval: no number was left out.
#[test]
fn a_model_without_uncertainty_is_reported() {
    let mut study = Study::committed("quick");
    study.lines(1, |lines| {
        let columns: Vec<String> = lines[0].split(',').map(String::from).collect();
        for line in lines.iter_mut().filter(|line| line.contains(",dreamer,")) {
            let cells = line.split(',').zip(&columns);
            let kept = cells.map(|(cell, name)| if ["nll", "coverage90"].contains(&name.as_str()) { "" } else { cell });
            *line = kept.collect::<Vec<_>>().join(",");
        }
    });
    let text = study.report().expect("a report");
    assert!(!text.contains("numbers about `dreamer`"), "{text}");
}

#[test]
fn rows_that_are_doubled_missing_or_moved_are_named() {
    let quick = Study::committed("quick");
    type Change = fn(&mut Vec<String>);
    let changes: [(usize, Change, &str); 11] = [
        (0, |lines| lines.insert(2, lines[1].clone()), "line 3: step 0 of a run comes after step 0"),
        (0, |lines| lines.swap(1, 2), "line 3: step 0 of a run comes after step 500"),
        (1, |lines| lines.swap(1, 2), "line 3: step 0, horizon 1 of a run comes after step 0, horizon 2"),
        (3, |lines| drop(lines.remove(1)), "line 2: episode 2 of a run comes after nothing"),
        (3, |lines| drop(lines.remove(3)), "line 4: episode 4 of a run comes after episode 2"),
        (3, |lines| lines.retain(|line| !line.contains(",sac,")), "`sac` on `reach` with seed 0 is not in its tests"),
        (0, |lines| lines.retain(|line| !line.contains(",sac,1,")), "`sac` on `reach` with seed 1 is not in its eval"),
        (3, |lines| lines.truncate(1), "no test episode"),
        (2, |lines| lines[0] = lines[0].replace("expected", "estimate"), "no column `expected`"),
        (2, |lines| lines[0] = lines[0].replace("rmse", "step"), "two columns `step`"),
        (2, |lines| lines[3] += ",1", "line 4: it has 9 cells, the header has 8"),
    ];
    for (table, change, expected) in changes {
        let mut study = quick.clone();
        study.lines(table, change);
        let said = study.report().expect_err("a damaged table").to_string();
        assert!(said.contains(expected) && said.lines().count() == 1, "no `{expected}` in: {said}");
    }
}

/// A number that lost its last digits is still a number: the end of the line tells that it is whole.
#[test]
fn a_table_that_ends_within_a_number_is_refused() {
    let quick = Study::committed("quick");
    for (table, name) in TABLES.iter().enumerate() {
        for lost in 1..4 {
            let mut study = quick.clone();
            let kept = study.0[table].len() - lost;
            study.0[table].truncate(kept);
            let said = study.report().expect_err("a table that was cut").to_string();
            assert!(said.contains(name) && said.contains("its last line has no end"), "{lost} bytes less: {said}");
        }
    }
}

/// Rounding takes what our own runs compute a little beyond the bounds.
#[test]
fn a_correlation_is_rounded() {
    let mut study = Study::committed("quick");
    let halves: Vec<f64> = (0..7).map(|i| f64::from(i * i) / 10.0).collect();
    let beyond = (1..200).map(|factor| {
        let scaled: Vec<f64> = halves.iter().map(|x| x * f64::from(factor) / 7.0 + 0.1).collect();
        handful::study::statistics::correlation(&halves, &scaled)
    });
    let beyond = beyond.fold(0.0, f64::max);
    assert!(beyond > 1.0, "an example of it");
    set_cell(&mut study, "values.csv", 2, "correlation", &beyond.to_string());
    study.report().expect("a report");
}

/// Whatever their names are, no method's figure takes the place of another's.
#[test]
fn every_method_has_its_own_figures() {
    let mut study = Study::committed("quick");
    // A task with a dash, and a method whose name begins with its end.
    for table in 0..TABLES.len() {
        study.lines(table, |lines| {
            let twin = |line: &String| line.replacen("reach,dreamer,", "reach-by,dreamer,", 1);
            let twins: Vec<String> = lines.iter().filter(|line| line.starts_with("reach,dreamer,")).map(twin).collect();
            lines.iter_mut().for_each(|line| *line = line.replacen("reach,dreamer,", "reach,by-dreamer,", 1));
            lines.extend(twins);
        });
    }
    let text = study.report().expect("a report");
    let mut links: Vec<&str> = text.split("](").skip(1).filter_map(|rest| rest.split(')').next()).collect();
    let count = links.len();
    links.sort_unstable();
    links.dedup();
    assert_eq!(links.len(), count, "{links:?}");
    assert!(
        links.contains(&"reach-by-dreamer-model.svg") && links.contains(&"reach-by.dreamer-model.svg"),
        "{links:?}"
    );
}

/// Spreadsheets and other systems write the same table differently.
#[test]
fn other_ways_to_write_a_table_are_read() {
    let quick = Study::committed("quick");
    let expected = quick.report().expect("a report");
    let rewritten = |change: &dyn Fn(String) -> String| {
        let text = |bytes: Vec<u8>| change(String::from_utf8(bytes).expect("text")).into_bytes();
        Study(quick.0.clone().map(text)).report().expect("a report")
    };
    assert_eq!(rewritten(&|text| text.replace('\n', "\r\n")), expected);
    assert_eq!(rewritten(&|text| format!("\u{feff}{text}")), expected);
    assert_eq!(rewritten(&|text| text.replace("reach", "\"reach\"")), expected);
    assert_eq!(rewritten(&|text| text.replace(',', ", ")), expected);
    assert_eq!(rewritten(&|text| text.replace("true", "True")), expected);
    // Without models and values, whether there is a header or not.
    let bare = |models: &[u8], values: &[u8]| {
        let [evaluations, _, _, tests] = quick.0.clone();
        Study([evaluations, models.into(), values.into(), tests]).report().expect("a report")
    };
    let header = |table: usize| quick.0[table].split_inclusive(|byte| *byte == b'\n').next().expect("a header");
    assert_eq!(bare(b"", b""), bare(header(1), header(2)));
}

/// What the tables of the runs say is quoted in the report, and does nothing there.
#[test]
fn configurations_and_reasons_are_quoted() {
    let folder = tempfile::tempdir().expect("a folder");
    let write = |name: &str, text: String| std::fs::write(folder.path().join(name), text).expect("a writable folder");
    let evil = "</details><script>alert(1)</script>`**\n\n# h\n```\n";
    write(
        "tests.csv",
        "task,method,seed,episode,return,success,length,stage,sparc,ldlj\na,b,0,1,1,true,9,0,,\n".into(),
    );
    for empty in ["evaluations.csv", "models.csv", "values.csv"] {
        write(empty, String::new());
    }
    write("runs.csv", format!("task,method,seed,version,configuration\na,b,0,\"{evil}\",\"a = '''{evil}'''\"\n"));
    write("left_out.csv", format!("run,reason\n\"{evil}\",\"{evil}\"\n"));
    report::write(folder.path(), folder.path()).expect("a report");
    let page = std::fs::read_to_string(folder.path().join("report.html")).expect("a page");
    assert!(!page.contains("<script") && page.matches("</details>").count() == 2, "{page}");
    assert!(!page.contains("<h1>h") && page.contains("&lt;script&gt;alert(1)"), "{page}");
    for (file, text, problem) in [
        ("runs.csv", "task,method,seed,version\na,b,0,1\n", "no column `configuration`"),
        ("runs.csv", "task,method,seed,version,configuration\na,b,0,1,c\na,b,0,1,c\n", "a row is doubled"),
        ("runs.csv", "task,method,seed,version,configuration\na,b,0,1,\na,c,0,1,\n", "is not in its tests"),
        (
            "runs.csv",
            "task,method,seed,version,configuration\na,b,0,1,c\n",
            "its configuration in runs.csv is not TOML",
        ),
        ("left_out.csv", "run\na\n", "no column `reason`"),
    ] {
        let before = std::fs::read(folder.path().join(file)).expect("a table");
        write(file, text.into());
        let found = report::write(folder.path(), folder.path()).expect_err(problem).to_string();
        assert!(found.contains(problem), "{found}");
        std::fs::write(folder.path().join(file), before).expect("a writable folder");
    }
}
