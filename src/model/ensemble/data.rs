//! The training set: normalised inputs and targets, and the minibatches drawn from it.

use rand::RngExt;
use rand::seq::SliceRandom;

use super::networks::Networks;
use crate::model::Normaliser;
use crate::nn::{Tensor3, device, tensor};
use crate::rng::Rng;

/// Transitions as network inputs and targets, normalised.
pub(super) struct Data {
    pub rows: usize,
    /// `[rows, inputs]`
    inputs: Vec<f32>,
    /// `[rows, outputs]`
    targets: Vec<f32>,
}

impl Data {
    /// Normalises physical inputs (`[rows, inputs]`) and targets (`[rows, outputs]`), having fitted the normalisers of
    /// `networks` to them with these floors of the standard deviations, and clips both, normalised, to these limits.
    pub fn new(
        networks: &mut Networks,
        [mut inputs, mut targets]: [Vec<f32>; 2],
        [input_floors, target_floors]: [&[f32]; 2],
        [max_input, max_target]: [f32; 2],
    ) -> Self {
        networks.inputs = Normaliser::fit(&inputs, input_floors);
        networks.targets = Normaliser::fit(&targets, target_floors);
        if networks.gated {
            // A closed gate predicts a normalised change of 0, which must mean no change, not the mean change.
            networks.targets.mean.fill(0.0);
        }
        networks.inputs.normalise(&mut inputs);
        networks.targets.normalise(&mut targets);
        inputs.iter_mut().for_each(|input| *input = input.clamp(-max_input, max_input));
        targets.iter_mut().for_each(|target| *target = target.clamp(-max_target, max_target));
        Self { rows: inputs.len() / input_floors.len(), inputs, targets }
    }

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
