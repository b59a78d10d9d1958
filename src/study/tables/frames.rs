//! What is read from and written of a data frame.

use polars::prelude::*;

use super::{Curve, inside};
use crate::chart::LARGEST;
use crate::error::Result;

/// The rows of a method on a task.
pub(in crate::study) fn of(frame: &DataFrame, task: &str, method: &str) -> PolarsResult<DataFrame> {
    if frame.width() == 0 {
        return Ok(frame.clone());
    }
    let here = col("task").eq(lit(task)).and(col("method").eq(lit(method)));
    frame.clone().lazy().filter(here).collect()
}

/// Groups rows by run: one row per run, in the order of the runs, with each of these columns as a list.
pub(in crate::study) fn by_run(rows: LazyFrame, columns: &[&str]) -> PolarsResult<DataFrame> {
    let lists: Vec<Expr> = columns.iter().map(|name| col(*name).strict_cast(DataType::Float64).drop_nulls()).collect();
    rows.group_by_stable(["task", "method", "seed"].map(col)).agg(lists).collect()
}

/// A column over environment steps, for each seed. What no chart can show is left out.
pub(in crate::study) fn curves(rows: &DataFrame, task: &str, method: &str, value: &str) -> PolarsResult<Vec<Curve>> {
    if rows.width() == 0 {
        return Ok(Vec::new());
    }
    let number = col(value).cast(DataType::Float64);
    let shown = number.clone().gt_eq(lit(-LARGEST)).and(number.lt_eq(lit(LARGEST)));
    let known = of(rows, task, method)?.lazy().filter(shown);
    let runs = by_run(known, &["step", value])?;
    Ok(lists(&runs, "step")?.into_iter().zip(lists(&runs, value)?).collect())
}

/// The same for a column that tables of earlier versions do not have: none of it then.
pub(in crate::study) fn optional_curves(
    rows: &DataFrame,
    task: &str,
    method: &str,
    value: &str,
) -> PolarsResult<Vec<Curve>> {
    if rows.column(value).is_ok() { curves(rows, task, method, value) } else { Ok(Vec::new()) }
}

pub(in crate::study) fn lists(runs: &DataFrame, column: &str) -> PolarsResult<Vec<Vec<f64>>> {
    let numbers = |list: Series| Ok(list.f64()?.iter().flatten().collect());
    runs.column(column)?.list()?.no_null_series_iter().map(numbers).collect()
}

pub(in crate::study) fn strings(frame: &DataFrame, column: &str) -> PolarsResult<Vec<String>> {
    Ok(frame.column(column)?.str()?.iter().map(|s| s.unwrap_or_default().to_string()).collect())
}

pub(in crate::study) fn numbers(frame: &DataFrame, column: &str) -> PolarsResult<Vec<Option<f64>>> {
    let column = frame.column(column)?.cast(&DataType::Float64)?;
    Ok(column.f64()?.iter().collect())
}

/// A table as CSV; nothing for one without columns.
pub(super) fn csv(table: &DataFrame) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    if table.width() > 0 {
        CsvWriter::new(&mut bytes).finish(&mut table.clone()).map_err(inside)?;
    }
    Ok(bytes)
}
