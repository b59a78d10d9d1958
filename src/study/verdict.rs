//! What a study shows, in a few sentences at the head of its report.

use std::collections::BTreeMap;

use super::tables::{BASELINE, LEVEL, Tables};
use crate::error::Result;

/// For each task, which methods are better than the baseline and which are not, as far as intervals tell.
///
/// # Errors
/// If the summary lacks a column.
pub(super) fn verdict(tables: &Tables, tasks: &[&str]) -> Result<String> {
    let mut text = String::new();
    for task in tasks {
        text += &on_task(tables, task)?;
    }
    if text.contains("ignificant") {
        text += &format!(
            "\nA difference is called significant if both methods have at least {SEEDS:.0} seeds and neither the 95 % bootstrap interval nor \
             the 95 % t interval includes equality. If `{BASELINE}` has censored seeds, the ratio of steps has no t interval, and the \
             bootstrap interval decides alone. Nothing is corrected for the number of comparisons. In parentheses, \
             for steps: how many times as many steps `{BASELINE}` needs on average; otherwise the method's mean minus that of `{BASELINE}`. In \
             brackets: the smallest interval that contains both intervals.\n"
        );
    }
    Ok(text)
}

fn on_task(tables: &Tables, task: &str) -> Result<String> {
    let methods = tables.methods(task)?;
    let mut learning = Vec::new();
    for method in &methods {
        if tables.value(task, method, "steps")?.is_some() {
            learning.push(method.as_str());
        }
    }
    if learning.is_empty() {
        return Ok(String::new());
    }
    let mut points = vec![first_at_the_level(tables, task, &learning)?];
    if learning.contains(&BASELINE) {
        points.extend(beside_the_baseline(tables, task, &learning)?);
    }
    points.extend(smoothness(tables, task, &methods)?);
    let points: Vec<String> = points.iter().map(|point| format!("  - {point}\n")).collect();
    Ok(format!("- **{task}**\n{}", points.concat()))
}

/// Which methods have the smallest median of steps to the level, and which of those that are not given a reward function.
fn first_at_the_level(tables: &Tables, task: &str, learning: &[&str]) -> Result<String> {
    let mut medians: Vec<(f64, &str)> = Vec::new();
    for method in learning {
        medians.extend(tables.value(task, method, "steps_to_80")?.map(|steps| (steps, *method)));
    }
    let level = 100.0 * LEVEL;
    let Some((steps, first)) = earliest(&medians) else {
        return Ok(format!("no method reaches {level:.0} % success in its median seed."));
    };
    let (mut informed, mut uninformed) = (Vec::new(), Vec::new());
    for method in learning {
        match tables.is_told_the_reward(task, method)? {
            Some(true) => informed.push(*method),
            Some(false) => uninformed.push(*method),
            None => {}
        }
    }
    let mut text = format!("{} the earliest to reach {level:.0} % success, by step {steps:.0} (median).", are(&first));
    let told: Vec<&str> = first.iter().copied().filter(|method| informed.contains(method)).collect();
    if told.is_empty() {
        return Ok(text);
    }
    text += &format!(" {} given a reward function", are(&told));
    medians.retain(|(_, method)| uninformed.contains(method));
    let known = informed.len() + uninformed.len() == learning.len();
    let others = if known { "the methods that are not" } else { "those that are known not to be" };
    text += &match earliest(&medians) {
        _ if told.len() < first.len() || uninformed.is_empty() => ".".into(),
        Some((steps, first)) => {
            format!("; of {others}, {} the earliest, by step {steps:.0}.", are(&first))
        }
        None => format!("; of {others}, none reaches {level:.0} % in its median seed."),
    };
    Ok(text)
}

/// The smallest of these times, and the methods that have it.
fn earliest<'a>(times: &[(f64, &'a str)]) -> Option<(f64, Vec<&'a str>)> {
    let smallest = times.iter().map(|(time, _)| *time).min_by(f64::total_cmp)?;
    Some((smallest, times.iter().filter(|(time, _)| *time == smallest).map(|(_, method)| *method).collect()))
}

/// "`a` is", or "`a`, `b` and `c` are".
fn are(methods: &[&str]) -> String {
    let names: Vec<String> = methods.iter().map(|method| format!("`{method}`")).collect();
    format!("{} {}", listed(&names), if names.len() == 1 { "is" } else { "are" })
}

/// "a", "a and b", or "a, b and c".
pub(super) fn listed(names: &[String]) -> String {
    match names.split_last() {
        Some((last, [])) => last.clone(),
        Some((last, others)) => format!("{} and {last}", others.join(", ")),
        None => String::new(),
    }
}

/// The fewest seeds of each method with which an exact rank test can show a difference: with four each, its smallest p is 0.029; with
/// three, 0.10.
const SEEDS: f64 = 4.0;

/// A comparison with the baseline, by an interval of a column of the summary.
struct Comparison {
    column: &'static str,
    /// The value that means no difference.
    equal: f64,
    measure: String,
    /// How much of the measure a method has whose interval lies above that value.
    above: &'static str,
    /// The same, below it.
    below: &'static str,
    /// How a value is written, and in what unit.
    text: fn(f64) -> String,
    unit: &'static str,
}

/// How the other methods compare with the baseline. An interval is the wider of the bootstrap's and Student's at either end.
fn beside_the_baseline(tables: &Tables, task: &str, learning: &[&str]) -> Result<Vec<String>> {
    let mut points = Vec::new();
    let level = 100.0 * LEVEL;
    let comparisons = if tables.is_judged_by_return(task)? {
        let measure = "test returns".into();
        let text = |x: f64| format!("{:+.1}", (10.0 * x).round() / 10.0 + 0.0);
        vec![Comparison {
            column: "return_minus_sac",
            equal: 0.0,
            measure,
            above: "higher",
            below: "lower",
            text,
            unit: "",
        }]
    } else {
        let steps = format!("steps to {level:.0} %");
        let success = "test success".into();
        let times = |x| format!("{x:.1}");
        let points = |x: f64| format!("{:+.0}", (100.0 * x).round() + 0.0);
        vec![
            Comparison {
                column: "sac_steps_ratio",
                equal: 1.0,
                measure: steps,
                above: "fewer",
                below: "more",
                text: times,
                unit: "",
            },
            Comparison {
                column: "success_minus_sac",
                equal: 0.0,
                measure: success,
                above: "more",
                below: "less",
                text: points,
                unit: " percentage points",
            },
        ]
    };
    for Comparison { column, equal, measure, above, below, text, unit } in comparisons {
        let [better, worse] = [above, below].map(|amount| format!("Significantly {amount} {measure} than"));
        let open = format!("No significant difference in {measure} from");
        let late = format!("Not every seed reaches {level:.0} % within its budget, so there is no ratio of steps to");
        let at_once = format!("Some seeds are at {level:.0} % at step 0, so there is no ratio of steps to");
        let few = format!("Fewer than {SEEDS:.0} seeds of one of the two, too few to compare {measure} with");
        let mut groups = [better, worse, open, late, at_once, few].map(|what| (what, Vec::new()));
        let count = |method, of| tables.value(task, method, of).map(|seeds| seeds.unwrap_or(0.0));
        for method in learning.iter().filter(|method| **method != BASELINE) {
            let end = |which: &str, of: fn(f64, f64) -> f64| -> Result<Option<f64>> {
                let bootstrap = tables.value(task, method, &format!("{column}_{which}"))?;
                let student = tables.value(task, method, &format!("{column}_t_{which}"))?;
                Ok(bootstrap.map(|end| student.map_or(end, |other| of(end, other))))
            };
            let ends = (end("low", f64::min)?, end("high", f64::max)?);
            let group = match ends {
                (None, None) if count(method, "seeds_reaching_80")? < count(method, "seeds")? => 3,
                (None, None) => 4,
                _ if count(method, "seeds")?.min(count(BASELINE, "seeds")?) < SEEDS => 5,
                (Some(low), _) if low > equal => 0,
                (_, Some(high)) if high < equal => 1,
                _ => 2,
            };
            let value = tables.value(task, method, column)?.map(text);
            groups[group].1.push(match (group, value, ends) {
                (0..=2, Some(value), (Some(low), Some(high))) => {
                    format!("`{method}` ({value} [{}, {}]{unit})", text(low), text(high))
                }
                (0..=2, Some(value), (Some(low), None)) => {
                    format!("`{method}` (at least {value}, interval from {}{unit})", text(low))
                }
                _ => format!("`{method}`"),
            });
        }
        let found = groups.into_iter().filter(|(_, methods)| !methods.is_empty());
        let mut sentences: Vec<String> =
            found.map(|(what, methods)| format!("{what} `{BASELINE}`: {}.", methods.join(", "))).collect();
        if sentences.is_empty() {
            continue;
        }
        if column != "sac_steps_ratio" && budgets(tables, task)?.len() > 1 {
            sentences.push("Not all methods have the same budget (see the checklist).".into());
        }
        points.push(sentences.join(" "));
    }
    Ok(points)
}

/// The budgets, in steps, of the methods that learn a task, and the methods that have each.
///
/// # Errors
/// If the summary lacks a column.
pub(super) fn budgets(tables: &Tables, task: &str) -> Result<BTreeMap<u64, Vec<String>>> {
    let mut budgets: BTreeMap<u64, Vec<String>> = BTreeMap::new();
    for method in tables.methods(task)? {
        if let Some(steps) = tables.value(task, &method, "steps")? {
            budgets.entry(steps as u64).or_default().push(format!("`{method}`"));
        }
    }
    Ok(budgets)
}

/// The methods in the order of their smoothness.
fn smoothness(tables: &Tables, task: &str, methods: &[String]) -> Result<Option<String>> {
    let mut known: Vec<(f64, &str, String)> = Vec::new();
    for method in methods {
        let ldlj = tables.value(task, method, "smoothness_ldlj")?;
        let ldlj = ldlj.map_or(String::new(), |ldlj| format!(" ({ldlj:.1})"));
        known.extend(tables.value(task, method, "smoothness_sparc")?.map(|sparc| (sparc, method.as_str(), ldlj)));
    }
    if known.len() < 2 {
        return Ok(None);
    }
    known.sort_by(|a, b| b.0.total_cmp(&a.0));
    let known: Vec<String> = known.iter().map(|(sparc, method, ldlj)| format!("`{method}` {sparc:.2}{ldlj}")).collect();
    let seeds = |method: &str| tables.value(task, method, "seeds").map(|seeds| seeds.unwrap_or(0.0));
    let mut differences = Vec::new();
    for method in methods {
        let value = |end: &str| tables.value(task, method, &format!("sparc_minus_sac{end}"));
        let ends = (value("")?, value("_t_low")?, value("_t_high")?);
        if let (Some(difference), Some(low), Some(high)) = ends
            && seeds(method)?.min(seeds(BASELINE)?) >= SEEDS
        {
            differences.push(format!("`{method}` {difference:+.2} [{low:+.2}, {high:+.2}]"));
        }
    }
    let differences = match differences.as_slice() {
        [] => String::new(),
        _ => format!(
            " SPARC minus that of `{BASELINE}`, with t intervals that are not corrected for their number: {}.",
            differences.join(", ")
        ),
    };
    Ok(Some(format!(
        "Smoothness of the hand's path in the test (SPARC, the smoothest first, and in brackets the log dimensionless jerk, which may order \
         the methods differently): {}.{differences}",
        known.join(", ")
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_that_are_equally_early_are_all_first() {
        let (steps, first) = earliest(&[(500.0, "a"), (250.0, "b"), (250.0, "c")]).expect("three times");
        assert_eq!((steps, are(&first)), (250.0, "`b` and `c` are".into()));
        assert_eq!(are(&["a", "b", "c"]), "`a`, `b` and `c` are");
        assert_eq!((are(&["a"]), earliest(&[])), ("`a` is".into(), None));
    }
}
