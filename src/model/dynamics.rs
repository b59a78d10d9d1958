//! A snapshot of an ensemble that predicts.

use dfdx::tensor::Cpu;

use super::uncertainty::split;
use super::{FeatureMap, Normaliser};
use crate::nn::frozen::{FrozenMlp, PANEL, Panels};
use crate::nn::kernels::vectorised_fn;
use crate::nn::{Activation, Mlp, bounded_variance, ops};

/// Elites of an ensemble, frozen. All predictions are in physical units unless said otherwise.
#[derive(Clone, Debug)]
pub struct Dynamics {
    members: Vec<FrozenMlp>,
    pub(super) layout: FeatureMap,
    actions: usize,
    pub(super) inputs: Normaliser,
    pub(super) targets: Normaliser,
    /// Least precision and least variance of each output, normalised, for each member: see [`bounded_variance`].
    least: Vec<[Vec<f32>; 2]>,
    temperature: Vec<f32>,
}

/// What all members together say of one step, for each number of an observation that is predicted (see
/// [`Dynamics::typical_changes`]; and then of the reward, if it was learned).
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// The expected observation after the step.
    pub mean: Vec<f64>,
    /// Variance by chance: the mean of the members' variances.
    pub aleatoric: Vec<f64>,
    /// Variance by ignorance: the variance of the members' means.
    pub epistemic: Vec<f64>,
}

/// Buffers of a forward pass, to be used again.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// The rows that are asked for.
    rows: Vec<usize>,
    panels: Panels,
    /// The answers, row by row.
    heads: Vec<f32>,
    /// A state with its cubes upright.
    upright: Vec<f32>,
}

impl Dynamics {
    pub(super) fn new<'a>(
        members: impl Iterator<Item = (FrozenMlp, [&'a [f32]; 2])>,
        layout: FeatureMap,
        actions: usize,
        inputs: Normaliser,
        targets: Normaliser,
        temperature: Vec<f32>,
    ) -> Self {
        let least = |[max, min]: [&[f32]; 2]| {
            [max.iter().map(|max| (-max).exp()).collect(), min.iter().map(|min| min.exp()).collect()]
        };
        let (members, least) = members.map(|(network, bounds)| (network, least(bounds))).unzip();
        Self { members, layout, actions, inputs, targets, least, temperature }
    }

    /// Networks.
    pub fn members(&self) -> usize {
        self.members.len()
    }

    /// Numbers in an observation.
    pub fn observation_size(&self) -> usize {
        self.layout.width
    }

    /// Numbers in an action.
    pub fn action_size(&self) -> usize {
        self.actions
    }

    /// Whether the reward was learned as well.
    pub fn predicts_reward(&self) -> bool {
        self.outputs() > self.layout.predicted.len()
    }

    /// The numbers of an observation that it predicts (the others follow from them), and the standard deviation of
    /// the change of each in the data.
    pub fn typical_changes(&self) -> impl Iterator<Item = (usize, f32)> + Clone + '_ {
        self.layout.predicted.iter().copied().zip(self.targets.scale.iter().copied())
    }

    /// What the members say of one step from `obs` by `action`.
    pub fn predict(&self, obs: &[f32], action: &[f32]) -> Prediction {
        let (means, variances) = self.member_predictions(obs, action);
        let [mean, aleatoric, epistemic] = split(&means, &variances);
        Prediction { mean, aleatoric, epistemic }
    }

    /// Mean and variance that each member gives for what is predicted of the observation after a step (and the reward, if
    /// learned).
    pub fn member_predictions(&self, obs: &[f32], action: &[f32]) -> (Vec<Vec<f64>>, Vec<Vec<f64>>) {
        let outputs = self.outputs();
        let mut scratch = Scratch::default();
        let opinion = |member: usize| {
            let head = self.ask(member, 0..1, obs, action, &mut scratch);
            let (change, deviation) = head.split_at(outputs);
            // A reward is predicted as it is, an observation by its change.
            let before = self.layout.predicted.iter().map(|i| obs[*i]).chain(std::iter::repeat(0.0));
            let mean = change.iter().zip(before).map(|(change, before)| f64::from(before) + f64::from(*change));
            (mean.collect(), deviation.iter().map(|d| f64::from(*d).powi(2)).collect())
        };
        (0..self.members()).map(opinion).unzip()
    }

    /// The same networks on dfdx, to be differentiated.
    pub(super) fn networks(&self, cpu: &Cpu) -> Mlp {
        let members: Vec<Vec<_>> = self.members.iter().map(|member| member.layers().collect()).collect();
        Mlp::from_layers(cpu, &members, Activation::Silu)
    }

    /// Numbers that are predicted.
    pub(super) fn outputs(&self) -> usize {
        self.targets.mean.len()
    }

    /// Whether the networks have a gate for each mean, behind mean and log-variance.
    pub(super) fn gated(&self) -> bool {
        self.members[0].outputs() > 2 * self.outputs()
    }

    /// What one member says of the given rows of states and actions, `[rows, 2 outputs]`: changes, and then standard
    /// deviations.
    pub(super) fn ask<'a>(
        &self,
        member: usize,
        rows: impl Iterator<Item = usize>,
        states: &[f32],
        actions: &[f32],
        scratch: &'a mut Scratch,
    ) -> &'a mut [f32] {
        let Scratch { rows: asked, panels, heads, upright } = scratch;
        let state_of = |row: usize| &states[row * self.layout.width..][..self.layout.width];
        let network = &self.members[member];
        asked.clear();
        asked.extend(rows);
        heads.clear();
        for rows in asked.chunks(PANEL) {
            let x = panels.input(network.inputs());
            for (place, &row) in rows.iter().enumerate() {
                let (mut state, action) = (state_of(row), &actions[row * self.actions..][..self.actions]);
                if !self.layout.cubes.is_empty() {
                    upright.clear();
                    upright.extend_from_slice(state);
                    self.layout.canonicalize(upright, None);
                    state = upright;
                }
                let read = self.layout.read(state).chain(action.iter().copied());
                x.iter_mut().zip(read).for_each(|(x, value)| x.0[place] = value);
            }
            self.inputs.normalise_panel(x);
            let y = network.forward(panels);
            (0..rows.len()).for_each(|place| heads.extend(y.iter().map(|y| y.0[place])));
        }
        if self.gated() {
            ops::gate_rows(heads, self.outputs());
        }
        let Normaliser { mean, scale } = &self.targets;
        let [precision, variance] = &self.least[member];
        denormalise(heads, mean, scale, precision, variance, &self.temperature);
        if !self.layout.cubes.is_empty() {
            for (&row, head) in asked.iter().zip(heads.chunks_exact_mut(2 * self.outputs())) {
                let (changes, deviations) = head.split_at_mut(self.outputs());
                self.layout.decanonicalize(state_of(row), changes, deviations);
            }
        }
        heads
    }
}

vectorised_fn! {
    /// Normalised means become changes, raw log-variances become standard deviations.
    fn denormalise(
        head: &'a mut [f32],
        mean: &'a [f32],
        scale: &'a [f32],
        least_precision: &'a [f32],
        least_variance: &'a [f32],
        temperature: &'a [f32],
    ) {
        let n = mean.len();
        let (precision, variance) = (&least_precision[..n], &least_variance[..n]);
        let (scale, temperature) = (&scale[..n], &temperature[..n]);
        for row in head.chunks_exact_mut(2 * n) {
            let (means, raw) = row.split_at_mut(n);
            let raw = &mut raw[..n];
            for i in 0..n {
                means[i] = means[i].mul_add(scale[i], mean[i]);
                raw[i] = bounded_variance(raw[i], precision[i], variance[i]).sqrt() * temperature[i] * scale[i];
            }
        }
    }
}
