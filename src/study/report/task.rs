//! What a report says about one task.

use std::path::Path;

use super::super::figures;
use super::super::replays::{self, Replay};
use super::super::statistics::falls_below_again;
use super::super::tables::{BASELINE, Curve, LEVEL, Tables};
use super::model;
use crate::error::Result;

/// The findings, tables and figures of a task, whose methods may have been evaluated on grids that differ. The figures are
/// written into the folder `to`.
///
/// # Errors
/// If the tables lack a column or a file cannot be written.
pub(super) fn section(tables: &Tables, task: &str, differ: bool, replays: &[Replay], to: &Path) -> Result<String> {
    let by_return = tables.is_judged_by_return(task)?;
    let mut text =
        format!("\n## {task}\n\n{}{}", findings(tables, task, by_return)?, evaluations(tables, task, differ)?);
    text += &details(tables, task)?;
    let mut figure = |file: String, caption: &str| text += &format!("\n![{caption}]({file})\n");
    let file = format!("{task}-learning.svg");
    if figures::learning_curves(tables, task, &to.join(&file))? {
        let what = if by_return { "Return (no evaluation succeeds)" } else { "Success rate" };
        figure(
            file,
            &format!(
                "{what} over environment steps, a panel for each method: thin lines are seeds, the thick line is their mean; \
                 grey lines are the means of the other methods"
            ),
        );
    }
    let file = format!("{task}-profile.svg");
    if figures::profile(tables, task, &to.join(&file))? {
        let caption = "Performance profile (the share of seeds whose success rate in the test exceeds a threshold), and the success rate of each seed \
                       over the seconds of its run";
        figure(file, caption);
    }
    let file = format!("{task}-test.svg");
    figures::tests(tables, task, &to.join(&file))?;
    figure(
        file,
        "The test: success rate and smoothness of the hand, of each seed (small dots), and their mean with its 95 % interval",
    );
    text += &replays::table(replays, task, &tables.methods(task)?);
    text += &model::table(tables, task)?;
    for method in tables.methods(task)? {
        text += &diagnostics(tables, task, &method, to)?;
    }
    Ok(text)
}

/// The figures about a method's model and values, folded, where a page can.
fn diagnostics(tables: &Tables, task: &str, method: &str, to: &Path) -> Result<String> {
    let mut text = String::new();
    let stem = figures::stem(task, method);
    let file = format!("{stem}-model.svg");
    if figures::model(tables, task, method, &to.join(&file))? {
        let covered = !tables.model_curves(task, method, 1, "coverage90")?.is_empty();
        let coverage = if covered { ", and the coverage of its 90 % interval" } else { "" };
        text += &format!(
            "![Open-loop prediction error of the model of {method} on the method's own evaluation episodes (thin: each seed), in \
             standard deviations of the change (root mean square over features, median over start times){coverage}]({file})\n\n"
        );
    }
    let file = format!("{stem}-values.svg");
    if figures::values(tables, task, method, &to.join(&file))? {
        text +=
            &format!("![Return that {method} expected, and the return that followed (thin: each seed)]({file})\n\n");
    }
    let left_out = tables.left_out(task, method)?;
    if left_out > 0 {
        text += &format!("Not drawn, because not finite: {left_out} of the numbers about `{method}`.\n\n");
    }
    if text.is_empty() {
        return Ok(text);
    }
    Ok(format!("\n<details><summary>Model and values of <code>{method}</code></summary>\n\n{text}</details>\n"))
}

/// The results of a task in words: the returns of methods that learn it, if no evaluation succeeds, and success rates otherwise.
fn findings(tables: &Tables, task: &str, by_return: bool) -> Result<String> {
    let mut text = String::new();
    for method in tables.methods(task)? {
        let value = |column: &str| tables.value(task, &method, column);
        if by_return && value("steps")?.is_some() {
            text += &of_return(tables, task, &method)?;
            continue;
        }
        let (success, level) = (100.0 * value("success")?.unwrap_or(0.0), 100.0 * LEVEL);
        let (Some(budget), Some(reaching), Some(seeds)) =
            (value("steps")?, value("seeds_reaching_80")?, value("seeds")?)
        else {
            let episodes = value("test_episodes")?.unwrap_or(0.0);
            text += &format!(
                "- `{method}` does not learn; it succeeds in {success:.0} % of {episodes:.0} test episodes.\n"
            );
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
        text += &match interval(tables, task, &method, "success_t")? {
            (Some(low), Some(high)) => {
                format!(" (t interval over its {seeds:.0} seeds: [{:.0}, {:.0}])", 100.0 * low, 100.0 * high)
            }
            _ if seeds < 2.0 => {
                " (one seed: the interval covers its test episodes, not what another seed would bring)".into()
            }
            _ => String::new(),
        };
        let curves = tables.curves(task, &method)?;
        text += &match curves.iter().filter(|(steps, success)| falls_below_again(LEVEL, steps, success)).count() {
            0 => ".".into(),
            1 => format!("; 1 seed is below {level:.0} % again at a later evaluation."),
            n => format!("; {n} seeds are below {level:.0} % again at a later evaluation."),
        };
        text += &against_the_baseline(tables, task, &method)?;
        text.push('\n');
    }
    Ok(text)
}

/// The returns of a method in words, on a task where no evaluation succeeds.
fn of_return(tables: &Tables, task: &str, method: &str) -> Result<String> {
    let value = |column: &str| tables.value(task, method, column);
    let Some(mean) = value("return_mean")? else { return Ok(String::new()) };
    let student = match interval(tables, task, method, "return_t")? {
        (Some(low), Some(high)) => format!(" (t interval [{low:.1}, {high:.1}])"),
        _ => String::new(),
    };
    let success = match 100.0 * value("success")?.unwrap_or(0.0) {
        0.0 => String::new(),
        success => format!(", and succeeds in {success:.0} % of the test episodes"),
    };
    let measure = ("Return", "return_minus_sac", "");
    let difference = difference(tables, task, method, measure, signed)?;
    Ok(format!("- `{method}` has a mean test return of {mean:.1}{student}{success}.{difference}\n"))
}

/// The numbers of the methods that learn a task which the first table has no room for.
fn details(tables: &Tables, task: &str) -> Result<String> {
    let (mut rows, mut common) = (String::new(), None);
    for method in tables.methods(task)? {
        let value = |column: &str| tables.value(task, &method, column);
        if value("steps")?.is_none() {
            continue;
        }
        let show = |column: &str, text: fn(f64) -> String| value(column).map(|found| found.map_or("-".into(), text));
        let with_interval = |column: &str, kind: &str| -> Result<String> {
            Ok(match (value(column)?, interval(tables, task, &method, &format!("{column}{kind}"))?) {
                // Where all seeds, or all resamples, agree, there is no interval.
                (Some(x), (Some(low), Some(high))) if low < high => format!("{x:.2} [{low:.2}, {high:.2}]"),
                (Some(x), _) => format!("{x:.2}"),
                _ => "-".into(),
            })
        };
        rows += &format!(
            "| {method} | {} | {} | {} | {} | {} | {} | {} | {} |\n",
            with_interval("area_under_curve", "_t")?,
            show("updates", |updates| format!("{updates:.0}"))?,
            show("action_change", |change| format!("{change:.2}"))?,
            show("optimism", |share| format!("{:+.0} %", (100.0 * share).round() + 0.0))?,
            show("return_correlation", |correlation| format!("{correlation:.2}"))?,
            with_interval("return_minus_sac", "_t")?,
            with_interval("improvement_over_sac", "")?,
            with_interval("earlier_than_sac", "")?,
        );
        common = value("common_budget")?.or(common);
    }
    if rows.is_empty() {
        return Ok(rows);
    }
    Ok(format!(
        "\n| method | area under the curve{} | gradient updates | action change | optimism | correlation | return minus `{BASELINE}`'s | \
         better than `{BASELINE}` | earlier than `{BASELINE}` |\n|{}\n{rows}",
        common.map_or(String::new(), |steps| format!(" to step {steps:.0}")),
        " --- |".repeat(9)
    ))
}

/// The comparison of a method with [`BASELINE`], if both learn the task.
fn against_the_baseline(tables: &Tables, task: &str, method: &str) -> Result<String> {
    let value = |column: &str| tables.value(task, method, column);
    let measure = ("Success", "success_minus_sac", " percentage points");
    let mut text = difference(tables, task, method, measure, |share| signed(100.0 * share))?;
    let level = 100.0 * LEVEL;
    match (value("sac_steps_ratio")?, interval(tables, task, method, "sac_steps_ratio")?) {
        (Some(ratio), (Some(low), Some(high))) => {
            text += &format!(
                " To {level:.0} % success `{BASELINE}` takes {ratio:.2} times as many steps on average [{low:.2}, {high:.2}]{}.",
                match interval(tables, task, method, "sac_steps_ratio_t")? {
                    (Some(low), Some(high)) => format!(", t interval [{low:.2}, {high:.2}]"),
                    _ => String::new(),
                }
            );
        }
        (Some(ratio), (Some(low), None)) => {
            text += &format!(
                " To {level:.0} % success `{BASELINE}` takes at least {ratio:.2} times as many steps on average (its censored seeds \
                 count as its budget; 95 % interval from {low:.2}).",
            );
        }
        _ => {}
    }
    Ok(text)
}

/// The difference between a method and [`BASELINE`] in a measure of the test, with its intervals; nothing if one of them does not learn
/// the task.
fn difference(
    tables: &Tables,
    task: &str,
    method: &str,
    (measure, column, unit): (&str, &str, &str),
    text: impl Fn(f64) -> String,
) -> Result<String> {
    let difference = tables.value(task, method, column)?;
    let (Some(difference), (Some(low), Some(high))) = (difference, interval(tables, task, method, column)?) else {
        return Ok(String::new());
    };
    let [value, from, to] = [difference, low, high].map(&text);
    let intervals = match interval(tables, task, method, &format!("{column}_t"))? {
        _ if low >= high => ", without an interval: resampling shows no spread".into(),
        (Some(low), Some(high)) => format!(" [{from}, {to}], t interval [{}, {}]", text(low), text(high)),
        _ => format!(" [{from}, {to}]"),
    };
    let budgets = match (tables.value(task, method, "steps")?, tables.value(task, BASELINE, "steps")?) {
        (Some(steps), Some(baseline)) if steps != baseline => {
            format!(" (after {steps:.0} steps; `{BASELINE}` after {baseline:.0})")
        }
        _ => String::new(),
    };
    Ok(format!(" {measure} from the same test starts{budgets}, minus that of `{BASELINE}`: {value}{unit}{intervals}."))
}

/// A number with its sign and one decimal; zero is positive.
fn signed(x: f64) -> String {
    format!("{:+.1}", (10.0 * x).round() / 10.0 + 0.0)
}

/// The ends of an interval, as far as there are any.
fn interval(tables: &Tables, task: &str, method: &str, column: &str) -> Result<(Option<f64>, Option<f64>)> {
    let end = |name: &str| tables.value(task, method, &format!("{column}_{name}"));
    Ok((end("low")?, end("high")?))
}

/// How often the methods that learn a task were evaluated; a warning if not all alike.
fn evaluations(tables: &Tables, task: &str, differ: bool) -> Result<String> {
    let grids = grids(tables, task)?;
    let one = |seeds: &[Curve]| {
        let (steps, episodes) = &seeds[0];
        let every = steps.get(1).unwrap_or(&0.0) - steps[0];
        format!("every {every:.0} steps with {:.0} episodes", episodes[0])
    };
    let Some((_, first)) = grids.first() else { return Ok(String::new()) };
    if !differ {
        return Ok(format!(
            "\nEvaluations: {}, always from the same starts. The step of {:.0} % success is rounded up to these steps, which the intervals \
             do not include; with so few episodes, it may also be several evaluations too late or too early.\n",
            one(first),
            100.0 * LEVEL
        ));
    }
    let each: Vec<String> = grids.iter().map(|(method, seeds)| format!("`{method}` {}", one(seeds))).collect();
    Ok(format!(
        "\n**Not evaluated alike:** {}. A coarser grid reports a later step, and fewer episodes a noisier one.\n",
        each.join(", ")
    ))
}

/// Whether the methods that learn a task were not all evaluated at the same steps with the same number of episodes.
///
/// # Errors
/// If the evaluations lack a column.
pub(super) fn grids_differ(tables: &Tables, task: &str) -> Result<bool> {
    let grids = grids(tables, task)?;
    let mut seeds = grids.iter().flat_map(|(_, seeds)| seeds);
    let Some(common) = seeds.clone().filter_map(|(steps, _)| steps.last().copied()).reduce(f64::min) else {
        return Ok(false);
    };
    // Budgets may differ: what counts is the part that all have in common.
    let until = |(steps, episodes): &Curve| -> Vec<(f64, f64)> {
        steps.iter().copied().zip(episodes.iter().copied()).take_while(|(step, _)| *step <= common).collect()
    };
    let first = seeds.next().map(until);
    Ok(!seeds.all(|seed| Some(until(seed)) == first))
}

/// Of each method that learns a task, the steps and numbers of episodes of each seed's evaluations.
fn grids(tables: &Tables, task: &str) -> Result<Vec<(String, Vec<Curve>)>> {
    let mut grids: Vec<(String, Vec<Curve>)> = Vec::new();
    for method in tables.methods(task)? {
        grids.push((method.clone(), tables.evaluation_grid(task, &method)?));
    }
    grids.retain(|(_, seeds)| !seeds.is_empty());
    Ok(grids)
}
