//! The networks of an ensemble, with their optimisers and normalisation.

use super::EnsembleConfig;
use crate::checkpoint::Weights;
use crate::error::Result;
use crate::model::Normaliser;
use crate::nn::{
    Activation, Adam, AdamConfig, GroupLasso, Init, LogVarianceBounds, Mlp, MlpConfig, Norm, device,
    parameters_of_fields,
};
use crate::rng::Rng;

/// Networks that learn the same targets from the same inputs, with the normalisation of both.
#[derive(Clone, Debug)]
pub(super) struct Networks {
    pub members: Vec<Member>,
    pub inputs: Normaliser,
    pub targets: Normaliser,
    /// Factor of the predicted standard deviation of each output, fitted on the validation set.
    pub temperature: Vec<f32>,
    /// The members that predict.
    pub elites: Vec<usize>,
    /// Whether each mean is multiplied by a gate.
    pub gated: bool,
    /// A group lasso on their inputs.
    pub lasso: Option<GroupLasso>,
}

impl Networks {
    /// Networks with random weights.
    pub fn new(
        config: &EnsembleConfig,
        [inputs, outputs]: [usize; 2],
        hidden: &[usize],
        gated: bool,
        rng: &mut Rng,
    ) -> Self {
        let cpu = device();
        let shape = MlpConfig {
            members: config.members,
            input: inputs,
            hidden: hidden.to_vec(),
            output: Some(if gated { 3 } else { 2 } * outputs),
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
        Self {
            members: (0..config.members).map(member).collect(),
            inputs: Normaliser::identity(inputs),
            targets: Normaliser::identity(outputs),
            temperature: vec![1.0; outputs],
            elites: (0..config.elites).collect(),
            gated,
            lasso: None,
        }
    }
}

/// One network of the ensemble with its optimiser. Members share nothing but the data, so they train in parallel.
#[derive(Clone, Debug)]
pub(super) struct Member {
    pub learner: Learner,
    pub optimiser: Adam,
}

/// What gradients train: the network, and the bounds of its log-variance. Bounds that are not learned have no gradient.
#[derive(Clone, Debug)]
pub(super) struct Learner {
    pub network: Mlp,
    pub bounds: LogVarianceBounds,
}

parameters_of_fields!(Learner: network, bounds);

/// Checkpoints. `of` is what distinguishes the arrays of these networks from those of others: nothing, or a prefix.
impl Networks {
    /// Adds everything that predictions depend on.
    pub fn save(&self, weights: &mut Weights, of: &str) {
        for (i, member) in self.members.iter().enumerate() {
            weights.insert_module(&member_name(of, i), &member.learner);
        }
        self.inputs.save(weights, &format!("{of}inputs"));
        self.targets.save(weights, &format!("{of}targets"));
        weights.insert(format!("{of}temperature"), self.temperature.clone(), [1, 1, self.temperature.len()]);
        let elites: Vec<u64> = self.elites.iter().map(|member| *member as u64).collect();
        weights.insert_counts(format!("{of}elites"), &elites);
    }

    /// Loads what [`Networks::save`] stored.
    pub fn load(&mut self, weights: &Weights, of: &str) -> Result<()> {
        let last = self.members.len() as u64 - 1;
        let elites = weights.counts_within(&format!("{of}elites"), &vec![0..=last; self.elites.len()])?;
        let shape = [1, 1, self.temperature.len()];
        let temperature =
            weights.get_within(&format!("{of}temperature"), shape, f32::MIN_POSITIVE..=f32::MAX)?.to_vec();
        for (i, member) in self.members.iter_mut().enumerate() {
            weights.load_module(&member_name(of, i), &mut member.learner)?;
        }
        self.inputs.load(weights, &format!("{of}inputs"))?;
        self.targets.load(weights, &format!("{of}targets"))?;
        self.elites = elites.into_iter().map(|member| member as usize).collect();
        self.temperature = temperature;
        Ok(())
    }

    /// Adds the state of the optimisers.
    pub fn save_training_state(&self, state: &mut Weights, of: &str) {
        for (i, member) in self.members.iter().enumerate() {
            member.optimiser.save(state, &member_name(of, i));
        }
    }

    /// Loads what [`Networks::save_training_state`] stored.
    pub fn load_training_state(&mut self, state: &Weights, of: &str) -> Result<()> {
        for (i, member) in self.members.iter_mut().enumerate() {
            member.optimiser.load(state, &member_name(of, i), &member.learner)?;
        }
        Ok(())
    }
}

/// Prefix of a member's arrays in a checkpoint.
fn member_name(of: &str, member: usize) -> String {
    format!("{of}ensemble.{member}")
}
