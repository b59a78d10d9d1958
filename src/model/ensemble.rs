//! Probabilistic ensembles (Chua et al. 2018, PETS): several networks, each of which predicts the distribution of what
//! comes next.
//!
//! Each network answers, for an observation and an action, mean and log-variance of the *change* of the
//! observation, and of the reward if that is to be learned. What the networks disagree on, they have not seen enough
//! of; what each of them calls uncertain is chance.
//!
//! Deviations from PETS: targets are normalised as well as inputs (a cube moves by millimetres, a hand by centimetres),
//! the bounds of the log-variance are constant unless asked otherwise (as mbrl-lib has it) and each network's own, each
//! network stops at its own best moment, and weights decay as in AdamW.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use rand::RngExt;
use rand::seq::SliceRandom;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Dynamics, FeatureMap, Normaliser};
use crate::env::Spec;
use crate::error::{Error, Result};
use crate::nn::frozen::FrozenMlp;
use crate::nn::{
    Activation, Adam, AdamConfig, Grad, Init, LogVarianceBounds, Mlp, MlpConfig, Norm, Tensor3, Weights, bounded_nll,
    device, ops, parameters_of_fields, tensor, values,
};
use crate::replay::ReplayBuffer;
use crate::rng::Rng;

/// A feature that moves less than this share of its typical size counts as still.
const STILL: f32 = 1e-3;
/// Rows held out at most: enough to judge by.
const MAX_HELD_OUT: usize = 2000;
/// A network has become better when its error fell by this share.
const IMPROVEMENT: f64 = 0.01;
/// Fitted temperatures stay within this factor.
const MAX_TEMPERATURE: f32 = 5.0;

/// Settings of an [`Ensemble`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EnsembleConfig {
    /// Networks.
    pub members: usize,
    /// The best of them, which predict.
    pub elites: usize,
    /// Width of each hidden layer.
    pub hidden: Vec<usize>,
    /// Step size.
    pub learning_rate: f32,
    /// Share of the step size that is left at the end of a fit, to which it falls in a straight line; 1 keeps it. What
    /// plans are made in at the end is then less at the mercy of the last minibatches.
    pub final_learning_rate_fraction: f32,
    /// Decay of weights, in units of the step size.
    pub weight_decay: f32,
    /// Transitions in a minibatch of each network.
    pub batch: usize,
    /// Whether each network learns from a resample of its own (with replacement); otherwise each sees everything, in
    /// an order of its own.
    pub bootstrap: bool,
    /// Share of the transitions that no network learns from; by them the networks are judged.
    pub held_out: f64,
    /// Gradient steps of the first fit, at most.
    pub first_steps: usize,
    /// Gradient steps of each later fit, at most.
    pub steps: usize,
    /// Gradient steps between two looks at the held-out transitions.
    pub check_every: usize,
    /// A fit ends when no network has become better for so many looks.
    pub patience: usize,
    /// Whether the bounds of the log-variance are learned.
    pub learn_bounds: bool,
    /// How much what is uncertain counts in the loss, from 0 (as in PETS) to 1: see [`bounded_nll`].
    pub beta: f32,
    /// Changes of more than so many deviations are learned as if they were that large: a cube that is knocked over once
    /// must not outshout a thousand pushes.
    pub max_target: f32,
    /// Whether the reward is learned too; otherwise it must be known.
    pub learn_reward: bool,
    /// Whether each change is a size times a gate (a sigmoid with an output of its own), which can be shut over whole
    /// regions: a cube that nobody touches stays where it is. Without, it creeps a little, and plans make use of that.
    pub gated: bool,
}

impl Default for EnsembleConfig {
    fn default() -> Self {
        Self {
            members: 5,
            elites: 5,
            hidden: vec![200; 3],
            learning_rate: 1e-3,
            final_learning_rate_fraction: 1.0,
            weight_decay: 1e-2,
            batch: 256,
            bootstrap: false,
            held_out: 0.1,
            first_steps: 2000,
            steps: 500,
            check_every: 50,
            patience: 10,
            learn_bounds: false,
            beta: 0.5,
            max_target: 10.0,
            learn_reward: false,
            gated: false,
        }
    }
}

impl EnsembleConfig {
    fn check(&self) -> Result<()> {
        for (name, value) in [("members", self.members), ("batch", self.batch), ("check_every", self.check_every)] {
            if value == 0 {
                return Err(Error::BadSetting(format!("ensemble: `{name}` must be at least 1")));
            }
        }
        if self.elites == 0 || self.elites > self.members {
            return Err(Error::BadSetting("ensemble: `elites` must lie between 1 and `members`".into()));
        }
        if self.hidden.is_empty() || self.hidden.contains(&0) {
            return Err(Error::BadSetting(
                "ensemble: `hidden` must name at least one layer, each at least 1 wide".into(),
            ));
        }
        if !(0.0..0.9).contains(&self.held_out) {
            return Err(Error::BadSetting("ensemble: `held_out` must lie in [0, 0.9)".into()));
        }
        if !(0.0..=1.0).contains(&self.final_learning_rate_fraction) {
            return Err(Error::BadSetting("ensemble: `anneal` must lie between 0 and 1".into()));
        }
        Ok(())
    }

    /// The size of a step, `step` steps after a fit of `steps` began.
    fn learning_rate_at(&self, step: usize, steps: usize) -> f32 {
        self.learning_rate * (1.0 - (1.0 - self.final_learning_rate_fraction) * step as f32 / steps as f32)
    }
}

/// How a fit went.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// Gradient steps.
    pub steps: usize,
    /// Mean loss of a network (negative log-likelihood of normalised targets, without constants) over the fit.
    pub loss: f32,
    /// Mean squared error of each network on the held-out transitions, in normalised units (a prediction of the
    /// mean has 1). Empty if none were held out.
    pub errors: Vec<f64>,
}

/// The networks, and what belongs to them.
pub struct Ensemble {
    config: EnsembleConfig,
    layout: FeatureMap,
    /// Typical size of each number of an observation.
    sizes: Vec<f32>,
    actions: usize,
    members: Vec<Member>,
    inputs: Normaliser,
    targets: Normaliser,
    /// Factor of the predicted deviation of each output, fitted on held-out transitions.
    temperature: Vec<f32>,
    elites: Vec<usize>,
    fits: usize,
}

impl Ensemble {
    /// New networks for an environment.
    ///
    /// # Errors
    /// If a setting cannot be used.
    pub fn new(spec: &Spec, config: EnsembleConfig, rng: &mut Rng) -> Result<Self> {
        config.check()?;
        let cpu = device();
        let (layout, actions) = (FeatureMap::new(spec)?, spec.action_size);
        let inputs = layout.reads() + actions;
        let outputs = layout.predicted.len() + usize::from(config.learn_reward);
        let shape = MlpConfig {
            members: config.members,
            input: inputs,
            hidden: config.hidden.clone(),
            output: Some(if config.gated { 3 } else { 2 } * outputs),
            norm: Norm::None,
            activation: Activation::Silu,
            init: Init::TruncatedNormal,
        };
        let networks = Mlp::new(&cpu, &shape, rng);
        let optimiser = AdamConfig { weight_decay: config.weight_decay, ..AdamConfig::new(config.learning_rate) };
        let member = |i: usize| {
            let bounds = LogVarianceBounds::new(&cpu, outputs);
            Member { learner: Learner { network: networks.member(&cpu, i), bounds }, optimiser: Adam::new(optimiser) }
        };
        Ok(Self {
            layout,
            sizes: spec.observation.iter().map(|feature| feature.scale).collect(),
            actions,
            members: (0..config.members).map(member).collect(),
            inputs: Normaliser::identity(inputs),
            targets: Normaliser::identity(outputs),
            temperature: vec![1.0; outputs],
            elites: (0..config.elites).collect(),
            fits: 0,
            config,
        })
    }

    /// Whether it has learned anything yet.
    pub fn is_fitted(&self) -> bool {
        self.fits > 0
    }

    /// Learns from all that was experienced. Weights and optimiser go on from the fit before; normalisation, the choice
    /// of elites and the temperature are made anew.
    ///
    /// # Panics
    /// If there are fewer than two transitions.
    pub fn fit(&mut self, data: &ReplayBuffer, rng: &mut Rng) -> Fit {
        let data = self.normalised(data);
        // The rows that nobody learns from come first.
        let mut order: Vec<usize> = (0..data.rows).collect();
        order.shuffle(rng);
        let held_out = ((self.config.held_out * data.rows as f64) as usize).min(MAX_HELD_OUT);
        let (judges, lessons) = order.split_at(held_out);
        let mut schedules: Vec<Schedule> =
            (0..self.config.members).map(|_| Schedule::new(lessons, self.config.bootstrap, rng)).collect();

        let limit = if self.is_fitted() { self.config.steps } else { self.config.first_steps };
        // Networks may have learned in an earlier fit from what judges them now, so there is no record to begin with.
        let mut best: Vec<Best> = (0..self.config.members).map(|_| Best::default()).collect();
        let (mut steps, mut loss, mut stale) = (0, 0.0, 0);
        while steps < limit && stale < self.config.patience {
            let round = steps..limit.min(steps + self.config.check_every);
            steps = round.end;
            let rates: Vec<f32> = round.map(|step| self.config.learning_rate_at(step, limit)).collect();
            loss += self.learn(&data, &mut schedules, &rates, rng);
            if judges.is_empty() {
                continue;
            }
            let mut better = false;
            for ((best, error), member) in best.iter_mut().zip(self.errors(&data, judges)).zip(&self.members) {
                if error < best.error * (1.0 - IMPROVEMENT) {
                    *best = Best { error, learner: Some(member.learner.clone()) };
                    better = true;
                }
            }
            stale = if better { 0 } else { stale + 1 };
        }
        for (member, best) in self.members.iter_mut().zip(&mut best) {
            if let Some(learner) = best.learner.take() {
                member.learner = learner;
            }
        }
        self.elites = (0..self.config.members).collect();
        self.elites.sort_by(|a, b| best[*a].error.total_cmp(&best[*b].error));
        self.elites.truncate(self.config.elites);
        let errors = best.iter().map(|best| best.error).filter(|error| error.is_finite()).collect();
        self.fit_temperature(&data, judges);
        self.fits += 1;
        Fit { steps, loss: (loss / (steps.max(1) * self.config.members) as f64) as f32, errors }
    }

    /// What predicts and plans: a snapshot of the elites.
    pub fn dynamics(&self) -> Dynamics {
        Dynamics::new(
            self.elites.iter().map(|&member| self.members[member].learner.frozen()),
            self.layout.clone(),
            self.actions,
            self.inputs.clone(),
            self.targets.clone(),
            self.temperature.clone(),
        )
    }

    fn normalised(&mut self, data: &ReplayBuffer) -> Data {
        assert!(data.len() >= 2, "an ensemble learns from at least two transitions");
        let (mut inputs, mut targets) = (Vec::new(), Vec::new());
        for i in 0..data.len() {
            let row = data.row(i);
            let (mut obs, mut next) = (row.obs.to_vec(), row.next_obs.to_vec());
            self.layout.canonicalize(&mut obs, Some(&mut next));
            inputs.extend(self.layout.read(&obs).chain(row.action.iter().copied()));
            targets.extend(self.layout.predicted.iter().map(|i| next[*i] - obs[*i]));
            if self.config.learn_reward {
                targets.push(row.reward);
            }
        }
        let still = |i: &usize| STILL * self.sizes[*i];
        let near = vec![STILL; self.layout.near.len() + self.actions];
        let of_inputs: Vec<f32> = self.layout.inputs.iter().map(still).chain(near).collect();
        let of_targets: Vec<f32> =
            self.layout.predicted.iter().map(still).chain(self.config.learn_reward.then_some(STILL)).collect();
        self.inputs = Normaliser::fit(&inputs, &of_inputs);
        self.targets = Normaliser::fit(&targets, &of_targets);
        if self.config.gated {
            // A shut gate means no change, not the usual one.
            self.targets.mean.fill(0.0);
        }
        self.inputs.normalise(&mut inputs);
        self.targets.normalise(&mut targets);
        let most = self.config.max_target;
        targets.iter_mut().for_each(|target| *target = target.clamp(-most, most));
        Data { rows: data.len(), inputs, targets }
    }

    /// Gradient steps of these sizes with every network, each on a minibatch of its own. Returns the sum of their losses.
    fn learn(&mut self, data: &Data, schedules: &mut [Schedule], rates: &[f32], rng: &mut Rng) -> f64 {
        let batch = self.config.batch.min(schedules[0].lessons.len());
        let mut lessons: Vec<Vec<Vec<usize>>> = vec![vec![]; schedules.len()];
        for _ in rates {
            for (lessons, schedule) in lessons.iter_mut().zip(schedules.iter_mut()) {
                lessons.push(schedule.next(batch, rng));
            }
        }
        let config = &self.config;
        let members = self.members.par_iter_mut().zip(lessons);
        let losses: Vec<f64> = members
            .map(|(member, lessons)| {
                let steps = lessons.iter().zip(rates);
                steps.map(|(rows, rate)| f64::from(member.learn(data, rows, *rate, config))).sum()
            })
            .collect();
        losses.iter().sum()
    }

    /// Mean squared error of each network's mean on the given rows, in normalised units.
    fn errors(&self, data: &Data, rows: &[usize]) -> Vec<f64> {
        let (heads, targets) = self.judged(data, rows);
        let outputs = self.temperature.len();
        let error = |head: &Vec<f32>| {
            let pairs = head.chunks_exact(2 * outputs).zip(targets.chunks_exact(outputs));
            let squares =
                pairs.flat_map(|(head, target)| head.iter().zip(target).map(|(m, t)| f64::from(m - t).powi(2)));
            squares.sum::<f64>() / targets.len() as f64
        };
        heads.iter().map(error).collect()
    }

    /// For each output the root mean square of (target - mean) / deviation over elites and held-out rows: what the
    /// predicted deviations must be multiplied by to be right on the average.
    fn fit_temperature(&mut self, data: &Data, rows: &[usize]) {
        let outputs = self.temperature.len();
        if rows.is_empty() {
            return;
        }
        let (heads, targets) = self.judged(data, rows);
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
        let count = (rows.len() * self.elites.len()) as f64;
        let root = |sum: &f64| ((sum / count).sqrt() as f32).clamp(1.0 / MAX_TEMPERATURE, MAX_TEMPERATURE);
        self.temperature = squares.iter().map(root).collect();
    }

    /// What each network says of some rows, `[rows, 2 outputs]`, and the targets there.
    fn judged(&self, data: &Data, rows: &[usize]) -> (Vec<Vec<f32>>, Vec<f32>) {
        let x = data.inputs_of(rows);
        let head = |member: &Member| values(&member.learner.head(x.clone(), self.config.gated, Grad::Input)).to_vec();
        (self.members.par_iter().map(head).collect(), values(&data.targets_of(rows)).to_vec())
    }

    /// What it has learned.
    pub fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        for (i, member) in self.members.iter().enumerate() {
            weights.insert_module(&member_name(i), &member.learner);
        }
        self.inputs.save(&mut weights, "inputs");
        self.targets.save(&mut weights, "targets");
        weights.insert("temperature", self.temperature.clone(), [1, 1, self.temperature.len()]);
        let elites: Vec<u64> = self.elites.iter().map(|member| *member as u64).collect();
        weights.insert_counts("elites", &elites);
        weights.insert_counts("fits", &[self.fits as u64]);
        weights
    }

    /// Takes over what [`Ensemble::weights`] has given.
    ///
    /// # Errors
    /// If it is not that of an ensemble of these sizes.
    pub fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        let elites = weights.counts("elites", self.config.elites)?;
        let temperature = weights.get("temperature", [1, 1, self.temperature.len()])?.to_vec();
        self.fits = weights.counts("fits", 1)?[0] as usize;
        for (i, member) in self.members.iter_mut().enumerate() {
            weights.load_module(&member_name(i), &mut member.learner)?;
        }
        self.inputs.load(weights, "inputs")?;
        self.targets.load(weights, "targets")?;
        self.elites = elites.into_iter().map(|member| member as usize).collect();
        self.temperature = temperature;
        Ok(())
    }

    /// Writes the state of its optimisers into `state`.
    pub fn save_training_state(&self, state: &mut Weights) {
        for (i, member) in self.members.iter().enumerate() {
            member.optimiser.save(state, &member_name(i));
        }
    }

    /// Reads what [`Ensemble::save_training_state`] wrote.
    ///
    /// # Errors
    /// If it is missing or of other sizes.
    pub fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        for (i, member) in self.members.iter_mut().enumerate() {
            member.optimiser.load(state, &member_name(i), &member.learner)?;
        }
        Ok(())
    }
}

/// What a network's numbers stand under in a file.
fn member_name(member: usize) -> String {
    format!("ensemble.{member}")
}

/// One of the networks. They share nothing but the data, so each learns on a core of its own.
struct Member {
    learner: Learner,
    optimiser: Adam,
}

impl Member {
    /// One gradient step of this size on the given rows. Returns the loss.
    fn learn(&mut self, data: &Data, rows: &[usize], rate: f32, config: &EnsembleConfig) -> f32 {
        let head = self.learner.head(data.inputs_of(rows).leaky_traced(), config.gated, Grad::Params);
        let learning = if config.learn_bounds { Grad::Both } else { Grad::Input };
        let loss = bounded_nll(head, &data.targets_of(rows), &self.learner.bounds, config.beta, learning);
        let answer = values(&loss)[0];
        self.optimiser.set_learning_rate(rate);
        self.optimiser.step(&mut self.learner, &mut loss.sum().backward());
        answer
    }
}

/// What gradients train of a network. Bounds that are not learned have no gradient, and stay.
#[derive(Clone)]
struct Learner {
    network: Mlp,
    bounds: LogVarianceBounds,
}

parameters_of_fields!(Learner: network, bounds);

impl Learner {
    /// Means and raw log-variances, `[1, batch, 2 outputs]`.
    fn head<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>, gated: bool, learning: Grad) -> Tensor3<T> {
        let head = self.network.forward(x, learning);
        if gated { ops::gated(head) } else { head }
    }

    /// What predicts, and its bounds.
    fn frozen(&self) -> (FrozenMlp, [&[f32]; 2]) {
        (FrozenMlp::new(self.network.layers_of(0), Activation::Silu), self.bounds())
    }

    /// Upper and lower bounds of the log-variances.
    fn bounds(&self) -> [&[f32]; 2] {
        [values(&self.bounds.max), values(&self.bounds.min)]
    }
}

/// All transitions, as the networks see them.
struct Data {
    rows: usize,
    inputs: Vec<f32>,
    targets: Vec<f32>,
}

impl Data {
    /// Inputs of the given rows, `[1, rows, inputs]`.
    fn inputs_of(&self, rows: &[usize]) -> Tensor3 {
        gather(&self.inputs, rows, self.rows)
    }

    /// Targets of the given rows, `[1, rows, outputs]`.
    fn targets_of(&self, rows: &[usize]) -> Tensor3 {
        gather(&self.targets, rows, self.rows)
    }
}

/// The given rows of a table of `count` rows.
fn gather(table: &[f32], rows: &[usize], count: usize) -> Tensor3 {
    let width = table.len() / count;
    let mut gathered = Vec::with_capacity(rows.len() * width);
    rows.iter().for_each(|row| gathered.extend_from_slice(&table[row * width..][..width]));
    tensor(&device(), gathered, (1, rows.len(), width))
}

/// The best that a network was during a fit.
struct Best {
    error: f64,
    /// None if nobody judged.
    learner: Option<Learner>,
}

impl Default for Best {
    fn default() -> Self {
        Self { error: f64::INFINITY, learner: None }
    }
}

/// The order in which a network meets its lessons.
struct Schedule {
    lessons: Vec<usize>,
    next: usize,
}

impl Schedule {
    fn new(lessons: &[usize], bootstrap: bool, rng: &mut Rng) -> Self {
        let drawn = |_| lessons[rng.random_range(0..lessons.len())];
        let lessons = if bootstrap { (0..lessons.len()).map(drawn).collect() } else { lessons.to_vec() };
        Self { next: lessons.len(), lessons }
    }

    /// The next rows; when all were met, they are shuffled and met again.
    fn next(&mut self, count: usize, rng: &mut Rng) -> Vec<usize> {
        if self.next + count > self.lessons.len() {
            self.lessons.shuffle(rng);
            self.next = 0;
        }
        self.next += count;
        self.lessons[self.next - count..self.next].to_vec()
    }
}
