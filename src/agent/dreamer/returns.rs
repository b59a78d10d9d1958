//! Lambda-returns of imagined rollouts and of replayed experience, and the scale by which returns are normalised.
//!
//! Equation numbers are those of Hafner et al. 2023, arXiv v1.

use serde::{Deserialize, Serialize};

use crate::agent::percentile::percentile;
use crate::replay::SequenceBatch;

/// The lambda-returns of imagined rollouts (eq. 7):
///
/// `R_t = r_{t+1} + c_{t+1} ((1 - lambda) v_{t+1} + lambda R_{t+1})`, and at the horizon `R_H = v_H`.
///
/// Indices are those of the published code, where a reward belongs to the state that it was received on arriving in; the paper
/// writes r_t and gamma c_t for our r_{t+1} and c_{t+1}.
///
/// `rewards`, `continuations` and `values` hold a list `[rows]` for each of H + 1 time steps, the start first: a reward is for
/// arriving at its time step, a continuation is the probability that the episode continues there, times the discount. The
/// result has H lists.
///
/// ```
/// use handful::agent::dreamer::lambda_returns;
///
/// let column = |x: [f32; 3]| x.map(|x| vec![x]);
/// let (rewards, values) = (column([0.0, 1.0, 2.0]), column([0.0, 10.0, 20.0]));
/// let returns = |lambda| lambda_returns(&rewards, &column([0.5; 3]), &values, lambda)[0][0];
/// // One step and the critic; all steps and the critic at the horizon.
/// assert_eq!(returns(0.0), 1.0 + 0.5 * 10.0);
/// assert_eq!(returns(1.0), 1.0 + 0.5 * (2.0 + 0.5 * 20.0));
/// ```
///
/// # Panics
/// If there are no time steps, or the lists differ in length.
#[doc(alias = "TD(lambda)")]
#[doc(alias = "lambda-return")]
#[doc(alias = "Bellman")]
pub fn lambda_returns(
    rewards: &[Vec<f32>],
    continuations: &[Vec<f32>],
    values: &[Vec<f32>],
    lambda: f32,
) -> Vec<Vec<f32>> {
    let horizon = values.len() - 1;
    let mut returns = vec![Vec::new(); horizon];
    let mut next = values[horizon].clone();
    for t in (0..horizon).rev() {
        let (rewards, continuations, values) = (&rewards[t + 1], &continuations[t + 1], &values[t + 1]);
        for (row, next) in next.iter_mut().enumerate() {
            *next = rewards[row] + continuations[row] * ((1.0 - lambda) * values[row] + lambda * *next);
        }
        returns[t].clone_from(&next);
    }
    returns
}

/// Lambda-returns of replayed experience for all time steps of a batch but the last, and a mask: 0 where an episode ends,
/// since the future there is not in the batch. `bootstrap` holds the value of each time step's state, rows as in `batch`.
pub fn replay_lambda_returns(
    batch: &SequenceBatch,
    bootstrap: &[f32],
    discount: f32,
    lambda: f32,
) -> (Vec<f32>, Vec<f32>) {
    let sequences = batch.sequences;
    let count = sequences * (batch.length - 1);
    let (mut returns, mut mask) = (vec![0.0; count], vec![0.0; count]);
    let mut next = bootstrap[count..].to_vec();
    for i in (0..count).rev() {
        let (after, next) = (i + sequences, &mut next[i % sequences]);
        let discount = if batch.terminal[after] { 0.0 } else { discount };
        let lambda = if batch.last[after] { 0.0 } else { lambda };
        *next = batch.rewards[after] + discount * ((1.0 - lambda) * bootstrap[after] + lambda * *next);
        returns[i] = *next;
        mask[i] = f32::from(!batch.last[i]);
    }
    (returns, mask)
}

/// Return normalisation (eq. 12): advantages are divided by the range from the 5th to the 95th percentile of the returns, as
/// an exponential moving average, but by 1 at least, so that small returns are not amplified.
#[doc(alias = "return normalization")]
#[doc(alias = "percentile")]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ReturnScale {
    low: f32,
    high: f32,
}

impl ReturnScale {
    /// Rate of the moving average.
    const RATE: f32 = 0.01;

    /// A scale with saved percentiles, see [`ReturnScale::range`].
    pub fn from_range(low: f32, high: f32) -> Self {
        Self { low, high }
    }

    /// Moves the percentiles towards those of the returns of a batch, which are sorted in place.
    ///
    /// # Panics
    /// If there are none.
    pub fn update(&mut self, returns: &mut [f32]) {
        returns.sort_by(f32::total_cmp);
        self.low += Self::RATE * (percentile(returns, 0.05) - self.low);
        self.high += Self::RATE * (percentile(returns, 0.95) - self.high);
    }

    /// The divisor S of advantages, at least 1.
    pub fn scale(&self) -> f32 {
        (self.high - self.low).max(1.0)
    }

    /// The moving averages of the 5th and the 95th percentile, to be saved.
    pub fn range(&self) -> [f32; 2] {
        [self.low, self.high]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REWARDS: [f32; 6] = [0.1, 0.5, -0.2, 1.0, 0.0, 0.3];
    const CONTINUES: [f32; 6] = [0.99, 0.98, 0.97, 0.5, 0.99, 0.96];
    const VALUES: [f32; 6] = [1.0, 1.2, 0.8, 1.5, 0.9, 1.1];

    fn near(found: &[f32], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            assert!((f64::from(*found) - expected).abs() < 2e-6, "{found}, expected {expected}");
        }
    }

    /// Numbers computed in float64 from the reference's formulas.
    #[test]
    fn lambda_returns_are_the_references() {
        let [rewards, continues, values] = [REWARDS, CONTINUES, VALUES].map(|row| row.map(|x| vec![x]));
        let with = |lambda| lambda_returns(&rewards, &continues, &values, lambda).concat();
        near(&with(0.95), &[1.836_671_02, 1.372_578_97, 1.664_437_3, 1.319_868, 1.356]);
        near(&with(0.0), &[1.676, 0.576, 1.75, 0.891, 1.356]);
        near(&with(1.0), &[1.892_661_73, 1.421_083_4, 1.671_22, 1.342_44, 1.356]);
    }

    #[test]
    fn replay_lambda_returns_are_the_references() {
        let batch = SequenceBatch {
            sequences: 1,
            length: 6,
            rewards: REWARDS.to_vec(),
            last: [0, 0, 0, 1, 0, 0].map(|x| x == 1).to_vec(),
            terminal: [0, 0, 0, 0, 0, 1].map(|x| x == 1).to_vec(),
            ..SequenceBatch::default()
        };
        let (returns, mask) = replay_lambda_returns(&batch, &[2.0, 1.9, 1.7, 1.6, 1.4, 1.2], 1.0 - 1.0 / 333.0, 0.95);
        near(&returns, &[2.813_668_76, 2.342_776_47, 2.595_195_2, 0.353_933_93, 0.3]);
        assert_eq!(mask, [1.0, 1.0, 1.0, 0.0, 1.0]);
    }

    #[test]
    fn the_scale_follows_percentiles_slowly() {
        let mut scale = ReturnScale::default();
        let returns: Vec<f32> = (0..11).map(|i| i as f32).collect();
        scale.update(&mut returns.clone());
        near(&scale.range(), &[0.005, 0.095]);
        assert_eq!(scale.scale(), 1.0);
        (1..100).for_each(|_| scale.update(&mut returns.clone()));
        near(&[scale.scale()], &[5.705_708_93]);
        let mut few = [0.3, -1.0, 2.0, 5.0, 7.0, 9.5, -4.0];
        few.sort_by(f32::total_cmp);
        near(&[percentile(&few, 0.05), percentile(&few, 0.95)], &[-3.1, 8.75]);
    }
}
