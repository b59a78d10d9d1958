//! A snapshot of an ensemble for prediction.

use dfdx::tensor::Cpu;

use super::ensemble::LearnedReward;
use super::uncertainty::split;
use super::{FeatureMap, Normaliser};
use crate::nn::frozen::{Feature, FrozenMlp, PANEL, Panels};
use crate::nn::kernels::{sigmoid, tanh, vectorised_fn};
use crate::nn::{Activation, Mlp, bounded_variance};

/// The elites of an [`Ensemble`](super::Ensemble) with fixed weights. Observations, changes and variances are in physical
/// units, those of [`crate::env::Feature`].
#[doc(alias = "dynamics model")]
#[doc(alias = "transition model")]
#[derive(Clone, Debug)]
pub struct Dynamics {
    members: Vec<FrozenMlp>,
    pub(super) features: FeatureMap,
    actions: usize,
    pub(super) inputs: Normaliser,
    pub(super) targets: Normaliser,
    /// Minimum precision and minimum variance of each output, normalised, for each member: see [`bounded_variance`].
    floors: Vec<[Vec<f32>; 2]>,
    temperature: Vec<f32>,
    reward: Option<LearnedReward>,
}

/// The ensemble's prediction of one time step: one entry for each predicted feature, in the order of
/// [`Dynamics::typical_changes`].
///
/// `aleatoric + epistemic` is the total variance of the mixture of all members.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Mean of each predicted feature of the next observation: the mean of the members' means.
    pub mean: Vec<f64>,
    /// Aleatoric variance (noise of the environment): the mean of the members' variances.
    pub aleatoric: Vec<f64>,
    /// Epistemic variance (too few data): the variance of the members' means.
    pub epistemic: Vec<f64>,
}

/// Reusable buffers of a forward pass.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// Indices of the rows in the batch.
    rows: Vec<usize>,
    panels: Panels,
    /// Network outputs, row by row.
    heads: Vec<f32>,
    /// An observation with its cubes in canonical orientation.
    canonical: Vec<f32>,
}

impl Dynamics {
    pub(super) fn new<'a>(
        members: impl Iterator<Item = (FrozenMlp, [&'a [f32]; 2])>,
        features: FeatureMap,
        actions: usize,
        inputs: Normaliser,
        targets: Normaliser,
        temperature: Vec<f32>,
    ) -> Self {
        let floors = |[max, min]: [&[f32]; 2]| {
            [max.iter().map(|max| (-max).exp()).collect(), min.iter().map(|min| min.exp()).collect()]
        };
        let (members, floors) = members.map(|(network, bounds)| (network, floors(bounds))).unzip();
        Self { members, features, actions, inputs, targets, floors, temperature, reward: None }
    }

    pub(super) fn with_reward(self, reward: Option<LearnedReward>) -> Self {
        Self { reward, ..self }
    }

    /// Number of members.
    pub fn members(&self) -> usize {
        self.members.len()
    }

    /// One member alone: an ensemble of one, with the learned reward's member of the same index, if there is one.
    ///
    /// # Panics
    /// If there is no such member.
    #[must_use]
    pub fn member(&self, member: usize) -> Self {
        Self {
            members: vec![self.members[member].clone()],
            features: self.features.clone(),
            actions: self.actions,
            inputs: self.inputs.clone(),
            targets: self.targets.clone(),
            floors: vec![self.floors[member].clone()],
            temperature: self.temperature.clone(),
            reward: self.reward.as_ref().map(|reward| reward.member(member)),
        }
    }

    /// Features in an observation.
    pub fn observation_size(&self) -> usize {
        self.features.width
    }

    /// Components of an action.
    pub fn action_size(&self) -> usize {
        self.actions
    }

    /// The learned reward; none unless [`EnsembleConfig::learn_reward`](super::EnsembleConfig::learn_reward) is set.
    pub fn learned_reward(&self) -> Option<&LearnedReward> {
        self.reward.as_ref()
    }

    /// Index of each predicted feature of an observation, with the standard deviation of its change per time step in the
    /// training data. The other features are constant or follow from these.
    pub fn typical_changes(&self) -> impl Iterator<Item = (usize, f32)> + Clone + '_ {
        self.features.predicted.iter().copied().zip(self.targets.scale.iter().copied())
    }

    /// Predicts the observation one time step after taking `action` in `obs`.
    ///
    /// # Panics
    /// If `obs` or `action` has the wrong length.
    #[doc(alias = "epistemic")]
    #[doc(alias = "aleatoric")]
    pub fn predict(&self, obs: &[f32], action: &[f32]) -> Prediction {
        let (means, variances) = self.member_predictions(obs, action);
        let [mean, aleatoric, epistemic] = split(&means, &variances);
        Prediction { mean, aleatoric, epistemic }
    }

    /// Mean and variance of the next observation according to each member, `[members][outputs]`, with outputs as in
    /// [`Prediction`].
    ///
    /// # Panics
    /// If `obs` or `action` has the wrong length.
    pub fn member_predictions(&self, obs: &[f32], action: &[f32]) -> (Vec<Vec<f64>>, Vec<Vec<f64>>) {
        let outputs = self.outputs();
        let mut scratch = Scratch::default();
        let predict = |member: usize| {
            let head = self.forward(member, 0..1, obs, action, &mut scratch);
            let (change, std) = head.split_at(outputs);
            let before = self.features.predicted.iter().map(|i| obs[*i]);
            let mean = change.iter().zip(before).map(|(change, before)| f64::from(before) + f64::from(*change));
            (mean.collect(), std.iter().map(|std| f64::from(*std).powi(2)).collect())
        };
        (0..self.members()).map(predict).unzip()
    }

    /// The same networks as dfdx modules, for gradients.
    pub(super) fn networks(&self, cpu: &Cpu) -> Mlp {
        let members: Vec<Vec<_>> = self.members.iter().map(|member| member.layers().collect()).collect();
        Mlp::from_layers(cpu, &members, Activation::Silu)
    }

    /// Outputs: predicted features.
    pub(super) fn outputs(&self) -> usize {
        self.targets.mean.len()
    }

    /// Whether the networks output a gate for each mean, after means and log-variances.
    pub(super) fn gated(&self) -> bool {
        self.members[0].outputs() > 2 * self.outputs()
    }

    /// Forward pass of one member for the given rows of `states` and `actions`. Returns `[rows, 2 outputs]` in physical
    /// units: mean changes, then standard deviations.
    pub(super) fn forward<'a>(
        &self,
        member: usize,
        rows: impl Iterator<Item = usize>,
        states: &[f32],
        actions: &[f32],
        scratch: &'a mut Scratch,
    ) -> &'a mut [f32] {
        let Scratch { rows: batch, panels, heads, canonical } = scratch;
        let state_of = |row: usize| &states[row * self.features.width..][..self.features.width];
        let network = &self.members[member];
        batch.clear();
        batch.extend(rows);
        heads.clear();
        for rows in batch.chunks(PANEL) {
            let x = panels.input(network.inputs());
            for (place, &row) in rows.iter().enumerate() {
                let (mut state, action) = (state_of(row), &actions[row * self.actions..][..self.actions]);
                if !self.features.cubes.is_empty() {
                    canonical.clear();
                    canonical.extend_from_slice(state);
                    self.features.canonicalize(canonical, None);
                    state = canonical;
                }
                let inputs = self.features.linear_inputs(state).chain(action.iter().copied());
                x.iter_mut().zip(inputs).for_each(|(x, value)| x.0[place] = value);
            }
            tanh_panel(&mut x[self.features.raw.len()..][..self.features.near.len()]);
            self.inputs.normalise_panel(x);
            let y = network.forward(panels);
            let Normaliser { mean, scale } = &self.targets;
            let [precision, variance] = &self.floors[member];
            denormalise(y, mean, scale, precision, variance, &self.temperature);
            (0..rows.len()).for_each(|place| heads.extend(y[..2 * self.outputs()].iter().map(|y| y.0[place])));
        }
        if !self.features.cubes.is_empty() {
            for (&row, head) in batch.iter().zip(heads.chunks_exact_mut(2 * self.outputs())) {
                let (changes, stds) = head.split_at_mut(self.outputs());
                self.features.decanonicalize(state_of(row), changes, stds);
            }
        }
        heads
    }
}

vectorised_fn! {
    /// Takes normalised means to changes, through their gates if there are any, and raw log-variances to standard deviations,
    /// both in physical units.
    fn denormalise(
        y: &'a mut [Feature],
        mean: &'a [f32],
        scale: &'a [f32],
        min_precision: &'a [f32],
        min_variance: &'a [f32],
        temperature: &'a [f32],
    ) {
        let n = mean.len();
        let (means, rest) = y.split_at_mut(n);
        let (stds, gates) = rest.split_at_mut(n);
        for i in 0..n {
            let (Feature(mean_of_rows), Feature(std)) = (&mut means[i], &mut stds[i]);
            if let Some(Feature(gate)) = gates.get(i) {
                (0..PANEL).for_each(|row| mean_of_rows[row] *= sigmoid(gate[row]));
            }
            let (mean, scale, factor) = (mean[i], scale[i], temperature[i]);
            mean_of_rows.iter_mut().for_each(|x| *x = x.mul_add(scale, mean));
            let (precision, variance) = (min_precision[i], min_variance[i]);
            std.iter_mut().for_each(|x| *x = bounded_variance(*x, precision, variance).sqrt() * factor * scale);
        }
    }
}

vectorised_fn! {
    fn tanh_panel(x: &'a mut [Feature]) {
        x.iter_mut().for_each(|Feature(x)| x.iter_mut().for_each(|x| *x = tanh(*x)));
    }
}
