//! Adam (Kingma & Ba 2015), with gradient clipping by the global norm.

use std::collections::BTreeMap;

use dfdx::tensor::{Cpu, Gradients};
use serde::{Deserialize, Serialize};

use super::{Parameters, Weights, kernels, values};
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
}

impl AdamConfig {
    /// The usual settings at this learning rate, without clipping.
    pub fn new(learning_rate: f32) -> Self {
        Self { learning_rate, betas: [0.9, 0.999], epsilon: 1e-8, max_norm: None }
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

    /// One step against `gradients`. Returns their norm before clipping. A parameter on which nothing that was
    /// differentiated depends has a gradient of zero.
    pub fn step(&mut self, module: &mut impl Parameters, gradients: &mut Gradients<f32, Cpu>) -> f32 {
        let squares = module.parameters().into_iter().map(|(_, parameter)| {
            let gradient = gradients.get_or_alloc_mut(parameter).expect("memory for a gradient");
            gradient.iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>()
        });
        let norm = squares.sum::<f64>().sqrt() as f32;
        let clip = self.config.max_norm.map_or(1.0, |max| (max / norm.max(f32::MIN_POSITIVE)).min(1.0));
        self.steps += 1;
        for (name, parameter) in module.parameters_mut() {
            let gradient = gradients.get_or_alloc_mut(&*parameter).expect("memory for a gradient");
            let mut updated = values(parameter).to_vec();
            self.update(&name, &mut updated, gradient, clip);
            parameter.copy_from(&updated);
        }
        norm
    }

    fn update(&mut self, name: &str, parameter: &mut [f32], gradient: &[f32], clip: f32) {
        let AdamConfig { learning_rate, betas: [beta1, beta2], epsilon, .. } = self.config;
        let zeros = || [vec![0.0; parameter.len()], vec![0.0; parameter.len()]];
        if !self.moments.contains_key(name) {
            self.moments.insert(name.into(), zeros());
        }
        let [first, second] = self.moments.get_mut(name).expect("just inserted");
        // The bias corrections, folded into the step size and epsilon.
        let correction1 = 1.0 - f64::from(beta1).powi(self.steps as i32);
        let correction2 = (1.0 - f64::from(beta2).powi(self.steps as i32)).sqrt();
        let rate = (f64::from(learning_rate) * correction2 / correction1) as f32;
        let epsilon = (f64::from(epsilon) * correction2) as f32;
        kernels::vectorised(|| {
            for (((p, g), m), v) in parameter.iter_mut().zip(gradient).zip(first).zip(second) {
                let g = clip * g;
                *m += (1.0 - beta1) * (g - *m);
                *v += (1.0 - beta2) * (g * g - *v);
                *p -= rate * *m / (v.sqrt() + epsilon);
            }
        });
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
