//! Adam (Kingma & Ba 2015), with clipping and decoupled weight decay; and LaProp (Ziyin et al. 2020), which is Adam in
//! another order.

use std::collections::BTreeMap;

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
    /// Decay of the two moment estimates.
    pub betas: [f32; 2],
    /// Added to the root of the second moment.
    pub epsilon: f32,
    /// Gradients with a larger norm, over all parameters together, are scaled down to it.
    pub max_norm: Option<f32>,
    /// Share of itself that a weight loses in a step of size one, whatever its gradient (AdamW, Loshchilov & Hutter
    /// 2019). Biases and other parameters do not.
    pub weight_decay: f32,
    /// Gradients are divided by the root of their second moment before they enter the first one, instead of after: LaProp.
    pub normalise_first: bool,
    /// The gradient of each parameter is scaled down to this share of the parameter's norm, which counts as 1e-3 at least
    /// (adaptive gradient clipping: Brock et al. 2021, by whole tensors as in DreamerV3).
    pub adaptive_clip: Option<f32>,
    /// Steps over which the step size grows to what it will be.
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

/// The optimiser's state for one set of parameters.
#[derive(Clone, Debug)]
pub struct Adam {
    config: AdamConfig,
    steps: u32,
    /// First and second moments of each parameter, by its name.
    moments: BTreeMap<String, [Vec<f32>; 2]>,
}

impl Adam {
    /// A fresh optimiser.
    pub fn new(config: AdamConfig) -> Self {
        Self { config, steps: 0, moments: BTreeMap::new() }
    }

    /// Takes steps of another size from here on.
    pub fn set_learning_rate(&mut self, learning_rate: f32) {
        self.config.learning_rate = learning_rate;
    }

    /// One step against `gradients`. Returns their norm before clipping. A parameter on which nothing that was
    /// differentiated depends has a gradient of zero.
    pub fn step(&mut self, module: &mut impl Parameters, gradients: &mut Gradients<f32, Cpu>) -> f32 {
        // Every parameter with its gradient and its moments: a piece of work of its own.
        let work = module.parameters_mut().into_iter().map(|(name, parameter)| {
            let gradient =
                std::mem::take(&mut **gradients.get_or_alloc_mut(&*parameter).expect("memory for a gradient"));
            let zeros = || [vec![0.0; gradient.len()], vec![0.0; gradient.len()]];
            let moments = self.moments.remove(&name).unwrap_or_else(zeros);
            (name, parameter, gradient, moments)
        });
        let mut work: Vec<_> = work.collect();
        let squares: Vec<f64> = work.par_iter().map(|(_, _, gradient, _)| sum_of_squares(gradient)).collect();
        let norm = squares.iter().sum::<f64>().sqrt() as f32;
        let clip = self.config.max_norm.map_or(1.0, |max| (max / norm.max(f32::MIN_POSITIVE)).min(1.0));
        self.steps += 1;
        let rule = Rule::new(&self.config, self.steps, clip);
        work.par_iter_mut().for_each(|(name, parameter, gradient, [first, second])| {
            let decay =
                if name.ends_with("weight") { self.config.learning_rate * self.config.weight_decay } else { 0.0 };
            let parameter = values_mut(parameter);
            let adaptive = self.config.adaptive_clip.map_or(1.0, |share| {
                let [size, slope] = [&*parameter, &*gradient].map(|numbers| sum_of_squares(numbers).sqrt() as f32);
                (share * size.max(1e-3) / slope.max(f32::MIN_POSITIVE)).min(1.0)
            });
            let rule = Rule { decay, clip: clip * adaptive, ..rule };
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
    /// If a part is missing or has another size.
    pub fn load(&mut self, weights: &Weights, prefix: &str, module: &impl Parameters) -> Result<()> {
        self.steps = weights.get(&format!("{prefix}.steps"), [1, 1, 1])?[0] as u32;
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

/// What a step does to each number.
#[derive(Clone, Copy)]
struct Rule {
    betas: [f32; 2],
    /// The bias corrections of both moments, divided out.
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
    fn update(
        parameter: &'a mut [f32],
        gradient: &'a [f32],
        first: &'a mut [f32],
        second: &'a mut [f32],
        rule: Rule,
    ) {
        let Rule { betas: [beta1, beta2], corrections: [of_first, of_second], rate, epsilon, clip, decay } = rule;
        for (((p, g), m), v) in parameter.iter_mut().zip(gradient).zip(first).zip(second) {
            let g = clip * g;
            *m += (1.0 - beta1) * (g - *m);
            *v += (1.0 - beta2) * (g * g - *v);
            *p -= decay * *p + rate * (of_first * *m) / ((of_second * *v).sqrt() + epsilon);
        }
    }
}

vectorised_fn! {
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
            *v += (1.0 - beta2) * (g * g - *v);
            *m += (1.0 - beta1) * (g / ((of_second * *v).sqrt() + epsilon) - *m);
            *p -= decay * *p + rate * of_first * *m;
        }
    }
}

/// In eight sums side by side, which vectorise.
fn sum_of_squares(values: &[f32]) -> f64 {
    let mut sums = [0.0_f64; 8];
    for chunk in values.chunks(8) {
        chunk.iter().zip(&mut sums).for_each(|(x, sum)| *sum += f64::from(*x) * f64::from(*x));
    }
    sums.iter().sum()
}
