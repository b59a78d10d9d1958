//! The report of a study, written from its tables alone.

use std::fmt::Write;
use std::path::Path;

use super::tables::{LEVEL, Tables};
use super::{figures, tables};
use crate::error::Result;
use crate::files;

/// Reads a study's tables from the folder `from`, and writes `summary.csv`, the figures and `report.md` into the folder
/// `to`. Returns the table of results as text.
///
/// # Errors
/// If a table is missing or damaged, or if a file cannot be written.
pub fn write(from: &Path, to: &Path) -> Result<String> {
    let tables = Tables::read(from)?;
    tables.write_summary(to)?;
    let pairs = tables.tasks_and_methods()?;
    let mut tasks: Vec<&str> = pairs.iter().map(|(task, _)| task.as_str()).collect();
    tasks.dedup();
    let mut text = String::from("# Comparison\n\n");
    text += "Every number on this page comes from `tests.csv`, `evaluations.csv`, `models.csv`, `values.csv` and `summary.csv` in the same folder. ";
    text += "All methods are evaluated in the same way: the same tasks, observations and initial states, deterministic actions, ";
    text += "and every environment step counted, including the random warm-up. ";
    text += "They are not given the same information: `oracle` plans in the true simulator; `pets` plans in a learned model, but ";
    text += "is given the reward function; `dreamer` and `sac` have only the rewards that they receive.\n\n";
    text += "## Results\n\n";
    text += &markdown(&rows(&tables)?);
    text += &format!(
        "\nSuccess: share of test episodes in which the task is solved at the last step, with its 95 % Wilson interval. Steps to \
         {:.0} %: environment steps at which the success curve, interpolated linearly between evaluations, first reaches \
         that level; median over seeds (a dash if the median seed does not reach it). SPARC, LDLJ: smoothness of the \
         hand's movement; closer to zero is smoother.\n",
        100.0 * LEVEL
    );
    for task in &tasks {
        let (curves, tests) = (format!("{task}-learning.svg"), format!("{task}-test.svg"));
        write!(text, "\n## {task}\n\n").expect("text grows");
        text += &findings(&tables, task)?;
        if figures::learning_curves(&tables, task, &to.join(&curves))? {
            write!(text, "\n![Success rate of each method on {task} over environment steps]({curves})\n")
                .expect("text grows");
        }
        figures::tests(&tables, task, &to.join(&tests))?;
        write!(text, "\n![Success rate and smoothness of each method on {task} in the final test]({tests})\n")
            .expect("text grows");
        for (_, method) in pairs.iter().filter(|(of, _)| of == task) {
            let file = format!("{task}-{method}-model.svg");
            if figures::model(&tables, task, method, &to.join(&file))? {
                write!(
                    text,
                    "\n![Open-loop prediction error and calibration of the model of {method} on {task} over environment steps]({file})\n"
                )
                .expect("text grows");
            }
            let file = format!("{task}-{method}-values.svg");
            if figures::values(&tables, task, method, &to.join(&file))? {
                write!(text, "\n![Value estimated by {method} on {task} over environment steps, and the return that followed]({file})\n")
                    .expect("text grows");
            }
        }
    }
    text += "\n## How certain is this?\n\n";
    text += &caveat(&tables, &pairs)?;
    files::write(&to.join("report.md"), text.as_bytes())?;
    Ok(text_table(&rows(&tables)?))
}

const HEAD: [&str; 9] = ["task", "method", "seeds", "steps", "success", "return", "steps to 80 %", "SPARC", "LDLJ"];

fn rows(tables: &Tables) -> Result<Vec<[String; 9]>> {
    let mut rows = Vec::new();
    for (task, method) in tables.tasks_and_methods()? {
        let value = |column: &str| tables.value(&task, &method, column);
        let show = |column: &str, digits: usize| -> Result<String> {
            Ok(value(column)?.map_or("-".into(), |v| format!("{v:.digits$}")))
        };
        let percent =
            |column: &str| -> Result<String> { Ok(format!("{:.0}", 100.0 * value(column)?.unwrap_or(f64::NAN))) };
        let success = format!("{} % [{}, {}]", percent("success")?, percent("success_low")?, percent("success_high")?);
        rows.push([
            task.clone(),
            method.clone(),
            show("seeds", 0)?,
            show("steps", 0)?,
            success,
            show("return_mean", 1)?,
            show("steps_to_80", 0)?,
            show("smoothness_sparc", 2)?,
            show("smoothness_ldlj", 2)?,
        ]);
    }
    Ok(rows)
}

fn markdown(rows: &[[String; 9]]) -> String {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let head = line(&HEAD.map(String::from));
    let rule = format!("|{}\n", " --- |".repeat(HEAD.len()));
    head + &rule + &rows.iter().map(|row| line(row)).collect::<String>()
}

fn text_table(rows: &[[String; 9]]) -> String {
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::UTF8_HORIZONTAL_ONLY).set_header(HEAD);
    for row in rows {
        table.add_row(row);
    }
    table.to_string()
}

/// The results of a task in words.
fn findings(tables: &Tables, task: &str) -> Result<String> {
    let mut text = String::new();
    for (_, method) in tables.tasks_and_methods()?.into_iter().filter(|(of, _)| of == task) {
        let value = |column: &str| tables.value(task, &method, column);
        let success = 100.0 * value("success")?.unwrap_or(0.0);
        match (value("steps")?, value("steps_to_80")?, value("seeds_reaching_80")?, value("seeds")?) {
            (Some(budget), Some(steps), Some(reaching), Some(seeds)) => writeln!(
                text,
                "- `{method}` reaches {:.0} % success after {steps:.0} steps (median; {reaching:.0} of {seeds:.0} seeds reach \
                 it within {budget:.0}) and ends at {success:.0} %.",
                100.0 * tables::LEVEL
            ),
            (Some(budget), None, Some(reaching), Some(seeds)) => writeln!(
                text,
                "- `{method}` does not reach {:.0} % success in its median seed within {budget:.0} steps ({reaching:.0} of \
                 {seeds:.0} seeds do); it ends at {success:.0} %.",
                100.0 * tables::LEVEL
            ),
            _ => writeln!(text, "- `{method}` does not learn; it succeeds in {success:.0} % of the test episodes."),
        }
        .expect("text grows");
    }
    Ok(text)
}

fn caveat(tables: &Tables, pairs: &[(String, String)]) -> Result<String> {
    let mut fewest = f64::INFINITY;
    for (task, method) in pairs {
        if tables.value(task, method, "steps")?.is_some() {
            fewest = fewest.min(tables.value(task, method, "seeds")?.unwrap_or(0.0));
        }
    }
    Ok(match fewest {
        f64::INFINITY => "No method here learns, so the only uncertainty is that of the test episodes.\n".into(),
        n if n < 5.0 => format!(
            "Not very: with {n:.0} seed{} of a learning method, the intervals describe these particular agents, not the \
             method. Run `handful study --seeds 5` (or `--profile full`) before you conclude anything.\n",
            if n == 1.0 { "" } else { "s" }
        ),
        n => format!(
            "Each learning method has at least {n:.0} seeds. `summary.csv` contains the interquartile mean over seeds with its \
             bootstrap interval (`success_iqm_low`, `success_iqm_high`); trust only differences larger than this interval.\n"
        ),
    })
}
