//! Standardisation: features shifted and scaled to mean zero and standard deviation one.

use crate::checkpoint::Weights;
use crate::error::Result;
use crate::nn::frozen::Feature;
use crate::nn::kernels::vectorised_fn;

/// Mean and scale of each feature: `x -> (x - mean) / scale`.
#[doc(alias = "standardisation")]
#[doc(alias = "standard scaler")]
#[doc(alias = "normalizer")]
#[derive(Clone, Debug, PartialEq)]
pub struct Normaliser {
    /// Mean of each feature, which is subtracted.
    pub mean: Vec<f32>,
    /// Standard deviation of each feature, or its floor: the divisor.
    pub scale: Vec<f32>,
}

impl Normaliser {
    /// A normaliser that leaves `features` features unchanged.
    pub fn identity(features: usize) -> Self {
        Self { mean: vec![0.0; features], scale: vec![1.0; features] }
    }

    /// Mean and standard deviation of `rows`, `[count, features]` with `features = floors.len()`, summed in float64.
    ///
    /// A feature whose standard deviation lies below its floor has hardly moved in the data; it is divided by the floor,
    /// or its first real change would be an outlier of a thousand standard deviations.
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

    /// Normalises rows, `[count, features]`, in place.
    pub fn normalise(&self, rows: &mut [f32]) {
        for row in rows.chunks_exact_mut(self.mean.len()) {
            let features = self.mean.iter().zip(&self.scale);
            row.iter_mut().zip(features).for_each(|(x, (mean, scale))| *x = (*x - mean) / scale);
        }
    }

    /// Normalises a panel in place.
    pub(crate) fn normalise_panel(&self, panel: &mut [Feature]) {
        normalise_panel(panel, &self.mean, &self.scale);
    }

    /// Stores `{prefix}.mean` and `{prefix}.scale` in `weights`.
    pub fn save(&self, weights: &mut Weights, prefix: &str) {
        let size = [1, 1, self.mean.len()];
        weights.insert(format!("{prefix}.mean"), self.mean.clone(), size);
        weights.insert(format!("{prefix}.scale"), self.scale.clone(), size);
    }

    /// Loads what [`Normaliser::save`] stored.
    ///
    /// # Errors
    /// If an array is missing or has another number of features, or a scale is not positive; the normaliser is unchanged then.
    pub fn load(&mut self, weights: &Weights, prefix: &str) -> Result<()> {
        let size = [1, 1, self.mean.len()];
        let mean = weights.get(&format!("{prefix}.mean"), size)?.to_vec();
        let scale = weights.get_within(&format!("{prefix}.scale"), size, f32::MIN_POSITIVE..=f32::MAX)?.to_vec();
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
    fn constant_features_keep_their_floor_and_large_offsets_their_standard_deviation() {
        // A standard deviation of 0.5 on an offset of 1000: single precision sums would lose it.
        let rows: Vec<f32> = (0..1000).flat_map(|i| [1000.0 + if i % 2 == 0 { 0.5 } else { -0.5 }, 7.0]).collect();
        let normaliser = Normaliser::fit(&rows, &[1e-3, 0.25]);
        assert!((normaliser.mean[0] - 1000.0).abs() < 1e-4 && (normaliser.scale[0] - 0.5).abs() < 1e-5);
        assert_eq!((normaliser.mean[1], normaliser.scale[1]), (7.0, 0.25));
        let mut row = vec![1000.5, 7.5];
        normaliser.normalise(&mut row);
        assert!((row[0] - 1.0).abs() < 1e-4 && (row[1] - 2.0).abs() < 1e-6);
    }
}
