//! Shifting and scaling features to mean zero and deviation one.

use crate::checkpoint::Weights;
use crate::error::Result;
use crate::nn::frozen::Feature;
use crate::nn::kernels::vectorised_fn;

/// Mean and scale of each of several features.
#[derive(Clone, Debug, PartialEq)]
pub struct Normaliser {
    /// What is subtracted.
    pub mean: Vec<f32>,
    /// What the rest is divided by.
    pub scale: Vec<f32>,
}

impl Normaliser {
    /// Leaves `features` numbers as they are.
    pub fn identity(features: usize) -> Self {
        Self { mean: vec![0.0; features], scale: vec![1.0; features] }
    }

    /// Mean and standard deviation of rows, `floors.len()` numbers each, summed in float64. A feature whose
    /// deviation lies below its floor has hardly moved; it is divided by the floor, lest its first move look like a
    /// thousand deviations.
    pub fn fit(rows: &[f32], floors: &[f32]) -> Self {
        let width = floors.len();
        let n = (rows.len() / width).max(1) as f64;
        let mut mean = vec![0.0_f64; width];
        for row in rows.chunks_exact(width) {
            mean.iter_mut().zip(row).for_each(|(m, x)| *m += f64::from(*x) / n);
        }
        let mut variance = vec![0.0_f64; width];
        for row in rows.chunks_exact(width) {
            let centred = row.iter().zip(&mean);
            variance.iter_mut().zip(centred).for_each(|(v, (x, m))| *v += (f64::from(*x) - m).powi(2) / n);
        }
        Self {
            mean: mean.iter().map(|m| *m as f32).collect(),
            scale: variance.iter().zip(floors).map(|(v, floor)| (v.sqrt() as f32).max(*floor)).collect(),
        }
    }

    /// Normalises rows in place.
    pub fn normalise(&self, rows: &mut [f32]) {
        for row in rows.chunks_exact_mut(self.mean.len()) {
            let features = self.mean.iter().zip(&self.scale);
            row.iter_mut().zip(features).for_each(|(x, (mean, scale))| *x = (*x - mean) / scale);
        }
    }

    /// Normalises a panel in place.
    pub(super) fn normalise_panel(&self, panel: &mut [Feature]) {
        normalise_panel(panel, &self.mean, &self.scale);
    }

    /// Writes it into `weights`, under `prefix`.
    pub fn save(&self, weights: &mut Weights, prefix: &str) {
        let size = [1, 1, self.mean.len()];
        weights.insert(format!("{prefix}.mean"), self.mean.clone(), size);
        weights.insert(format!("{prefix}.scale"), self.scale.clone(), size);
    }

    /// Reads what [`Normaliser::save`] wrote for as many features.
    ///
    /// # Errors
    /// If it is missing or of another size.
    pub fn load(&mut self, weights: &Weights, prefix: &str) -> Result<()> {
        let size = [1, 1, self.mean.len()];
        let mean = weights.get(&format!("{prefix}.mean"), size)?.to_vec();
        let scale = weights.get(&format!("{prefix}.scale"), size)?.to_vec();
        *self = Self { mean, scale };
        Ok(())
    }
}

vectorised_fn! {
    fn normalise_panel(panel: &'a mut [Feature], mean: &'a [f32], scale: &'a [f32]) {
        for (Feature(x), (mean, scale)) in panel.iter_mut().zip(mean.iter().zip(scale)) {
            x.iter_mut().for_each(|x| *x = (*x - mean) / scale);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn still_features_keep_their_floor_and_large_offsets_their_spread() {
        // A spread of 0.01 on an offset of 1000: single precision sums would lose it.
        let rows: Vec<f32> = (0..1000).flat_map(|i| [1000.0 + if i % 2 == 0 { 0.5 } else { -0.5 }, 7.0]).collect();
        let normaliser = Normaliser::fit(&rows, &[1e-3, 0.25]);
        assert!((normaliser.mean[0] - 1000.0).abs() < 1e-4 && (normaliser.scale[0] - 0.5).abs() < 1e-5);
        assert_eq!((normaliser.mean[1], normaliser.scale[1]), (7.0, 0.25));
        let mut row = vec![1000.5, 7.5];
        normaliser.normalise(&mut row);
        assert!((row[0] - 1.0).abs() < 1e-4 && (row[1] - 2.0).abs() < 1e-6);
    }
}
