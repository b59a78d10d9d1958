//! What the future is worth: lambda returns in imagination and in experience, and the scale of returns.

use serde::{Deserialize, Serialize};

use crate::replay::SequenceBatch;

/// Lambda returns of imagined futures. `rewards`, `continues` and `values` hold a list for each moment, the start first: a
/// reward is for arriving at its moment, a continue tells how much the future counts there. One list fewer comes back:
///
/// `R_t = r_{t+1} + c_{t+1} ((1 - lambda) v_{t+1} + lambda R_{t+1})`, and the last `R` is the last value.
pub fn lambda_returns(rewards: &[Vec<f32>], continues: &[Vec<f32>], values: &[Vec<f32>], lambda: f32) -> Vec<Vec<f32>> {
    let horizon = values.len() - 1;
    let mut returns = vec![Vec::new(); horizon];
    let mut next = values[horizon].clone();
    for t in (0..horizon).rev() {
        let after = rewards[t + 1].iter().zip(&continues[t + 1]).zip(&values[t + 1]);
        for (next, ((r, c), v)) in next.iter_mut().zip(after) {
            *next = r + c * ((1.0 - lambda) * v + lambda * *next);
        }
        returns[t].clone_from(&next);
    }
    returns
}

/// Lambda returns of experience, for all moments of a batch but the last, and whether each has one: where an episode ends
/// there is no future in the batch. `beyond` is what is believed of the future from each moment on.
pub fn replayed_returns(batch: &SequenceBatch, beyond: &[f32], discount: f32, lambda: f32) -> (Vec<f32>, Vec<f32>) {
    let rows = batch.sequences;
    let moments = rows * (batch.length - 1);
    let (mut returns, mut counts) = (vec![0.0; moments], vec![0.0; moments]);
    let mut next = beyond[moments..].to_vec();
    for i in (0..moments).rev() {
        let (after, next) = (i + rows, &mut next[i % rows]);
        let live = if batch.terminal[after] { 0.0 } else { discount };
        let on = if batch.last[after] { 0.0 } else { lambda };
        *next = batch.rewards[after] + live * ((1.0 - on) * beyond[after] + on * *next);
        returns[i] = *next;
        counts[i] = f32::from(!batch.last[i]);
    }
    (returns, counts)
}

/// The range of returns, followed slowly: advantages are divided by it, but small returns are not blown up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ReturnScale {
    low: f32,
    high: f32,
}

impl ReturnScale {
    const RATE: f32 = 0.01;

    /// A scale that has got so far.
    pub fn from_range(low: f32, high: f32) -> Self {
        Self { low, high }
    }

    /// Takes in the returns of a batch: their 5th and 95th percentiles.
    pub fn update(&mut self, returns: &mut [f32]) {
        returns.sort_by(f32::total_cmp);
        self.low += Self::RATE * (percentile(returns, 0.05) - self.low);
        self.high += Self::RATE * (percentile(returns, 0.95) - self.high);
    }

    /// What advantages are divided by, at least 1.
    pub fn scale(&self) -> f32 {
        (self.high - self.low).max(1.0)
    }

    /// The low and the high end, to be saved.
    pub fn range(&self) -> [f32; 2] {
        [self.low, self.high]
    }
}

/// Of sorted numbers, linear between two of them.
fn percentile(sorted: &[f32], share: f32) -> f32 {
    let at = share * (sorted.len() - 1) as f32;
    let (below, between) = (at.floor() as usize, at.fract());
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + between * (sorted[above] - sorted[below])
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
    fn replayed_returns_are_the_references() {
        let batch = SequenceBatch {
            sequences: 1,
            length: 6,
            rewards: REWARDS.to_vec(),
            last: [0, 0, 0, 1, 0, 0].map(|x| x == 1).to_vec(),
            terminal: [0, 0, 0, 0, 0, 1].map(|x| x == 1).to_vec(),
            ..SequenceBatch::default()
        };
        let (returns, counts) = replayed_returns(&batch, &[2.0, 1.9, 1.7, 1.6, 1.4, 1.2], 1.0 - 1.0 / 333.0, 0.95);
        near(&returns, &[2.813_668_76, 2.342_776_47, 2.595_195_2, 0.353_933_93, 0.3]);
        assert_eq!(counts, [1.0, 1.0, 1.0, 0.0, 1.0]);
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
