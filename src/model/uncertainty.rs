//! What an ensemble is unsure of, and why; and what to make of uncertain returns.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

/// Splits what the members of an ensemble say (means and variances, `[members][features]`) into mean, aleatoric
/// variance (the mean of the variances: chance) and epistemic variance (the variance of the means: ignorance).
/// Their sum is the variance of the mixture.
pub fn split(means: &[Vec<f64>], variances: &[Vec<f64>]) -> [Vec<f64>; 3] {
    let mean = mean_of(means);
    let squares: Vec<Vec<f64>> =
        means.iter().map(|m| m.iter().zip(&mean).map(|(m, centre)| (m - centre).powi(2)).collect()).collect();
    let epistemic = mean_of(&squares);
    [mean, mean_of(variances), epistemic]
}

fn mean_of(rows: &[Vec<f64>]) -> Vec<f64> {
    let n = rows.len() as f64;
    (0..rows[0].len()).map(|i| rows.iter().map(|row| row[i]).sum::<f64>() / n).collect()
}

/// The largest distance between two members' means (MOReL, Kidambi et al. 2020).
pub fn max_pairwise_distance(means: &[Vec<f64>]) -> f64 {
    let distance = |a: &Vec<f64>, b: &Vec<f64>| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    means.iter().flat_map(|a| means.iter().map(move |b| distance(a, b))).fold(0.0, f64::max)
}

/// The largest norm of a member's deviations (the penalty of MOPO, Yu et al. 2020): mostly chance, and yet large where
/// data are few.
pub fn max_deviation(variances: &[Vec<f64>]) -> f64 {
    variances.iter().map(|v| v.iter().sum::<f64>().sqrt()).fold(0.0, f64::max)
}

/// The Jensen-Renyi divergence of order 2 of an ensemble of diagonal Gaussians (MAX, Shyam et al. 2019): the entropy of
/// the mixture less the members' mean entropy. Zero if all agree.
pub fn jensen_renyi(means: &[Vec<f64>], variances: &[Vec<f64>]) -> f64 {
    let members = means.len();
    // Entropy of the mixture: -ln of the mean overlap of two members; sums of logarithms, because overlaps underflow.
    let overlap = |i: usize, j: usize| -> f64 {
        let features = means[i].iter().zip(&means[j]).zip(variances[i].iter().zip(&variances[j]));
        features.map(|((a, b), (v, w))| -0.5 * ((2.0 * PI * (v + w)).ln() + (a - b).powi(2) / (v + w))).sum()
    };
    let overlaps: Vec<f64> = (0..members * members).map(|k| overlap(k / members, k % members)).collect();
    let top = overlaps.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let sum: f64 = overlaps.iter().map(|o| (o - top).exp()).sum();
    let mixture = -(top + sum.ln() - 2.0 * (members as f64).ln());
    let entropy = |v: &Vec<f64>| v.iter().map(|v| 0.5 * (v.ln() + (4.0 * PI).ln())).sum::<f64>();
    mixture - variances.iter().map(entropy).sum::<f64>() / members as f64
}

/// An upper bound of the information that the outcome would give about which member is right: half the sum of
/// ln(total variance) less the mean of ln(variance).
pub fn mutual_information(means: &[Vec<f64>], variances: &[Vec<f64>]) -> f64 {
    let [_, aleatoric, epistemic] = split(means, variances);
    let total = aleatoric.iter().zip(&epistemic).map(|(a, e)| (a + e).ln());
    let n = variances.len() as f64;
    let own = (0..aleatoric.len()).map(|i| variances.iter().map(|v| v[i].ln()).sum::<f64>() / n);
    0.5 * total.zip(own).map(|(total, own)| total - own).sum::<f64>()
}

/// What to make of the returns of several possible futures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Risk {
    /// Their mean.
    #[default]
    Neutral,
    /// Mean minus so many standard deviations; a negative number seeks risk.
    Deviation(f32),
    /// The mean of the worst share.
    Cvar(f32),
    /// `-ln(mean(exp(-theta r))) / theta`: the larger theta, the more the worst counts.
    Entropic(f32),
}

impl Risk {
    /// One number for the returns of several futures.
    pub fn of(self, returns: &[f32]) -> f32 {
        let n = returns.len() as f32;
        let mean = returns.iter().sum::<f32>() / n;
        match self {
            Risk::Neutral => mean,
            Risk::Deviation(weight) => {
                mean - weight * (returns.iter().map(|r| (r - mean).powi(2)).sum::<f32>() / n).sqrt()
            }
            Risk::Cvar(share) => {
                let count = ((share * n).ceil() as usize).clamp(1, returns.len());
                let mut sorted = returns.to_vec();
                sorted.sort_by(f32::total_cmp);
                sorted[..count].iter().sum::<f32>() / count as f32
            }
            Risk::Entropic(theta) => {
                let worst = returns.iter().copied().fold(f32::INFINITY, f32::min);
                let sum: f32 = returns.iter().map(|r| (-theta * (r - worst)).exp()).sum();
                worst - (sum / n).ln() / theta
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn members() -> (Vec<Vec<f64>>, Vec<Vec<f64>>) {
        let rows = |rows: [[f64; 2]; 5]| rows.map(Vec::from).to_vec();
        (
            rows([[0.10, -0.20], [0.30, -0.10], [0.20, 0.00], [0.05, -0.30], [0.25, -0.15]]),
            rows([[0.04, 0.09], [0.05, 0.08], [0.03, 0.10], [0.06, 0.07], [0.04, 0.09]]),
        )
    }

    fn near(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-7, "{found}, expected {expected}");
    }

    #[test]
    fn uncertainty_is_that_of_the_reference() {
        let (means, variances) = members();
        let [mean, aleatoric, epistemic] = split(&means, &variances);
        for (found, expected) in [(mean, [0.18, -0.15]), (aleatoric, [0.044, 0.086]), (epistemic, [0.0086, 0.01])] {
            found.iter().zip(expected).for_each(|(found, expected)| near(*found, expected));
        }
        near(max_pairwise_distance(&means), 0.335_410_20);
        near(max_deviation(&variances), 0.360_555_13);
        near(jensen_renyi(&means, &variances), 0.147_265_01);
        near(mutual_information(&means, &variances), 0.161_468_63);
    }

    #[test]
    fn members_that_agree_are_not_unsure() {
        let (means, variances) = (vec![vec![0.3, 0.1]; 4], vec![vec![0.2, 0.5]; 4]);
        near(jensen_renyi(&means, &variances), 0.0);
        near(mutual_information(&means, &variances), 0.0);
        // Far apart in a hundred dimensions, where a product of densities underflows.
        let apart = [vec![0.0; 100], vec![100.0; 100]];
        let found = jensen_renyi(&apart, &vec![vec![1e-4; 100]; 2]);
        near(found, 2.0_f64.ln());
    }

    #[test]
    fn risk_is_that_of_the_reference() {
        let returns = [10.0, 12.0, 8.0, 11.0, 9.0, -5.0, 10.5, 9.5, 11.5, 10.0];
        for (risk, expected) in [
            (Risk::Neutral, 8.65),
            (Risk::Deviation(0.5), 6.307_325),
            (Risk::Cvar(0.2), 1.5),
            (Risk::Entropic(0.5), -0.405_725_28),
        ] {
            let found = risk.of(&returns);
            assert!((found - expected).abs() < 1e-5, "{risk:?}: {found}, expected {expected}");
        }
    }
}
