//! Reads the tables of runs and studies. What comes from here has every column, and no cell that cannot be true.

use std::collections::HashMap;
use std::path::Path;

use polars::prelude::{Column, DataFrame};

use super::inside;
use crate::error::{Error, Result};
use crate::study::names::{NAME_RULE, check_name, excerpt};
use crate::study::starts::{LIMIT, Starts};

/// What a cell holds.
#[derive(Clone, Copy, Debug)]
enum Cell {
    /// The name of a task or method.
    Name,
    /// Any text.
    Text,
    /// The name of a set of starts.
    Starts,
    /// A whole number from 0 on, below this limit.
    Count(u64),
    /// `true` or `false`.
    Flag,
    /// A share, from 0 to 1.
    Share,
    /// A finite number.
    Number,
    /// A finite number from 0 on.
    Magnitude,
    /// What is not always there: nothing, or any number. A movement that never began has no smoothness, the error of a model
    /// that diverged is infinite.
    Measure,
    /// The same, but no number below 0.
    Distance,
    /// The same as a measure, but a number lies between these two, apart from rounding.
    Within(f64, f64),
}

/// The columns of a table.
pub(super) struct TableFormat {
    /// In the order in which they are written, and whether a table can be without: nothing is computed from these.
    columns: &'static [(&'static str, Cell, Need)],
    /// What the rows of a run are ordered by, from the first to the last.
    order: &'static [&'static str],
    /// Whether the order counts 1, 2, 3, ...
    counts: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Need {
    Always,
    /// Nothing but figures is computed from it.
    Optional,
}
use Need::{Always, Optional};

/// The table of a study names the run of each row; those of a single run do not.
const LABELS: [(&str, Cell, Need); 3] =
    [("task", Cell::Name, Always), ("method", Cell::Name, Always), ("seed", Cell::Count(LIMIT), Always)];
/// How far from its bounds a number may be computed.
const ROUNDING: f64 = 1e-9;
/// More than any run counts, and few enough for a float.
const MANY: Cell = Cell::Count(1 << 53);

pub(super) const EVALUATIONS: TableFormat = TableFormat {
    columns: &[
        ("step", MANY, Always),
        ("episodes", MANY, Always),
        ("success", Cell::Share, Always),
        ("return_mean", Cell::Number, Optional),
        ("return_std", Cell::Magnitude, Optional),
        ("smoothness_sparc", Cell::Measure, Optional),
        ("smoothness_ldlj", Cell::Measure, Optional),
        ("action_ms", Cell::Magnitude, Optional),
        ("updates", MANY, Optional),
        ("seconds", Cell::Magnitude, Optional),
    ],
    order: &["step"],
    counts: false,
};

pub(super) const EPISODES: TableFormat = TableFormat {
    columns: &[("step", MANY, Always), ("seconds", Cell::Magnitude, Always)],
    order: &["step"],
    counts: false,
};

pub(super) const MODELS: TableFormat = TableFormat {
    columns: &[
        ("step", MANY, Always),
        ("horizon", MANY, Always),
        ("rmse", Cell::Distance, Always),
        ("nll", Cell::Measure, Optional),
        ("coverage90", Cell::Within(0.0, 1.0), Always),
        ("rmse_p90", Cell::Distance, Optional),
    ],
    order: &["step", "horizon"],
    counts: false,
};

pub(super) const VALUES: TableFormat = TableFormat {
    columns: &[
        ("step", MANY, Always),
        ("expected", Cell::Measure, Always),
        ("realised", Cell::Measure, Always),
        ("rmse", Cell::Distance, Optional),
        ("correlation", Cell::Within(-1.0, 1.0), Always),
    ],
    order: &["step"],
    counts: false,
};

pub(super) const TESTS: TableFormat = TableFormat {
    columns: &[
        ("episode", MANY, Always),
        ("return", Cell::Number, Always),
        ("success", Cell::Flag, Always),
        ("length", MANY, Always),
        ("stage", MANY, Optional),
        ("sparc", Cell::Measure, Always),
        ("ldlj", Cell::Measure, Always),
        ("action_change", Cell::Distance, Optional),
        ("starts", Cell::Starts, Optional),
    ],
    order: &["episode"],
    // Episode i of every method begins at the same start: a row that is missing would pair the wrong ones.
    counts: true,
};

pub(super) const RUNS: TableFormat = TableFormat {
    columns: &[("version", Cell::Text, Always), ("configuration", Cell::Text, Always)],
    order: &["seed"],
    counts: false,
};

pub(super) const LEFT_OUT: TableFormat =
    TableFormat { columns: &[("run", Cell::Text, Always), ("reason", Cell::Text, Always)], order: &[], counts: false };

/// What to do about a table that is damaged.
const REMEDY: &str = "; restore the table, or run again the command that made it";

/// The table of a run.
///
/// # Errors
/// If it cannot be read, is empty, lacks a column, or a row cannot be true.
pub(super) fn of_run(path: &Path, format: &TableFormat) -> Result<DataFrame> {
    let table = read(path, format, &[])?;
    if table.width() == 0 { Err(Error::data(path)(format!("the table is empty{REMEDY}"))) } else { Ok(table) }
}

/// The table of a study. It has no columns if the file is empty: no run had anything to write there.
///
/// # Errors
/// As [`of_run`], but an empty file is none.
pub(super) fn of_study(path: &Path, format: &TableFormat) -> Result<DataFrame> {
    read(path, format, &LABELS)
}

fn read(path: &Path, format: &TableFormat, labels: &[(&'static str, Cell, Need)]) -> Result<DataFrame> {
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    let bad = |problem: String| Error::data(path)(problem);
    // A number that lost its last digits is a number, too.
    if bytes.last().is_some_and(|byte| *byte != b'\n') {
        let problem =
            "its last line has no end: the table was cut off; restore it, or end the line if nothing is missing";
        return Err(bad(problem.into()));
    }
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(bytes.as_slice());
    let header = reader.headers().map_err(|problem| bad(in_short(&problem)))?.clone();
    if header.is_empty() {
        return Ok(DataFrame::empty());
    }
    let mut columns = Vec::new();
    for &(name, cell, need) in labels.iter().chain(format.columns) {
        let mut places = (0..header.len()).filter(|i| &header[*i] == name);
        match (places.next(), places.next()) {
            (Some(place), None) => columns.push((name, place, Cells::new(cell))),
            (None, _) if need == Optional => {}
            (None, _) => {
                let there = excerpt(&header.iter().collect::<Vec<_>>().join(","));
                return Err(bad(format!("the table has no column `{name}`, but: {there}{REMEDY}")));
            }
            (Some(_), Some(_)) => return Err(bad(format!("the table has two columns `{name}`{REMEDY}"))),
        }
    }
    let mut last: HashMap<Vec<String>, Vec<u64>> = HashMap::new();
    for row in reader.records() {
        let row = row.map_err(|problem| bad(in_short(&problem)))?;
        let line = row.position().map_or(0, csv::Position::line);
        for (name, place, cells) in &mut columns {
            let text = &row[*place];
            cells.push(text).map_err(|rule| bad(format!("line {line}: `{name}` is `{}`; {rule}", excerpt(text))))?;
        }
        let text =
            |name: &str| columns.iter().find(|(other, ..)| *other == name).map_or("", |(_, place, _)| &row[*place]);
        let run: Vec<String> = labels.iter().map(|(name, ..)| text(name).to_string()).collect();
        let here: Vec<u64> = format.order.iter().map(|name| text(name).parse().unwrap_or_default()).collect();
        let before = last.insert(run, here.clone()).unwrap_or_default();
        if (here <= before && !format.order.is_empty())
            || (format.counts && here[0] != before.first().unwrap_or(&0) + 1)
        {
            let place = |numbers: &[u64]| {
                let each = format.order.iter().zip(numbers).map(|(name, number)| format!("{name} {number}"));
                each.collect::<Vec<_>>().join(", ")
            };
            let before = if before.is_empty() { "nothing".into() } else { place(&before) };
            let problem = format!(
                "line {line}: {} of a run comes after {before}: a row is doubled, missing or moved{REMEDY}",
                place(&here)
            );
            return Err(bad(problem));
        }
    }
    DataFrame::new_infer_height(columns.into_iter().map(|(name, _, cells)| cells.into_column(name)).collect())
        .map_err(inside)
}

/// What is wrong with a line of CSV.
fn in_short(problem: &csv::Error) -> String {
    let line = problem.position().map_or(0, csv::Position::line);
    match problem.kind() {
        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
            format!("line {line}: it has {len} cells, the header has {expected_len}{REMEDY}")
        }
        csv::ErrorKind::Utf8 { .. } => format!("line {line}: it is not text in UTF-8"),
        _ => format!("not a table ({problem})"),
    }
}

/// The cells of a column so far.
enum Cells {
    Text(Cell, Vec<String>),
    Whole(u64, Vec<i64>),
    Flags(Vec<bool>),
    Numbers(Cell, Vec<Option<f64>>),
}

impl Cells {
    fn new(cell: Cell) -> Self {
        match cell {
            Cell::Name | Cell::Starts | Cell::Text => Self::Text(cell, Vec::new()),
            Cell::Count(limit) => Self::Whole(limit, Vec::new()),
            Cell::Flag => Self::Flags(Vec::new()),
            Cell::Share | Cell::Number | Cell::Magnitude | Cell::Measure | Cell::Distance | Cell::Within(..) => {
                Self::Numbers(cell, Vec::new())
            }
        }
    }

    /// Takes in a cell, or returns the rule that it breaks.
    fn push(&mut self, text: &str) -> Result<(), String> {
        match self {
            Self::Text(Cell::Starts, names) => {
                let starts: Starts = text.parse().map_err(|_| "it must be `test` or `development`")?;
                names.push(starts.name().into());
            }
            Self::Text(Cell::Text, texts) => texts.push(text.into()),
            Self::Text(_, names) => {
                check_name("a task or method", text).map_err(|_| NAME_RULE)?;
                names.push(text.into());
            }
            Self::Whole(limit, numbers) => {
                let number = text.parse().ok().filter(|number: &u64| number < limit);
                let number = number.ok_or_else(|| format!("it must be a whole number in 0..{limit}"))?;
                numbers.push(number as i64);
            }
            Self::Flags(flags) => flags.push(match text.to_ascii_lowercase().as_str() {
                "true" => true,
                "false" => false,
                _ => return Err("it must be `true` or `false`".into()),
            }),
            Self::Numbers(Cell::Measure | Cell::Distance | Cell::Within(..), numbers) if text.is_empty() => {
                numbers.push(None)
            }
            Self::Numbers(cell, numbers) => {
                let number: f64 = text.parse().map_err(|_| "it must be a number")?;
                match *cell {
                    Cell::Share if !(0.0..=1.0).contains(&number) => return Err("it must lie in [0, 1]".into()),
                    Cell::Magnitude | Cell::Distance if number < 0.0 => {
                        return Err("it must not be negative".into());
                    }
                    Cell::Within(low, high) if number < low - ROUNDING || number > high + ROUNDING => {
                        return Err(format!("it must lie in [{low}, {high}]"));
                    }
                    Cell::Number | Cell::Magnitude if !number.is_finite() => return Err("it must be finite".into()),
                    _ => numbers.push(Some(number)),
                }
            }
        }
        Ok(())
    }

    fn into_column(self, name: &str) -> Column {
        match self {
            Self::Text(_, cells) => Column::new(name.into(), cells),
            Self::Whole(_, cells) => Column::new(name.into(), cells),
            Self::Flags(cells) => Column::new(name.into(), cells),
            Self::Numbers(_, cells) => Column::new(name.into(), cells),
        }
    }
}
