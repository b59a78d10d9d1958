//! The planner of TD-MPC2.

use serde::{Deserialize, Serialize};

use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, best, shifted, weights};
use crate::rng::{self, Rng};
use crate::settings::{must_hold, ranges};

/// Settings of [`GuidedMppi`]. The defaults are TD-MPC2's, which adds two iterations where an action has 20 numbers or more.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GuidedConfig {
    /// The planning horizon, in actions.
    pub horizon: usize,
    /// Candidates in an iteration, proposals included.
    pub population: usize,
    /// Sequences that the objective is asked to propose; they are candidates in every iteration.
    pub proposals: usize,
    /// Best candidates that the distribution is fitted to.
    pub elites: usize,
    /// Iterations.
    pub iterations: usize,
    /// The temperature, in units of return. (The published code has its inverse, 0.5, under this name.)
    pub temperature: f64,
    /// Lower bound of the standard deviation.
    #[doc(alias = "standard deviation")]
    pub min_deviation: f64,
    /// Upper bound of the standard deviation, with which each search starts.
    pub max_deviation: f64,
    /// Execute the mean of the elites instead of one that is drawn: smoother, and less is explored.
    pub execute_mean: bool,
}

impl Default for GuidedConfig {
    fn default() -> Self {
        Self {
            horizon: 3,
            population: 512,
            proposals: 24,
            elites: 64,
            iterations: 6,
            temperature: 2.0,
            min_deviation: 0.05,
            max_deviation: 2.0,
            execute_mean: false,
        }
    }
}

ranges!(GuidedConfig {
    horizon: 1..=1000,
    population: 1..=1_000_000,
    proposals: 0..=1_000_000,
    elites: 1..=1_000_000,
    iterations: 1..=10_000,
    temperature: 1e-6..=1e6,
    min_deviation: 0.0..=100.0,
    max_deviation: 0.0..=100.0,
    execute_mean: Any,
}
require proposals <= population => "`proposals` must not exceed `population`, which contains them";
require elites <= population => "`elites` must not exceed `population`";
require min_deviation <= max_deviation => "`min_deviation` must not exceed `max_deviation`";
);

/// The planner of TD-MPC2 (Hansen et al. 2024, section 3.2): MPPI over the best candidates, whose deviation adapts, guided by
/// sequences that the objective proposes, such as those of a learned policy.
///
/// ```text
/// mean = what is left of the last plan, deviation = its maximum
/// repeat `iterations` times:
///     candidates = proposals and samples of N(mean, deviation^2)
///     R = their returns; keep the `elites` best
///     w = exp(R / temperature) / sum exp(R / temperature)           over the elites
///     mean = sum w a;  deviation = sqrt(sum w (a - mean)^2), within its bounds
/// execute an elite, drawn with probability w, or the mean
/// ```
///
/// ```
/// use handful::plan::{ActionSequences, GuidedConfig, GuidedMppi, Objective, Planner};
/// use handful::rng;
///
/// /// The closer to 0.9 all actions are, the higher the return; the objective proposes a sequence close to that.
/// struct WithProposals;
///
/// impl Objective for WithProposals {
///     fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
///         sequences.rows().map(|row| -row.iter().map(|a| (a - 0.9).abs()).sum::<f32>()).collect()
///     }
///     fn proposals(&mut self, count: usize, like: &ActionSequences) -> ActionSequences {
///         ActionSequences { values: vec![0.8; count * like.horizon * like.actions], ..like.clone() }
///     }
/// }
///
/// let mut planner = GuidedMppi::new(GuidedConfig { temperature: 0.1, ..GuidedConfig::default() }, 4);
/// let plan = planner.plan(&mut WithProposals, &mut |_| {}, &mut rng::stream(0, "example"));
/// assert!(plan.best_return > -1.2);
/// ```
#[doc(alias = "TD-MPC2")]
#[doc(alias = "MPPI")]
#[derive(Clone, Debug)]
pub struct GuidedMppi {
    config: GuidedConfig,
    action_size: usize,
    /// `[horizon, actions]`.
    mean: Vec<f64>,
    /// `[horizon, actions]`.
    deviation: Vec<f64>,
}

impl GuidedMppi {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If a setting lies outside its range; [`PlannerConfig::try_build`](super::PlannerConfig::try_build) returns an error instead.
    pub fn new(config: GuidedConfig, action_size: usize) -> Self {
        must_hold(&config, "guided");
        let numbers = config.horizon * action_size;
        Self { mean: vec![0.0; numbers], deviation: vec![config.max_deviation; numbers], action_size, config }
    }

    /// The standard deviation of each number of the last plan's first action: how much to explore around it.
    pub fn deviation(&self) -> &[f64] {
        &self.deviation[..self.action_size]
    }

    /// The mean of the last plan's elites, moved on by [`shift`](Planner::shift), `[horizon, actions]`: where the next search starts.
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// Mean and deviation of the weighted elites.
    fn fit(&mut self, elites: &[&[f32]], weights: &[f64]) {
        let weighted = |of: &dyn Fn(f64) -> f64, i: usize| -> f64 {
            elites.iter().zip(weights).map(|(row, weight)| weight * of(row[i].into())).sum()
        };
        for i in 0..self.mean.len() {
            let mean = weighted(&|a| a, i);
            let variance = weighted(&|a| (a - mean).powi(2), i);
            self.mean[i] = mean;
            self.deviation[i] = variance.sqrt().clamp(self.config.min_deviation, self.config.max_deviation);
        }
    }
}

impl Planner for GuidedMppi {
    fn reset(&mut self) {
        self.mean.fill(0.0);
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let config = self.config.clone();
        let empty = ActionSequences::new(config.horizon, self.action_size);
        let proposals = objective.proposals(config.proposals, &empty);
        self.deviation.fill(config.max_deviation);
        let mut plan = Plan { actions: Vec::new(), best_return: f32::NEG_INFINITY };
        for index in 0..config.iterations {
            // Sample.
            let mut candidates = proposals.clone();
            for _ in proposals.count()..config.population {
                let normals = self.mean.iter().zip(&self.deviation);
                let sample = normals.map(|(mean, deviation)| mean + deviation * rng::normal(rng));
                candidates.values.extend(sample.map(|a| a.clamp(-1.0, 1.0) as f32));
            }
            // Evaluate.
            let returns = objective.returns(&candidates);
            plan.best_return = returns.iter().copied().fold(plan.best_return, f32::max);
            // Fit to the elites.
            let order = best(&returns, config.elites);
            let elites: Vec<&[f32]> = order.iter().map(|i| candidates.row(*i)).collect();
            let weights = weights(&order.iter().map(|i| returns[*i]).collect::<Vec<f32>>(), config.temperature);
            self.fit(&elites, &weights);
            observer(&Iteration { index, candidates: &candidates, returns: &returns, mean: &self.mean });
            if index + 1 == config.iterations && config.execute_mean {
                plan.actions = self.mean.iter().map(|a| *a as f32).collect();
            } else if index + 1 == config.iterations {
                let gumbels = weights.iter().map(|_| gumbel(rng)).collect::<Vec<f64>>();
                plan.actions = elites[drawn(&weights, &gumbels)].to_vec();
            }
        }
        plan
    }

    fn shift(&mut self, steps: usize) {
        shifted(&mut self.mean, steps, self.action_size, &vec![0.0; self.action_size]);
    }
}

/// A sample from the standard Gumbel distribution.
fn gumbel(rng: &mut Rng) -> f64 {
    -(-rng::uniform(rng, f64::MIN_POSITIVE, 1.0).ln()).ln()
}

/// The index drawn with these probabilities, by the Gumbel-max trick: the largest of ln w + g.
fn drawn(weights: &[f64], gumbels: &[f64]) -> usize {
    let scores = weights.iter().zip(gumbels).map(|(weight, gumbel)| weight.ln() + gumbel);
    let larger = |best: (usize, f64), next: (usize, f64)| if next.1 > best.1 { next } else { best };
    scores.enumerate().fold((0, f64::NEG_INFINITY), larger).0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: &[f64], expected: &[f64]) {
        assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-5), "{found:?}, expected {expected:?}");
    }

    /// Numbers computed in float64 from the published code.
    #[test]
    fn elites_weights_and_distribution_are_the_references() {
        let returns = [1.0, 3.0, 2.5, -1.0, 2.0];
        let rows = [[0.2, -0.4], [1.0, 0.5], [-0.3, 0.1], [0.9, -1.0], [0.0, 0.6]];
        let mut planner = GuidedMppi::new(GuidedConfig { horizon: 2, ..GuidedConfig::default() }, 1);
        let mut check = |order: &[usize], expected: &[f64], mean: [f64; 2], deviation: [f64; 2]| {
            let found = weights(&order.iter().map(|i| returns[*i]).collect::<Vec<f32>>(), 2.0);
            near(&found, expected);
            planner.fit(&order.iter().map(|i| &rows[*i][..]).collect::<Vec<_>>(), &found);
            near(&planner.mean, &mean);
            near(&planner.deviation, &deviation);
        };
        let all = [0.127_358, 0.346_195, 0.269_617, 0.046_852, 0.209_978];
        check(&[0, 1, 2, 3, 4], &all, [0.332_949, 0.228_250], [0.550_137, 0.424_227]);
        let three = best(&returns, 3);
        assert_eq!(three, [1, 2, 4]);
        check(&three, &[0.419_229, 0.326_496, 0.254_275], [0.321_280, 0.394_829], [0.587_701, 0.209_096]);
        // Scores of -0.593147, -0.003973 and -1.209438: the first is 0.589174 behind the second, and 0.616291 ahead of
        // the third.
        let with = |second: f64, third: f64| drawn(&[0.5, 0.3, 0.2], &[0.1, 1.2 - second, 0.4 + third]);
        assert_eq!(with(0.0, 0.0), 1);
        assert_eq!([with(0.589_16, 0.0), with(0.589_19, 0.0)], [1, 0]);
        assert_eq!([with(1.0, 0.616_28), with(1.0, 0.616_31)], [0, 2]);
    }
}
