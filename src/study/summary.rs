//! The summary of a study: one row per task and method, computed from the evaluations and tests of its runs.

use polars::prelude::*;

use super::statistics::{
    IQM_RUNS, Time, area_under_curve, bootstrap, censored_median, interquartile_mean, mean, paired_difference,
    probability_of_being_earlier, probability_of_improvement, ratio_of_means, ratio_t_interval, restricted_mean,
    steps_to, t_interval, two_level_bootstrap, welch_interval, wilson,
};
use super::tables::{BASELINE, Curve, LEVEL, by_run, lists, numbers, of, optional_curves, strings};
use crate::rng::{self, Rng};

/// The runs of one method on one task.
struct Runs {
    task: String,
    method: String,
    /// For each seed, whether each test episode succeeded, in the order of the starts.
    success: Vec<Vec<f64>>,
    /// For each seed, the return of each test episode, in the same order.
    returns: Vec<Vec<f64>>,
    /// For each seed, the success curve; empty if the method does not learn.
    curves: Vec<Curve>,
    /// For each seed, the seconds of training until each evaluation; empty if the tables do not have them.
    clocks: Vec<Curve>,
    /// For each seed, the milliseconds that an action takes in each evaluation; the same.
    action_ms: Vec<Curve>,
    /// For each seed, the gradient steps until each evaluation; the same.
    updates: Vec<Curve>,
    /// For each seed, the expected return in its last evaluation, the one that followed, and the correlation of the two: NaN where one is
    /// not a number.
    expectations: [Vec<f64>; 3],
    /// For each seed, the mean SPARC of its test episodes (NaN if none has one); empty if the tables do not tell it.
    sparc: Vec<f64>,
    /// Columns of the test whose mean is taken over all episodes.
    means: Vec<(&'static str, Option<f64>)>,
}

/// One row per task and method, in the order in which they were run.
pub(super) fn summarise(evaluations: &DataFrame, values: &DataFrame, tests: &DataFrame) -> PolarsResult<DataFrame> {
    let measures = ["success", "return", "length", "sparc", "ldlj", "action_change"];
    let there: Vec<&str> = measures.into_iter().filter(|name| tests.column(name).is_ok()).collect();
    let tests = by_run(tests.clone().lazy(), &there)?;
    let pairs = tests.clone().lazy().select([col("task"), col("method")]);
    let pairs = pairs.unique_stable(None, UniqueKeepStrategy::First).collect()?;
    let mut all = Vec::new();
    for (task, method) in strings(&pairs, "task")?.into_iter().zip(strings(&pairs, "method")?) {
        let rows = of(&tests, &task, &method)?;
        let mut means = Vec::new();
        for (column, name) in [
            ("return", "return_mean"),
            ("length", "length_mean"),
            ("sparc", "smoothness_sparc"),
            ("ldlj", "smoothness_ldlj"),
            ("action_change", "action_change"),
        ] {
            if !there.contains(&column) {
                continue;
            }
            let known: Vec<f64> = lists(&rows, column)?.concat().into_iter().filter(|x| x.is_finite()).collect();
            means.push((name, (!known.is_empty()).then(|| mean(&known))));
        }
        let success = lists(&rows, "success")?;
        let returns = lists(&rows, "return")?;
        let sparc = if there.contains(&"sparc") { self::means(&lists(&rows, "sparc")?) } else { Vec::new() };
        let over_steps = |column: &str| optional_curves(evaluations, &task, &method, column);
        let [curves, clocks] = [over_steps("success")?, over_steps("seconds")?];
        let [action_ms, updates] = [over_steps("action_ms")?, over_steps("updates")?];
        let at_the_end = last_rows(&of(values, &task, &method)?)?;
        let of_values = |column: &str| -> PolarsResult<Vec<f64>> {
            if at_the_end.width() == 0 {
                return Ok(Vec::new());
            }
            Ok(numbers(&at_the_end, column)?.into_iter().map(|number| number.unwrap_or(f64::NAN)).collect())
        };
        let expectations = [of_values("expected")?, of_values("realised")?, of_values("correlation")?];
        all.push(Runs {
            task,
            method,
            success,
            returns,
            curves,
            clocks,
            action_ms,
            updates,
            expectations,
            sparc,
            means,
        });
    }
    let names = |of: fn(&Runs) -> &String| all.iter().map(|runs| of(runs).clone()).collect::<Vec<String>>();
    let mut columns =
        vec![Column::new("task".into(), names(|r| &r.task)), Column::new("method".into(), names(|r| &r.method))];
    let rows: Vec<Vec<(&str, Option<f64>)>> = all.iter().map(|runs| runs.row(&all)).collect();
    for name in SUMMARY {
        // What cannot be computed from these numbers is an empty entry.
        let entry = |row: &Vec<(&str, Option<f64>)>| {
            let found = row.iter().find(|(known, _)| *known == name);
            found.and_then(|(_, value)| *value).filter(|value| value.is_finite())
        };
        columns.push(Column::new(name.into(), rows.iter().map(entry).collect::<Vec<Option<f64>>>()));
    }
    DataFrame::new_infer_height(columns)
}

/// The columns after task and method. Scripts read them by name: new ones are added at the end, none is removed.
const SUMMARY: [&str; 56] = [
    "seeds",
    "steps",
    "test_episodes",
    "success",
    "success_low",
    "success_high",
    "success_iqm",
    "success_iqm_low",
    "success_iqm_high",
    "return_mean",
    "length_mean",
    "steps_to_80",
    "seeds_reaching_80",
    "area_under_curve",
    "smoothness_sparc",
    "smoothness_ldlj",
    "success_t_low",
    "success_t_high",
    "steps_to_80_restricted_mean",
    "common_budget",
    "success_minus_sac",
    "success_minus_sac_low",
    "success_minus_sac_high",
    "sac_steps_ratio",
    "sac_steps_ratio_low",
    "sac_steps_ratio_high",
    "seconds_to_80",
    "action_ms",
    "updates",
    "action_change",
    "optimism",
    "return_correlation",
    "improvement_over_sac",
    "improvement_over_sac_low",
    "improvement_over_sac_high",
    "earlier_than_sac",
    "earlier_than_sac_low",
    "earlier_than_sac_high",
    "area_under_curve_t_low",
    "area_under_curve_t_high",
    "success_minus_sac_t_low",
    "success_minus_sac_t_high",
    "sac_steps_ratio_t_low",
    "sac_steps_ratio_t_high",
    "return_t_low",
    "return_t_high",
    "return_minus_sac",
    "return_minus_sac_low",
    "return_minus_sac_high",
    "return_minus_sac_t_low",
    "return_minus_sac_t_high",
    "smoothness_sparc_t_low",
    "smoothness_sparc_t_high",
    "sparc_minus_sac",
    "sparc_minus_sac_t_low",
    "sparc_minus_sac_t_high",
];

/// The stream of every bootstrap: the tables alone decide its result.
fn stream() -> Rng {
    rng::stream(0, "bootstrap")
}

impl Runs {
    fn learns(&self) -> bool {
        !self.curves.is_empty()
    }

    /// The steps of the last evaluation, the largest over the seeds.
    fn budget(&self) -> Option<f64> {
        self.curves.iter().filter_map(|(x, _)| x.last().copied()).reduce(f64::max)
    }

    /// By which step each seed reaches the level.
    fn times(&self) -> Vec<Option<f64>> {
        self.curves.iter().map(|(x, y)| steps_to(LEVEL, x, y)).collect()
    }

    /// The same, with the budget of each seed that does not reach it.
    fn censored_times(&self) -> Vec<Time> {
        let budgets = self.curves.iter().map(|(x, _)| x.last().copied().unwrap_or(0.0));
        let of_seed = |(time, budget): (Option<f64>, f64)| time.map_or(Time::Censored(budget), Time::Reached);
        self.times().into_iter().zip(budgets).map(of_seed).collect()
    }

    /// After how many seconds of training each seed reaches the level.
    fn seconds(&self) -> Vec<Option<f64>> {
        let at = |(steps, seconds): &Curve, time: f64| Some(seconds[steps.iter().position(|step| *step == time)?]);
        self.times().into_iter().zip(&self.clocks).map(|(time, clock)| at(clock, time?)).collect()
    }

    fn row(&self, all: &[Self]) -> Vec<(&'static str, Option<f64>)> {
        let by_seed = means(&self.success);
        let episodes = self.success.concat();
        let [low, high] = success_interval(&self.success);
        let mut row = self.means.clone();
        row.extend([
            ("seeds", Some(by_seed.len() as f64)),
            ("steps", self.budget()),
            ("test_episodes", Some(episodes.len() as f64)),
            ("success", Some(mean(&episodes))),
            ("success_low", Some(low)),
            ("success_high", Some(high)),
        ]);
        if by_seed.len() >= IQM_RUNS {
            let [low, high] = bootstrap(&by_seed, interquartile_mean, &mut stream());
            row.extend([
                ("success_iqm", Some(interquartile_mean(&by_seed))),
                ("success_iqm_low", Some(low)),
                ("success_iqm_high", Some(high)),
            ]);
        }
        // Seeds that all agree show no spread to make an interval of.
        if let Some(ends) = t_interval(&by_seed).filter(|[low, high]| low < high) {
            let [low, high] = ends.map(|end| Some(end.clamp(0.0, 1.0)));
            row.extend([("success_t_low", low), ("success_t_high", high)]);
        }
        for (ends, seeds) in [
            (["return_t_low", "return_t_high"], &means(&self.returns)),
            (["smoothness_sparc_t_low", "smoothness_sparc_t_high"], &self.sparc),
        ] {
            row.extend(ends.into_iter().zip(t_interval(seeds).into_iter().flatten().map(Some)));
        }
        if let Some(budget) = self.budget() {
            let times = self.times();
            let learners = all.iter().filter(|other| other.task == self.task && other.learns());
            let lasts = learners.flat_map(|other| &other.curves).filter_map(|(x, _)| x.last().copied());
            let common = lasts.reduce(f64::min).unwrap_or(budget);
            if !self.clocks.is_empty() {
                row.push(("seconds_to_80", censored_median(&self.seconds())));
            }
            // The median: a seed that ran beside other programs does not count for more.
            let action_ms: Vec<Option<f64>> = last_of_each(&self.action_ms).into_iter().map(Some).collect();
            row.push(("action_ms", censored_median(&action_ms)));
            row.push(("updates", Some(mean(&last_of_each(&self.updates)))));
            // If the values of one seed have diverged, so has their mean.
            let [expected, realised, correlation] = self.expectations.each_ref().map(|seeds| mean(seeds));
            row.push(("optimism", Some((expected - realised) / realised.abs())));
            row.push(("return_correlation", Some(correlation)));
            let areas: Vec<f64> = self.curves.iter().map(|(x, y)| area_under_curve(x, y, common)).collect();
            row.extend([
                ("steps_to_80", censored_median(&times)),
                ("seeds_reaching_80", Some(times.iter().flatten().count() as f64)),
                ("steps_to_80_restricted_mean", Some(restricted_mean(&times, budget))),
                ("area_under_curve", Some(mean(&areas))),
                ("common_budget", Some(common)),
            ]);
            let ends = t_interval(&areas).into_iter().flatten().map(|end| Some(end.clamp(0.0, 1.0)));
            row.extend(["area_under_curve_t_low", "area_under_curve_t_high"].into_iter().zip(ends));
            let is_baseline = |other: &&Self| other.task == self.task && other.method == BASELINE && other.learns();
            if let Some(baseline) = all.iter().find(is_baseline).filter(|_| self.method != BASELINE) {
                row.extend(self.against(baseline));
            }
        }
        row
    }

    /// The comparison with the baseline's runs on the same task.
    fn against(&self, baseline: &Self) -> Vec<(&'static str, Option<f64>)> {
        let (difference, [low, high]) = paired_difference(&self.success, &baseline.success, &mut stream());
        let mut row = vec![
            ("success_minus_sac", Some(difference)),
            ("success_minus_sac_low", Some(low)),
            ("success_minus_sac_high", Some(high)),
        ];
        if let Some([low, high]) = welch_interval(&means(&self.success), &means(&baseline.success)) {
            let [low, high] = [low, high].map(|end| Some(end.clamp(-1.0, 1.0)));
            row.extend([("success_minus_sac_t_low", low), ("success_minus_sac_t_high", high)]);
        }
        let (difference, [low, high]) = paired_difference(&self.returns, &baseline.returns, &mut stream());
        let entries = ["return_minus_sac", "return_minus_sac_low", "return_minus_sac_high"];
        row.extend(entries.into_iter().zip([difference, low, high].map(Some)));
        if let Some(ends) = welch_interval(&means(&self.returns), &means(&baseline.returns)) {
            row.extend(["return_minus_sac_t_low", "return_minus_sac_t_high"].into_iter().zip(ends.map(Some)));
        }
        if let Some([low, high]) = welch_interval(&self.sparc, &baseline.sparc) {
            let entries = ["sparc_minus_sac", "sparc_minus_sac_t_low", "sparc_minus_sac_t_high"];
            row.extend(entries.into_iter().zip([mean(&self.sparc) - mean(&baseline.sparc), low, high].map(Some)));
        }
        for (entries, (probability, [low, high])) in [
            (
                ["improvement_over_sac", "improvement_over_sac_low", "improvement_over_sac_high"],
                probability_of_improvement(&means(&self.success), &means(&baseline.success), &mut stream()),
            ),
            (
                ["earlier_than_sac", "earlier_than_sac_low", "earlier_than_sac_high"],
                probability_of_being_earlier(&self.censored_times(), &baseline.censored_times(), &mut stream()),
            ),
        ] {
            row.extend(entries.into_iter().zip([probability, low, high].map(Some)));
        }
        // With a censored seed of this method, the ratio would be neither an estimate nor a bound; with one of the baseline's,
        // which counts as its budget, it is a lower bound, and its interval has no upper end. There is no ratio to no steps at all.
        let times = self.times().into_iter().collect::<Option<Vec<f64>>>();
        if let Some(times) = times.filter(|times| times.iter().all(|time| *time > 0.0)) {
            let budget = baseline.budget().unwrap_or(f64::NAN);
            let known = baseline.times().iter().all(Option::is_some);
            let longer: Vec<f64> = baseline.times().into_iter().map(|time| time.unwrap_or(budget)).collect();
            let (ratio, [low, high]) = ratio_of_means(&longer, &times, &mut stream());
            let entries = ["sac_steps_ratio", "sac_steps_ratio_low", "sac_steps_ratio_high"];
            row.extend(entries.into_iter().zip([Some(ratio), Some(low), known.then_some(high)]));
            // A later time raises the standard error as well as the mean: with a censored seed, the t interval has no end that
            // is a bound.
            if let Some(ends) = ratio_t_interval(&longer, &times).filter(|_| known) {
                row.extend(["sac_steps_ratio_t_low", "sac_steps_ratio_t_high"].into_iter().zip(ends.map(Some)));
            }
        }
        row
    }
}

/// The mean over the episodes of each seed.
fn means(seeds: &[Vec<f64>]) -> Vec<f64> {
    seeds.iter().map(|episodes| mean(episodes)).collect()
}

/// The last values of each run.
fn last_rows(rows: &DataFrame) -> PolarsResult<DataFrame> {
    if rows.width() == 0 {
        return Ok(rows.clone());
    }
    let in_order = SortMultipleOptions::default().with_maintain_order(true);
    let values = ["expected", "realised", "correlation"].map(|name| col(name).last());
    let by_step = rows.clone().lazy().sort(["step"], in_order);
    by_step.group_by_stable(["task", "method", "seed"].map(col)).agg(values).collect()
}

/// The last value of each curve.
fn last_of_each(curves: &[Curve]) -> Vec<f64> {
    curves.iter().filter_map(|(_, values)| values.last().copied()).collect()
}

/// The 95 % interval of a success rate. One seed: Wilson's, of this agent. Several: the two-level bootstrap; but if all
/// episodes of all seeds have the same outcome, resampling them shows no spread at all, and Wilson's is given, which knows
/// nothing of differences between seeds but at least of the number of episodes.
fn success_interval(seeds: &[Vec<f64>]) -> [f64; 2] {
    let episodes = seeds.concat();
    let successes = episodes.iter().filter(|success| **success > 0.5).count();
    if seeds.len() == 1 || successes == 0 || successes == episodes.len() {
        return wilson(successes, episodes.len());
    }
    two_level_bootstrap(&[seeds], &mut stream())
}
