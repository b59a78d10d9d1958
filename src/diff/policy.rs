//! Analytic policy gradients.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use nalgebra::SVector;
use num_dual::Dual64;
use serde::{Deserialize, Serialize};

use super::System;
use crate::nn::ops::{join, map_rows, record, total};
use crate::nn::{Activation, Adam, AdamConfig, Grad, Init, Mlp, MlpConfig, Norm, Tensor3, device, tensor, values};
use crate::rng::Rng;
use crate::settings::{must_hold, ranges};

/// A [`System`] as an environment for [`AnalyticPolicyGradient`]: with observations of `O` numbers and initial states.
pub trait PolicyEnv<const N: usize, const M: usize, const O: usize>: System<N, M> {
    /// The observation of a state, numbers of order one.
    fn observe<S: nalgebra::RealField + Copy>(&self, state: &SVector<S, N>) -> SVector<S, O>;

    /// A random initial state.
    fn start(&self, rng: &mut Rng) -> SVector<f64, N>;
}

/// Settings of [`AnalyticPolicyGradient`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AnalyticPolicyGradientConfig {
    /// Width of each hidden layer.
    pub hidden: Vec<usize>,
    /// Learning rate of Adam.
    pub learning_rate: f32,
    /// Gradients are clipped to this norm: through contact, or in chaotic dynamics, they explode.
    pub max_norm: f32,
    /// Systems simulated in parallel.
    pub worlds: usize,
    /// Steps that gradients flow through.
    pub window: usize,
    /// Steps in an episode, after which a system starts anew. If episodes are long, a policy that balances well sees nothing
    /// but balancing, and forgets how to get there.
    pub episode: usize,
}

impl Default for AnalyticPolicyGradientConfig {
    fn default() -> Self {
        Self { hidden: vec![64, 64], learning_rate: 2e-3, max_norm: 1.0, worlds: 4, window: 32, episode: 64 }
    }
}

ranges!(AnalyticPolicyGradientConfig {
    hidden: 1..=4096,
    learning_rate: 0.0..=1.0,
    max_norm: 1e-6..=1e6,
    worlds: 1..=10_000,
    window: 1..=10_000,
    episode: 1..=1_000_000,
});

/// A policy network and the systems that it is trained on.
///
/// Analytic policy gradients: a policy network trained by backpropagation through time, through a differentiable simulator.
///
/// Each update rolls several systems out for a short horizon (the window), sums their costs, and differentiates the sum through
/// simulator and network: the simulator's Jacobians come from dual numbers, the network's from dfdx's tape, on which both
/// are recorded. The next window goes on from the states where this one ended, but no gradient flows between windows
/// (truncated backpropagation). Short windows are the idea of SHAC (Xu et al. 2022); unlike there, no critic values the
/// state that a window ends in.
///
/// ```
/// use handful::diff::{AnalyticPolicyGradient, AnalyticPolicyGradientConfig, PendulumSwing};
/// use handful::nalgebra::Vector3;
/// use handful::rng;
///
/// let mut rng = rng::stream(0, "example");
/// let mut training = AnalyticPolicyGradient::new(&PendulumSwing, AnalyticPolicyGradientConfig::default(), &mut rng);
/// let mean_cost = training.update(&PendulumSwing, &mut rng);
/// assert!(mean_cost > 0.0 && training.steps == 4 * 32);
/// let torque = training.act(&Vector3::new(-1.0, 0.0, 0.0))[0];
/// assert!((-1.0..=1.0).contains(&torque));
/// ```
#[doc(alias = "APG")]
#[doc(alias = "SHAC")]
#[doc(alias = "short-horizon actor-critic")]
#[doc(alias = "backpropagation through time")]
#[derive(Debug)]
pub struct AnalyticPolicyGradient<const N: usize, const M: usize, const O: usize> {
    config: AnalyticPolicyGradientConfig,
    policy: Mlp,
    optimiser: Adam,
    /// State and age (steps) of each system.
    worlds: Vec<(SVector<f64, N>, usize)>,
    /// Steps simulated so far.
    pub steps: usize,
}

impl<const N: usize, const M: usize, const O: usize> AnalyticPolicyGradient<N, M, O> {
    /// An untrained policy, whose actions are near zero.
    ///
    /// # Panics
    /// If a setting lies outside its range.
    pub fn new(system: &impl PolicyEnv<N, M, O>, config: AnalyticPolicyGradientConfig, rng: &mut Rng) -> Self {
        must_hold(&config, "policy");
        let shape = MlpConfig {
            members: 1,
            input: O,
            hidden: config.hidden.clone(),
            output: Some(M),
            norm: Norm::None,
            activation: Activation::Silu,
            init: Init::TruncatedNormal,
        };
        let optimiser = AdamConfig { max_norm: Some(config.max_norm), ..AdamConfig::new(config.learning_rate) };
        // Of different ages, so that they do not all start anew at once.
        let apart = config.episode / config.worlds;
        Self {
            policy: Mlp::new(&device(), &shape, rng).scale_output(0.1),
            optimiser: Adam::new(optimiser),
            worlds: (0..config.worlds).map(|i| (system.start(rng), i * apart)).collect(),
            steps: 0,
            config,
        }
    }

    /// The policy's action for an observation, each component in [-1, 1].
    pub fn act(&self, observation: &SVector<f32, O>) -> SVector<f32, M> {
        let seen = tensor(&device(), observation.as_slice().to_vec(), (1, 1, O));
        SVector::from_column_slice(values(&self.policy.forward(seen, Grad::Input).tanh()))
    }

    /// One gradient step on one window of every system. Returns the mean cost of a step.
    pub fn update(&mut self, system: &impl PolicyEnv<N, M, O>, rng: &mut Rng) -> f32 {
        let AnalyticPolicyGradientConfig { window, episode, .. } = self.config;
        for (state, age) in self.worlds.iter_mut().filter(|(_, age)| *age >= episode) {
            (*state, *age) = (system.start(rng), 0);
        }
        let states = self.worlds.iter().flat_map(|(state, _)| state.iter().map(|x| *x as f32)).collect();
        let mut state = tensor(&device(), states, (1, self.worlds.len(), N));
        let (mut tape, mut costs) = (OwnedTape::default(), Vec::with_capacity(window));
        for _ in 0..window {
            let observe = |x: &[Dual64]| system.observe(&part(x)).as_slice().to_vec();
            let seen = record(&mut tape, &state, |state| simulated(state, O, observe));
            let action = record(&mut tape, &seen, |seen| self.policy.forward(seen, Grad::Both).tanh());
            let both = record(&mut tape, &state, |state| join(state, action));
            let cost = |x: &[Dual64]| vec![system.cost(&part(&x[..N]), &part(&x[N..]))];
            costs.push((1.0 / window as f32, record(&mut tape, &both, |both| simulated(both, 1, cost))));
            let step = |x: &[Dual64]| system.step(&part(&x[..N]), &part(&x[N..])).as_slice().to_vec();
            state = record(&mut tape, &both, |both| simulated(both, N, step));
        }
        let loss = total(tape, &costs);
        let cost = loss.array();
        self.optimiser.step(&mut self.policy, &mut loss.backward());
        for ((old, age), new) in self.worlds.iter_mut().zip(values(&state).chunks_exact(N)) {
            (*old, *age) = (SVector::from_fn(|i, _| f64::from(new[i])), *age + window);
        }
        self.steps += self.worlds.len() * window;
        cost
    }
}

fn part<const N: usize>(x: &[Dual64]) -> SVector<Dual64, N> {
    SVector::from_column_slice(x)
}

/// Applies a function of the simulator to each row of `x`; its Jacobian by forward mode, a dual number in each input in turn.
fn simulated<T: Tape<f32, Cpu>>(x: Tensor3<T>, outputs: usize, f: impl Fn(&[Dual64]) -> Vec<Dual64>) -> Tensor3<T> {
    map_rows(x, outputs, |_, row, value, jacobian| {
        let mut inputs: Vec<Dual64> = row.iter().map(|x| Dual64::from_re(f64::from(*x))).collect();
        for i in 0..inputs.len() {
            inputs[i].eps = 1.0;
            for (j, output) in f(&inputs).into_iter().enumerate() {
                value[j] = output.re as f32;
                jacobian[j * inputs.len() + i] = output.eps as f32;
            }
            inputs[i].eps = 0.0;
        }
    })
}
