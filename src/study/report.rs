//! The report of a study, written from its tables alone.

use std::fmt::Write;
use std::path::Path;
use std::time::Duration;

use super::figures;
use super::page;
use super::provenance;
use super::replays;
use super::starts::Starts;
use super::tables::{BASELINE, Curve, LEVEL, Tables};
use super::verdict::verdict;
use crate::error::Result;
use crate::files;

/// A temporary file that is older than this is nobody's any more.
const ABANDONED: Duration = Duration::from_secs(3600);

/// Reads a study's tables from the folder `from`, and writes `summary.csv`, the figures, `report.md` and the same as a
/// page that needs no other file, `report.html`, into the folder `to`. Returns the table of results as text.
///
/// # Errors
/// If a table is missing or damaged, or if a file cannot be written.
pub fn write(from: &Path, to: &Path) -> Result<String> {
    let tables = Tables::read(from)?;
    files::sweep(to, ABANDONED);
    tables.write_summary(to)?;
    let pairs = tables.tasks_and_methods()?;
    let mut tasks: Vec<&str> = Vec::new();
    for (task, _) in &pairs {
        if !tasks.contains(&task.as_str()) {
            tasks.push(task);
        }
    }
    let mut text = String::from("# Comparison\n\n");
    text += tuning_note(&tables)?;
    text += "Every number on this page comes from `tests.csv`, `evaluations.csv`, `models.csv`, `values.csv` and `summary.csv` in the same folder. ";
    text += "All methods are evaluated in the same way: the same tasks, observations and initial states, deterministic actions, ";
    text += "and every environment step counted, including the random warm-up. ";
    text += "They are not given the same information: `oracle` plans in the true simulator; `pets` plans in a learned model, but ";
    text += "is given the reward function; `pets-learned`, `dreamer`, `tdmpc2` and `sac` have only the rewards that they receive.\n\n";
    let replays = replays::read(from)?;
    replays::copy(&replays, from, to)?;
    let verdict = verdict(&tables, &tasks)?;
    if !verdict.is_empty() {
        text += &format!("## Verdict\n\n{verdict}\n");
    }
    text += "## Results\n\n";
    text += &markdown(&rows(&tables)?);
    text += &format!(
        "\nSuccess: share of test episodes in which the task is solved at the last step, with a 95 % interval. With several \
         seeds, that is the two-level bootstrap: seeds are drawn, then the episodes of each. With one seed (a method that does \
         not learn needs only one), and where all episodes have the same outcome, it is the Wilson interval, which covers the \
         test episodes and not the differences between seeds. {:.0} % by step: the first evaluation at which that success \
         rate is reached and held at the next, and the seconds of training until then, on a machine that several runs shared; \
         medians over seeds (a dash if the median seed does not reach it within its budget). ms per action: the time that \
         choosing an action takes in the last evaluation. SPARC, LDLJ: smoothness of the hand's movement; closer to zero is smoother.\n",
        100.0 * LEVEL
    );
    text += &format!(
        "\nIn the tables of the tasks, area under the curve is the mean success rate up to the smallest budget; action change the root mean square \
         change from one action to the next in the test; optimism the return that was expected (a value, or what a plan predicts for its horizon) less \
         the return that followed, over the size of the latter, in the last evaluation, and correlation that of the two over time steps; better and \
         earlier the probability that a seed has more success in the test than one of `{BASELINE}`, or reaches {:.0} % by an earlier step.\n",
        100.0 * LEVEL
    );
    let mut not_alike = Vec::new();
    for task in &tasks {
        let (curves, tests) = (format!("{task}-learning.svg"), format!("{task}-test.svg"));
        write!(text, "\n## {task}\n\n").expect("text grows");
        text += &findings(&tables, task)?;
        let unlike = different_grids(&tables, task)?;
        if !unlike.is_empty() {
            not_alike.push(*task);
        }
        text += &unlike;
        text += &details(&tables, task)?;
        if figures::learning_curves(&tables, task, &to.join(&curves))? {
            write!(text, "\n![Success rate of each method on {task} over environment steps]({curves})\n")
                .expect("text grows");
        }
        let profile = format!("{task}-profile.svg");
        if figures::profile(&tables, task, &to.join(&profile))? {
            write!(text, "\n![Share of each method's seeds above each success rate on {task}, and success over seconds of training]({profile})\n")
                .expect("text grows");
        }
        figures::tests(&tables, task, &to.join(&tests))?;
        write!(text, "\n![Success rate and smoothness of each method on {task} in the final test]({tests})\n")
            .expect("text grows");
        text += &replays::table(&replays, task);
        for (_, method) in pairs.iter().filter(|(of, _)| of == task) {
            let stem = figures::stem(task, method);
            let file = format!("{stem}-model.svg");
            if figures::model(&tables, task, method, &to.join(&file))? {
                write!(
                    text,
                    "\n![Open-loop prediction error and calibration of the model of {method} on {task} over environment steps]({file})\n"
                )
                .expect("text grows");
            }
            let file = format!("{stem}-values.svg");
            if figures::values(&tables, task, method, &to.join(&file))? {
                write!(text, "\n![Return that {method} expected on {task} over environment steps, and the return that followed]({file})\n")
                    .expect("text grows");
            }
            match tables.left_out(task, method)? {
                0 => {}
                count => {
                    text += &format!("\nNot drawn, because not finite: {count} of the numbers about `{method}`.\n");
                }
            }
        }
    }
    text += "\n## How certain is this?\n\n";
    text += &caveat(&tables, &pairs)?;
    text += "\n## Checklist\n\n";
    text += &provenance::checklist(&tables, &not_alike)?;
    let configurations = provenance::configurations(&tables)?;
    if !configurations.is_empty() {
        text += &format!("\n## Configurations\n{configurations}");
    }
    files::write(&to.join("report.md"), text.as_bytes())?;
    files::write(&to.join("report.html"), page::page(&text, to)?.as_bytes())?;
    Ok(tuning_note(&tables)?.to_string() + &text_table(&rows(&tables)?))
}

/// What stands above the numbers of runs that served to choose settings.
fn tuning_note(tables: &Tables) -> Result<&'static str> {
    Ok(match tables.starts()? {
        Starts::Test => "",
        Starts::Development => {
            "Tuning runs: everything here was measured on development starts. Choose settings by it, but report the results \
             of runs on the test's starts.\n\n"
        }
    })
}

const HEAD: [&str; 10] =
    ["task", "method", "seeds", "steps", "success", "return", "80 % by step", "ms per action", "SPARC", "LDLJ"];

fn rows(tables: &Tables) -> Result<Vec<[String; 10]>> {
    let mut rows = Vec::new();
    for (task, method) in tables.tasks_and_methods()? {
        let value = |column: &str| tables.value(&task, &method, column);
        let show = |column: &str, digits: usize| -> Result<String> {
            Ok(match value(column)? {
                None => "-".into(),
                Some(v) if v.abs() >= 1e9 => format!("{v:.2e}"),
                Some(v) => format!("{v:.digits$}"),
            })
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
            match (value("steps_to_80")?, value("seconds_to_80")?) {
                (Some(steps), Some(seconds)) => format!("{steps:.0} ({seconds:.0} s)"),
                (Some(steps), None) => format!("{steps:.0}"),
                (None, _) => "-".into(),
            },
            show("action_ms", 2)?,
            show("smoothness_sparc", 2)?,
            show("smoothness_ldlj", 2)?,
        ]);
    }
    Ok(rows)
}

fn markdown(rows: &[[String; 10]]) -> String {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let head = line(&HEAD.map(String::from));
    let rule = format!("|{}\n", " --- |".repeat(HEAD.len()));
    head + &rule + &rows.iter().map(|row| line(row)).collect::<String>()
}

fn text_table(rows: &[[String; 10]]) -> String {
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
        let (success, level) = (100.0 * value("success")?.unwrap_or(0.0), 100.0 * LEVEL);
        let (Some(budget), Some(reaching), Some(seeds)) =
            (value("steps")?, value("seeds_reaching_80")?, value("seeds")?)
        else {
            text += &format!("- `{method}` does not learn; it succeeds in {success:.0} % of the test episodes.\n");
            continue;
        };
        text += &match value("steps_to_80")? {
            Some(steps) => format!(
                "- `{method}` reaches {level:.0} % success by step {steps:.0} (median; {reaching:.0} of {seeds:.0} seeds \
                 reach it within {budget:.0}) and ends at {success:.0} %"
            ),
            None => format!(
                "- `{method}` does not reach {level:.0} % success in its median seed within {budget:.0} steps \
                 ({reaching:.0} of {seeds:.0} seeds do); it ends at {success:.0} %"
            ),
        };
        text += &match (value("success_t_low")?, value("success_t_high")?) {
            (Some(low), Some(high)) => {
                format!(" (t interval over its {seeds:.0} seeds: [{:.0}, {:.0}]).", 100.0 * low, 100.0 * high)
            }
            _ if seeds < 2.0 => {
                " (one seed: the interval covers its test episodes, not what another seed would bring).".into()
            }
            _ => ".".into(),
        };
        text += &against_the_baseline(tables, task, &method)?;
        text.push('\n');
    }
    Ok(text)
}

/// The numbers of the methods that learn a task which the first table has no room for.
fn details(tables: &Tables, task: &str) -> Result<String> {
    let mut rows = String::new();
    for (_, method) in tables.tasks_and_methods()?.into_iter().filter(|(of, _)| of == task) {
        let value = |column: &str| tables.value(task, &method, column);
        if value("steps")?.is_none() {
            continue;
        }
        let show = |column: &str, text: fn(f64) -> String| value(column).map(|found| found.map_or("-".into(), text));
        let beside = |column: &str| -> Result<String> {
            let [low, high] = [value(&format!("{column}_low"))?, value(&format!("{column}_high"))?];
            Ok(match (value(column)?, low, high) {
                (Some(p), Some(low), Some(high)) => format!("{p:.2} [{low:.2}, {high:.2}]"),
                _ => "-".into(),
            })
        };
        rows += &format!(
            "| {method} | {} | {} | {} | {} | {} | {} | {} |\n",
            show("area_under_curve", |area| format!("{area:.2}"))?,
            show("updates", |updates| format!("{updates:.0}"))?,
            show("action_change", |change| format!("{change:.2}"))?,
            show("optimism", |share| format!("{:+.0} %", 100.0 * share))?,
            show("return_correlation", |correlation| format!("{correlation:.2}"))?,
            beside("improvement_over_sac")?,
            beside("earlier_than_sac")?,
        );
    }
    if rows.is_empty() {
        return Ok(rows);
    }
    Ok(format!(
        "\n| method | area under the curve | gradient updates | action change | optimism | correlation | better than `{BASELINE}` | earlier than `{BASELINE}` |\n\
         |{}\n{rows}",
        " --- |".repeat(8)
    ))
}

/// The comparison of a method with [`BASELINE`], if both learn the task.
fn against_the_baseline(tables: &Tables, task: &str, method: &str) -> Result<String> {
    let value = |column: &str| tables.value(task, method, column);
    let ends =
        |column: &str| -> Result<_> { Ok((value(&format!("{column}_low"))?, value(&format!("{column}_high"))?)) };
    let (Some(difference), (Some(low), Some(high))) = (value("success_minus_sac")?, ends("success_minus_sac")?) else {
        return Ok(String::new());
    };
    let mut text = if low < high {
        let [difference, low, high] = [difference, low, high].map(|share| 100.0 * share);
        format!(
            " Success from the same test starts, minus that of `{BASELINE}`: {difference:+.0} percentage points [{low:+.0}, {high:+.0}]."
        )
    } else {
        format!(" From the same test starts, its episodes and those of `{BASELINE}` show no spread to compare.")
    };
    let level = 100.0 * LEVEL;
    match (value("sac_steps_ratio")?, ends("sac_steps_ratio")?) {
        (Some(ratio), (Some(low), Some(high))) => {
            text += &format!(
                " To {level:.0} % success `{BASELINE}` takes {ratio:.1} times as many steps [{low:.1}, {high:.1}]."
            );
        }
        (Some(ratio), (Some(low), None)) => {
            text += &format!(
                " To {level:.0} % success `{BASELINE}` takes at least {ratio:.1} times as many steps (its censored seeds \
                 count as its budget; 95 % interval from {low:.1})."
            );
        }
        _ => {}
    }
    Ok(text)
}

/// A warning if the methods that learn a task were not all evaluated at the same steps with the same number of episodes.
fn different_grids(tables: &Tables, task: &str) -> Result<String> {
    let mut grids: Vec<(String, Vec<Curve>)> = Vec::new();
    for (_, method) in tables.tasks_and_methods()?.into_iter().filter(|(of, _)| of == task) {
        grids.push((method.clone(), tables.evaluation_grid(task, &method)?));
    }
    grids.retain(|(_, seeds)| !seeds.is_empty());
    let mut seeds = grids.iter().flat_map(|(_, seeds)| seeds);
    let Some(common) = seeds.clone().filter_map(|(steps, _)| steps.last().copied()).reduce(f64::min) else {
        return Ok(String::new());
    };
    // Budgets may differ: what counts is the part that all have in common.
    let until = |(steps, episodes): &Curve| -> Vec<(f64, f64)> {
        steps.iter().copied().zip(episodes.iter().copied()).take_while(|(step, _)| *step <= common).collect()
    };
    let first = seeds.next().map(until);
    if seeds.all(|seed| Some(until(seed)) == first) {
        return Ok(String::new());
    }
    let one = |(method, seeds): &(String, Vec<Curve>)| {
        let (steps, episodes) = &seeds[0];
        let every = steps.get(1).unwrap_or(&0.0) - steps[0];
        format!("`{method}` every {every:.0} steps with {:.0} episodes", episodes[0])
    };
    Ok(format!(
        "\n**Not evaluated alike:** {}. A coarser grid reports a later step, and fewer episodes a noisier one.\n",
        grids.iter().map(one).collect::<Vec<_>>().join(", ")
    ))
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
            "Not very: a learning method has only {n:.0} seed{} here, too few for an interval over seeds to be trusted. Run \
             `handful study --seeds 5` (or `--profile full`) before you conclude anything.\n",
            if n == 1.0 { "" } else { "s" }
        ),
        n => format!(
            "Each learning method has at least {n:.0} seeds. With five, a bootstrap interval that should cover the truth in 95 % \
             of cases covers it in about 90; the t interval over seeds is the safer one.\n"
        ),
    })
}
