//! The running scale of the values that the policy climbs.

use crate::agent::percentile::percentile;

/// Rate at which the scale follows.
const RATE: f32 = 0.01;

/// Divides values in the policy's loss, so that its step does not depend on the rewards' unit: an exponential moving average of
/// the distance between the 5th and the 95th percentile of a batch of values, at least 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunningScale(f32);

impl Default for RunningScale {
    fn default() -> Self {
        Self(1.0)
    }
}

impl RunningScale {
    /// A scale as it was.
    pub(super) fn new(scale: f32) -> Self {
        Self(scale)
    }

    /// The scale.
    pub fn scale(self) -> f32 {
        self.0
    }

    /// Takes in a batch of values.
    ///
    /// # Panics
    /// If there are none.
    pub fn update(&mut self, values: &[f32]) {
        let mut sorted = values.to_vec();
        sorted.sort_by(f32::total_cmp);
        let range = percentile(&sorted, 0.95) - percentile(&sorted, 0.05);
        self.0 += RATE * (range.max(1.0) - self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_is_the_references() {
        let values = [20.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0];
        let mut sorted = values;
        sorted.sort_by(f32::total_cmp);
        for (share, expected) in [(0.05, 0.45), (0.95, 14.6)] {
            let found = percentile(&sorted, share);
            assert!((found - expected).abs() < 1e-5 * expected.max(1.0), "{found}, expected {expected}");
        }
        let mut scale = RunningScale::default();
        for expected in [1.131_5, 1.261_685] {
            scale.update(&values);
            assert!((scale.scale() - expected).abs() < 1e-5, "{}", scale.scale());
        }
    }
}
