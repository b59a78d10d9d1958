//! Fitting: minibatch gradient descent on the negative log-likelihood, early stopping on the validation set, the choice of
//! elites, and the temperature of the predicted standard deviations.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use rayon::prelude::*;

use super::EnsembleConfig;
use super::data::{Data, Schedule};
use super::networks::{Learner, Member, Networks};
use crate::nn::frozen::FrozenMlp;
use crate::nn::{Activation, Grad, GroupLasso, Tensor3, bounded_nll, ops, values};
use crate::replay::ReplayBuffer;
use crate::rng::Rng;

/// A fall of a member's validation error by this fraction resets the patience.
const IMPROVEMENT: f64 = 0.01;
/// Fitted temperatures lie between its inverse and this.
const MAX_TEMPERATURE: f32 = 5.0;

/// How a fit went.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// Gradient steps of each member.
    pub steps: usize,
    /// Training loss, mean over members and steps: [`bounded_nll`](crate::nn::bounded_nll) of the normalised targets, with the
    /// ensemble's `beta`.
    pub loss: f32,
    /// Validation error of each member: mean squared error of its mean, in normalised units (predicting the mean change
    /// has error 1). Empty without validation set.
    pub errors: Vec<f64>,
    /// The same of the networks that learn the reward; empty if none do.
    pub reward_errors: Vec<f64>,
}

/// The rows of the replay buffer to train on, and those held out.
pub(super) struct Split {
    pub training: Vec<usize>,
    pub validation: Vec<usize>,
}

impl Split {
    pub fn new(replay: &ReplayBuffer, held_out: f64) -> Self {
        let (validation, training) = (0..replay.len()).partition(|row| is_held_out(replay.serial(*row), held_out));
        Self { training, validation }
    }
}

/// Whether the transition of this serial number belongs to the validation set: for a share `held_out` of all, once and for
/// all, so that no fit ever trains on it. Serial numbers count because of the golden ratio (a low-discrepancy sequence):
/// the share holds in every stretch of experience, and no rhythm of episodes or repeated actions is met. The first
/// transition is always one for training.
fn is_held_out(serial: u64, held_out: f64) -> bool {
    const GOLDEN_RATIO: u64 = 0x9e37_79b9_7f4a_7c15;
    let phase = (serial.wrapping_mul(GOLDEN_RATIO) >> 11) as f64 / (1_u64 << 53) as f64;
    phase >= 1.0 - held_out
}

/// The best weights of a member during a fit. Whether a snapshot is better and whether it is worth going on for are
/// separate questions: many gains below [`IMPROVEMENT`] add up.
struct Best {
    error: f64,
    /// None without validation set.
    learner: Option<Learner>,
    /// The error at the last improvement that reset the patience.
    milestone: f64,
}

impl Default for Best {
    fn default() -> Self {
        Self { error: f64::INFINITY, learner: None, milestone: f64::INFINITY }
    }
}

impl Best {
    /// Keeps the learner if its validation error is the lowest so far. Returns whether it resets the patience.
    fn consider(&mut self, error: f64, learner: &Learner) -> bool {
        if error < self.error {
            (self.error, self.learner) = (error, Some(learner.clone()));
        }
        let improved = error < self.milestone * (1.0 - IMPROVEMENT);
        if improved {
            self.milestone = error;
        }
        improved
    }
}

impl Networks {
    /// Trains for at most `limit` gradient steps. Weights and optimiser state continue from the fit before; elites and
    /// temperature are computed anew.
    pub fn fit(&mut self, config: &EnsembleConfig, data: &Data, split: &Split, limit: usize, rng: &mut Rng) -> Fit {
        let Split { training, validation } = split;
        let mut schedules: Vec<Schedule> =
            (0..config.members).map(|_| Schedule::new(training, config.bootstrap, rng)).collect();
        let mut best: Vec<Best> = (0..config.members).map(|_| Best::default()).collect();
        let (mut steps, mut loss, mut checks_without_improvement) = (0, 0.0, 0);
        while steps < limit && checks_without_improvement < config.patience {
            let round = steps..limit.min(steps + config.check_every);
            steps = round.end;
            let rates: Vec<f32> = round.map(|step| config.learning_rate_at(step, limit)).collect();
            loss += self.train(config, data, &mut schedules, &rates, rng);
            if validation.is_empty() {
                continue;
            }
            let mut improved = false;
            for ((best, error), member) in best.iter_mut().zip(self.errors(data, validation)).zip(&self.members) {
                improved |= best.consider(error, &member.learner);
            }
            checks_without_improvement = if improved { 0 } else { checks_without_improvement + 1 };
        }
        for (member, best) in self.members.iter_mut().zip(&mut best) {
            if let Some(learner) = best.learner.take() {
                member.learner = learner;
            }
        }
        self.elites = (0..config.members).collect();
        self.elites.sort_by(|a, b| best[*a].error.total_cmp(&best[*b].error));
        self.elites.truncate(config.elites);
        let errors = best.iter().map(|best| best.error).filter(|error| error.is_finite()).collect();
        self.fit_temperature(data, validation);
        let loss = (loss / (steps.max(1) * config.members) as f64) as f32;
        Fit { steps, loss, errors, reward_errors: Vec::new() }
    }

    /// One gradient step of every member for each learning rate, each member on its own minibatches. Returns the sum of
    /// all losses.
    fn train(
        &mut self,
        config: &EnsembleConfig,
        data: &Data,
        schedules: &mut [Schedule],
        rates: &[f32],
        rng: &mut Rng,
    ) -> f64 {
        let batch = config.batch.min(schedules[0].len());
        let mut minibatches: Vec<Vec<Vec<usize>>> = vec![vec![]; schedules.len()];
        for _ in rates {
            for (minibatches, schedule) in minibatches.iter_mut().zip(schedules.iter_mut()) {
                minibatches.push(schedule.next(batch, rng));
            }
        }
        let (gated, lasso) = (self.gated, self.lasso.as_ref());
        let members = self.members.par_iter_mut().zip(minibatches);
        let losses: Vec<f64> = members
            .map(|(member, minibatches)| {
                let steps = minibatches.iter().zip(rates);
                steps.map(|(rows, rate)| f64::from(member.gradient_step(data, rows, *rate, gated, lasso, config))).sum()
            })
            .collect();
        losses.iter().sum()
    }

    /// Mean squared error of each member's mean on the given rows, in normalised units.
    fn errors(&self, data: &Data, rows: &[usize]) -> Vec<f64> {
        let (heads, targets) = self.heads_and_targets(data, rows);
        let outputs = self.temperature.len();
        let error = |head: &Vec<f32>| {
            let pairs = head.chunks_exact(2 * outputs).zip(targets.chunks_exact(outputs));
            let squares =
                pairs.flat_map(|(head, target)| head.iter().zip(target).map(|(m, t)| f64::from(m - t).powi(2)));
            squares.sum::<f64>() / targets.len() as f64
        };
        heads.iter().map(error).collect()
    }

    /// Calibration on the validation set: for each output the root mean square of (target - mean) / standard deviation,
    /// by which predicted standard deviations are multiplied.
    fn fit_temperature(&mut self, data: &Data, validation: &[usize]) {
        let outputs = self.temperature.len();
        if validation.is_empty() {
            return;
        }
        let (heads, targets) = self.heads_and_targets(data, validation);
        let mut squares = vec![0.0_f64; outputs];
        for &member in &self.elites {
            let [max, min] = self.members[member].learner.bounds();
            for (head, target) in heads[member].chunks_exact(2 * outputs).zip(targets.chunks_exact(outputs)) {
                for i in 0..outputs {
                    let log_variance = crate::nn::bounded(head[outputs + i], max[i], min[i]);
                    squares[i] += f64::from((target[i] - head[i]).powi(2) * (-log_variance).exp());
                }
            }
        }
        let count = (validation.len() * self.elites.len()) as f64;
        let root = |sum: &f64| ((sum / count).sqrt() as f32).clamp(1.0 / MAX_TEMPERATURE, MAX_TEMPERATURE);
        self.temperature = squares.iter().map(root).collect();
    }

    /// The outputs of each member for some rows, `[rows, 2 outputs]`, and the targets, `[rows, outputs]`.
    fn heads_and_targets(&self, data: &Data, rows: &[usize]) -> (Vec<Vec<f32>>, Vec<f32>) {
        let x = data.inputs_of(rows);
        let head = |member: &Member| values(&member.learner.head(x.clone(), self.gated, Grad::Input)).to_vec();
        (self.members.par_iter().map(head).collect(), values(&data.targets_of(rows)).to_vec())
    }
}

impl Member {
    /// One step of AdamW on a minibatch of rows. Returns the loss.
    fn gradient_step(
        &mut self,
        data: &Data,
        rows: &[usize],
        learning_rate: f32,
        gated: bool,
        lasso: Option<&GroupLasso>,
        config: &EnsembleConfig,
    ) -> f32 {
        let loss = self.learner.nll(data.inputs_of(rows).leaky_traced(), &data.targets_of(rows), gated, config);
        let value = values(&loss)[0];
        self.optimiser.set_learning_rate(learning_rate);
        self.optimiser.step(&mut self.learner, &mut loss.sum().backward());
        if let Some(lasso) = lasso {
            lasso.step(&mut self.learner.network, learning_rate);
        }
        value
    }
}

impl Learner {
    /// The negative log-likelihood of Gaussians with bounded log-variance (Chua et al. 2018, section 4 and appendix A.1),
    /// or its beta-NLL variant: see [`bounded_nll`].
    #[doc(alias = "negative log-likelihood")]
    fn nll<T: Tape<f32, Cpu>>(
        &self,
        x: Tensor3<T>,
        targets: &Tensor3,
        gated: bool,
        config: &EnsembleConfig,
    ) -> Tensor3<T> {
        let head = self.head(x, gated, Grad::Params);
        let grad = if config.learn_bounds { Grad::Both } else { Grad::Input };
        bounded_nll(head, targets, &self.bounds, config.beta, grad)
    }

    /// Means and raw (not yet bounded) log-variances, `[1, batch, 2 outputs]`.
    fn head<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>, gated: bool, grad: Grad) -> Tensor3<T> {
        let head = self.network.forward(x, grad);
        if gated { ops::gated(head) } else { head }
    }

    /// The network for prediction, and its bounds.
    pub fn frozen(&self) -> (FrozenMlp, [&[f32]; 2]) {
        (FrozenMlp::new(self.network.layers_of(0), Activation::Silu), self.bounds())
    }

    /// Upper and lower bounds of the log-variances.
    fn bounds(&self) -> [&[f32]; 2] {
        [values(&self.bounds.max), values(&self.bounds.min)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_held_out_share_is_met_in_every_stretch_and_every_rhythm() {
        for share in [0.05, 0.1, 0.5] {
            assert!(!is_held_out(0, share), "something is left to train on");
            for rhythm in [1, 3, 10, 150, 200] {
                for start in (0..1_000_000).step_by(77_777) {
                    let count = (0..400).filter(|i| is_held_out(start + rhythm * i, share)).count();
                    assert!((count as f64 - 400.0 * share).abs() < 20.0, "{share}, {rhythm}, {start}: {count}");
                }
            }
        }
        assert!((0..100_000).all(|serial| !is_held_out(serial, 0.0)));
    }
}
