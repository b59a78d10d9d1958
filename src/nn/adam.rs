//! Adam (Kingma & Ba 2015, Algorithm 1), with gradient clipping and decoupled weight decay (AdamW); and LaProp (Ziyin et
//! al. 2020), which normalises the gradient before it enters the first moment.

use std::collections::BTreeMap;
use std::ops::{AddAssign, Mul, Sub};

use dfdx::tensor::{Cpu, Gradients};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::kernels::vectorised_fn;
use super::{Parameters, Weights, values, values_mut};
use crate::error::Result;

/// Settings of [`Adam`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AdamConfig {
    /// Step size.
    pub learning_rate: f32,
    /// Decay rates of the two moment estimates, beta1 and beta2.
    pub betas: [f32; 2],
    /// Added to the root of the second moment, in the denominator of a step.
    pub epsilon: f32,
    /// Gradients with a larger norm, over all parameters together, are scaled down to it.
    pub max_norm: Option<f32>,
    /// Decoupled weight decay (AdamW, Loshchilov & Hutter 2019): in a step, a weight loses `learning_rate` times this
    /// share of itself, whatever its gradient. Biases and other parameters do not decay.
    #[doc(alias = "AdamW")]
    pub weight_decay: f32,
    /// LaProp: gradients are divided by the root of their second moment before they enter the first moment; Adam divides
    /// the first moment instead.
    #[doc(alias = "LaProp")]
    pub normalise_first: bool,
    /// Adaptive gradient clipping (AGC; Brock et al. 2021, for whole tensors as in DreamerV3): a gradient with a norm larger
    /// than this share of its parameter's norm (1e-3 at least) is scaled down to it.
    #[doc(alias = "AGC")]
    pub adaptive_clip: Option<f32>,
    /// Steps over which the step size grows linearly from zero to `learning_rate`.
    pub warm_up: u32,
}

impl AdamConfig {
    /// The usual settings at this learning rate, without clipping.
    pub fn new(learning_rate: f32) -> Self {
        Self {
            learning_rate,
            betas: [0.9, 0.999],
            epsilon: 1e-8,
            max_norm: None,
            weight_decay: 0.0,
            normalise_first: false,
            adaptive_clip: None,
            warm_up: 0,
        }
    }

    /// DreamerV3's optimiser at this learning rate: LaProp, clipped parameter by parameter, 1000 steps of warm-up.
    pub fn laprop(learning_rate: f32) -> Self {
        Self {
            epsilon: 1e-20,
            normalise_first: true,
            adaptive_clip: Some(0.3),
            warm_up: 1000,
            ..Self::new(learning_rate)
        }
    }
}

/// The Adam optimiser, with its state for one module's parameters.
///
/// ```
/// use handful::nn::dfdx::prelude::*;
/// use handful::nn::{Activation, Adam, AdamConfig, Grad, Init, Mlp, MlpConfig, Norm, device, tensor};
/// use handful::rng;
///
/// let cpu = device();
/// let (activation, init) = (Activation::Silu, Init::Uniform);
/// let config = MlpConfig { members: 1, input: 1, hidden: vec![8], output: Some(1), norm: Norm::None, activation, init };
/// let mut mlp = Mlp::new(&cpu, &config, &mut rng::stream(0, "example"));
/// let mut adam = Adam::new(AdamConfig::new(1e-2));
/// let mut losses = Vec::new();
/// for _ in 0..100 {
///     let x = tensor(&cpu, vec![-1.0, 0.0, 1.0], (1, 3, 1));
///     let y = tensor(&cpu, vec![1.0, 0.0, 1.0], (1, 3, 1));
///     let loss = (mlp.forward(x.leaky_traced(), Grad::Params) - y).square().mean();
///     losses.push(loss.array());
///     adam.step(&mut mlp, &mut loss.backward());
/// }
/// assert!(losses[99] < 0.5 * losses[0]);
/// ```
#[derive(Clone, Debug)]
pub struct Adam {
    config: AdamConfig,
    steps: u32,
    /// Parameters whose names begin so learn at this multiple of the rate.
    slower: Option<(&'static str, f32)>,
    /// First and second moments of each parameter, by its name.
    moments: BTreeMap<String, [Vec<f32>; 2]>,
}

impl Adam {
    /// A new optimiser, with moments of zero.
    pub fn new(config: AdamConfig) -> Self {
        Self { config, steps: 0, slower: None, moments: BTreeMap::new() }
    }

    /// The same optimiser, but parameters whose names begin with `prefix` learn at `factor` times the rate.
    #[must_use]
    pub fn with_slower(self, prefix: &'static str, factor: f32) -> Self {
        Self { slower: Some((prefix, factor)), ..self }
    }

    /// How many steps it has made.
    pub fn steps(&self) -> u64 {
        self.steps.into()
    }

    /// The step size after its warm-up.
    pub fn learning_rate(&self) -> f32 {
        self.config.learning_rate
    }

    /// Changes the step size from the next step on.
    pub fn set_learning_rate(&mut self, learning_rate: f32) {
        self.config.learning_rate = learning_rate;
    }

    /// One step against `gradients`. Returns their global norm before clipping. A parameter on which the loss does not
    /// depend has a gradient of zero.
    pub fn step(&mut self, module: &mut impl Parameters, gradients: &mut Gradients<f32, Cpu>) -> f32 {
        // Every parameter with its gradient and its moments is a task for one thread.
        let work = module.parameters_mut().into_iter().map(|(name, parameter)| {
            let gradient =
                std::mem::take(&mut **gradients.get_or_alloc_mut(&*parameter).expect("memory for a gradient"));
            let zeros = || [vec![0.0; gradient.len()], vec![0.0; gradient.len()]];
            let moments = self.moments.remove(&name).unwrap_or_else(zeros);
            (name, parameter, gradient, moments)
        });
        let mut work: Vec<_> = work.collect();
        // With few numbers, a second core costs more than it saves.
        let few = work.iter().map(|(_, _, gradient, _)| gradient.len()).sum::<usize>() < 65_536;
        let least = if few { usize::MAX } else { 1 };
        let norms = work.par_iter().with_min_len(least);
        let squares: Vec<f64> = norms.map(|(_, _, gradient, _)| sum_of_squares(gradient)).collect();
        let norm = squares.iter().sum::<f64>().sqrt() as f32;
        let clip = self.config.max_norm.map_or(1.0, |max| (max / norm.max(f32::MIN_POSITIVE)).min(1.0));
        self.steps += 1;
        let (rule, slower) = (Rule::new(&self.config, self.steps, clip), self.slower);
        work.par_iter_mut().with_min_len(least).for_each(|(name, parameter, gradient, [first, second])| {
            let decay =
                if name.ends_with("weight") { self.config.learning_rate * self.config.weight_decay } else { 0.0 };
            let parameter = values_mut(parameter);
            let adaptive = self.config.adaptive_clip.map_or(1.0, |share| {
                let [size, slope] = [&*parameter, &*gradient].map(|numbers| sum_of_squares(numbers).sqrt() as f32);
                (share * size.max(1e-3) / slope.max(f32::MIN_POSITIVE)).min(1.0)
            });
            let mut rule = Rule { decay, clip: clip * adaptive, ..rule };
            if let Some((_, factor)) = slower.filter(|(prefix, _)| name.starts_with(prefix)) {
                rule.rate *= factor;
            }
            if self.config.normalise_first {
                update_normalised(parameter, gradient, first, second, rule);
            } else {
                update(parameter, gradient, first, second, rule);
            }
        });
        self.moments = work.into_iter().map(|(name, _, _, moments)| (name, moments)).collect();
        norm
    }

    /// Writes the optimiser's state into `weights`, under `prefix`.
    pub fn save(&self, weights: &mut Weights, prefix: &str) {
        weights.insert(format!("{prefix}.steps"), vec![self.steps as f32], [1, 1, 1]);
        for (name, [first, second]) in &self.moments {
            weights.insert(format!("{prefix}.first.{name}"), first.clone(), [1, 1, first.len()]);
            weights.insert(format!("{prefix}.second.{name}"), second.clone(), [1, 1, second.len()]);
        }
    }

    /// Reads the state that [`Adam::save`] wrote for an optimiser of `module`.
    ///
    /// # Errors
    /// If a part is missing or has another size, or the number of steps cannot be.
    pub fn load(&mut self, weights: &Weights, prefix: &str, module: &impl Parameters) -> Result<()> {
        self.steps = weights.get_within(&format!("{prefix}.steps"), [1, 1, 1], 0.0..=1e9)?[0] as u32;
        self.moments.clear();
        if self.steps > 0 {
            for (name, parameter) in module.parameters() {
                let size = [1, 1, values(parameter).len()];
                let moments = ["first", "second"]
                    .map(|which| weights.get(&format!("{prefix}.{which}.{name}"), size).map(<[f32]>::to_vec));
                let [first, second] = moments;
                self.moments.insert(name, [first?, second?]);
            }
        }
        Ok(())
    }
}

/// One Adam step for one number (Kingma & Ba 2015, Algorithm 1), up to the step itself: both moments take in the
/// `gradient` g, with the weights `gains` = [1 - beta1, 1 - beta2],
///
/// ```text
/// m <- m + (1 - beta1) (g - m)
/// v <- v + (1 - beta2) (g^2 - v)
/// ```
///
/// and `unbiased` makes of them m_hat = m / (1 - beta1^t) and v_hat = v / (1 - beta2^t), which are returned. The caller
/// descends by rate * m_hat / (sqrt(v_hat) + epsilon). (`unbiased` and the last line are the callers' because they round in
/// different orders, on which published numbers depend.)
#[inline(always)]
pub(crate) fn adam_step<T: Number>(
    gradient: T,
    [first, second]: [&mut T; 2],
    gains: [T; 2],
    unbiased: impl Fn([T; 2]) -> [T; 2],
) -> [T; 2] {
    average(first, gains[0], gradient);
    average(second, gains[1], gradient * gradient);
    unbiased([*first, *second])
}

/// An exponential moving average takes in a value.
#[inline(always)]
fn average<T: Number>(average: &mut T, gain: T, value: T) {
    *average += gain * (value - *average);
}

/// f32 or f64.
pub(crate) trait Number: Copy + AddAssign + Sub<Output = Self> + Mul<Output = Self> {}

impl Number for f32 {}
impl Number for f64 {}

/// The constants of a step, the same for each number of a parameter.
#[derive(Clone, Copy)]
struct Rule {
    betas: [f32; 2],
    /// The bias corrections of both moments, 1 / (1 - beta^t).
    corrections: [f32; 2],
    rate: f32,
    epsilon: f32,
    clip: f32,
    decay: f32,
}

impl Rule {
    fn new(config: &AdamConfig, steps: u32, clip: f32) -> Self {
        let corrections = config.betas.map(|beta| (1.0 / (1.0 - f64::from(beta).powi(steps as i32))) as f32);
        let warm = if steps < config.warm_up { (steps - 1) as f32 / config.warm_up as f32 } else { 1.0 };
        let rate = warm * config.learning_rate;
        Self { betas: config.betas, corrections, rate, epsilon: config.epsilon, clip, decay: 0.0 }
    }
}

vectorised_fn! {
    /// Adam: p <- p - decay p - rate m_hat / (sqrt(v_hat) + epsilon).
    fn update(
        parameter: &'a mut [f32],
        gradient: &'a [f32],
        first: &'a mut [f32],
        second: &'a mut [f32],
        rule: Rule,
    ) {
        let Rule { betas: [beta1, beta2], corrections: [of_first, of_second], rate, epsilon, clip, decay } = rule;
        for (((p, g), m), v) in parameter.iter_mut().zip(gradient).zip(first).zip(second) {
            let unbiased = |[m, v]: [f32; 2]| [of_first * m, of_second * v];
            let [m, v] = adam_step(clip * g, [m, v], [1.0 - beta1, 1.0 - beta2], unbiased);
            *p -= decay * *p + rate * m / (v.sqrt() + epsilon);
        }
    }
}

vectorised_fn! {
    /// LaProp (Ziyin et al. 2020): m averages g / (sqrt(v_hat) + epsilon), and p <- p - decay p - rate m_hat.
    fn update_normalised(
        parameter: &'a mut [f32],
        gradient: &'a [f32],
        first: &'a mut [f32],
        second: &'a mut [f32],
        rule: Rule,
    ) {
        let Rule { betas: [beta1, beta2], corrections: [of_first, of_second], rate, epsilon, clip, decay } = rule;
        for (((p, g), m), v) in parameter.iter_mut().zip(gradient).zip(first).zip(second) {
            let g = clip * g;
            average(v, 1.0 - beta2, g * g);
            average(m, 1.0 - beta1, g / ((of_second * *v).sqrt() + epsilon));
            *p -= decay * *p + rate * of_first * *m;
        }
    }
}

/// The sum of squares, in eight partial sums, which vectorise.
fn sum_of_squares(values: &[f32]) -> f64 {
    let mut sums = [0.0_f64; 8];
    for chunk in values.chunks(8) {
        chunk.iter().zip(&mut sums).for_each(|(x, sum)| *sum += f64::from(*x) * f64::from(*x));
    }
    sums.iter().sum()
}
