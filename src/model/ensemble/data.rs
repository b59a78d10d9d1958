//! The training set: normalised inputs and targets, and the minibatches drawn from it.

use rand::RngExt;
use rand::seq::SliceRandom;

use super::Ensemble;
use crate::model::Normaliser;
use crate::nn::{Tensor3, device, tensor};
use crate::replay::ReplayBuffer;
use crate::rng::Rng;

/// Floor of a normaliser's standard deviations, as a fraction of the feature's scale.
const MIN_STD: f32 = 1e-3;

/// Transitions as network inputs and targets, normalised.
pub(super) struct Data {
    pub rows: usize,
    /// `[rows, inputs]`
    inputs: Vec<f32>,
    /// `[rows, outputs]`
    targets: Vec<f32>,
}

impl Data {
    /// Inputs of the given rows, `[1, rows, inputs]`.
    pub fn inputs_of(&self, rows: &[usize]) -> Tensor3 {
        gather(&self.inputs, rows, self.rows)
    }

    /// Targets of the given rows, `[1, rows, outputs]`.
    pub fn targets_of(&self, rows: &[usize]) -> Tensor3 {
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

impl Ensemble {
    /// All transitions as inputs (observation features and action) and targets (changes of the predicted features, and the
    /// reward if it is learned). Fits both normalisers to them first.
    pub(super) fn normalised(&mut self, replay: &ReplayBuffer) -> Data {
        assert!(replay.len() >= 2, "an ensemble learns from at least two transitions");
        let (mut inputs, mut targets) = (Vec::new(), Vec::new());
        for i in 0..replay.len() {
            let row = replay.row(i);
            let (mut obs, mut next_obs) = (row.obs.to_vec(), row.next_obs.to_vec());
            self.features.canonicalize(&mut obs, Some(&mut next_obs));
            inputs.extend(self.features.inputs(&obs).chain(row.action.iter().copied()));
            targets.extend(self.features.predicted.iter().map(|i| next_obs[*i] - obs[*i]));
            if self.config.learn_reward {
                targets.push(row.reward);
            }
        }
        let floor = |i: &usize| MIN_STD * self.scales[*i];
        let unscaled = vec![MIN_STD; self.features.near.len() + self.actions];
        let input_floors: Vec<f32> = self.features.raw.iter().map(floor).chain(unscaled).collect();
        // A flag that flips in a share f of all steps changes by 1/sqrt(f) standard deviations: clipped, the flip of a rare
        // one would be predicted too small to be noticed. With this floor no flip exceeds the clip.
        let flip = 1.0 / self.config.max_target;
        let target_floor = |i: &usize| if self.flags[*i] { floor(i).max(flip) } else { floor(i) };
        let target_floors: Vec<f32> = self
            .features
            .predicted
            .iter()
            .map(target_floor)
            .chain(self.config.learn_reward.then_some(MIN_STD))
            .collect();
        self.inputs = Normaliser::fit(&inputs, &input_floors);
        self.targets = Normaliser::fit(&targets, &target_floors);
        if self.config.gated {
            // A closed gate predicts a normalised change of 0, which must mean no change, not the mean change.
            self.targets.mean.fill(0.0);
        }
        self.inputs.normalise(&mut inputs);
        self.targets.normalise(&mut targets);
        let limit = self.config.max_target;
        targets.iter_mut().for_each(|target| *target = target.clamp(-limit, limit));
        Data { rows: replay.len(), inputs, targets }
    }
}

/// The order in which one member sees its training rows.
pub(super) struct Schedule {
    rows: Vec<usize>,
    next: usize,
}

impl Schedule {
    /// The given training rows, or a bootstrap sample of them.
    pub fn new(training: &[usize], bootstrap: bool, rng: &mut Rng) -> Self {
        let drawn = |_| training[rng.random_range(0..training.len())];
        let rows = if bootstrap { (0..training.len()).map(drawn).collect() } else { training.to_vec() };
        Self { next: rows.len(), rows }
    }

    /// Rows per epoch.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// The rows of the next minibatch. Rows are shuffled at the start of each epoch; what does not fill a minibatch at its
    /// end is dropped.
    pub fn next(&mut self, batch: usize, rng: &mut Rng) -> Vec<usize> {
        if self.next + batch > self.rows.len() {
            self.rows.shuffle(rng);
            self.next = 0;
        }
        self.next += batch;
        self.rows[self.next - batch..self.next].to_vec()
    }
}
