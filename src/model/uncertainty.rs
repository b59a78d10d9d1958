//! Measures of an ensemble's uncertainty, and risk measures of uncertain returns.
//!
//! *Aleatoric* uncertainty is noise of the environment, which each member predicts as a variance; more data do not reduce
//! it. *Epistemic* uncertainty is lack of data, which shows as disagreement of the members' means.
//!
//! ```
//! use handful::model::uncertainty::{Risk, split};
//!
//! // Two members, one feature: they agree about the noise, and disagree about the mean.
//! let (means, variances) = (vec![vec![1.0], vec![3.0]], vec![vec![0.5], vec![0.5]]);
//! let [mean, aleatoric, epistemic] = split(&means, &variances);
//! assert_eq!((mean[0], aleatoric[0], epistemic[0]), (2.0, 0.5, 1.0));
//!
//! // A gamble: 10 on average, but one particle in five is a disaster.
//! let returns = [20.0, 20.0, 20.0, 20.0, -30.0];
//! assert_eq!(Risk::Neutral.of(&returns), 10.0);
//! assert_eq!(Risk::Cvar(0.2).of(&returns), -30.0);
//! ```

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use crate::settings::ranges;

/// Decomposes the members' predictions (means and variances, `[members][features]`) into mean, aleatoric variance (the mean
/// of the variances) and epistemic variance (the variance of the means), `[features]` each. The sum of the two is the
/// variance of the mixture (law of total variance).
///
/// # Panics
/// If there are no members.
#[doc(alias = "law of total variance")]
#[doc(alias = "aleatoric")]
#[doc(alias = "epistemic")]
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

/// Largest Euclidean distance between two members' means, `[members][features]`: the disagreement of MOReL (Kidambi et al.
/// 2020).
#[doc(alias = "MOReL")]
#[doc(alias = "disagreement")]
pub fn max_pairwise_distance(means: &[Vec<f64>]) -> f64 {
    let distance = |a: &Vec<f64>, b: &Vec<f64>| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    means.iter().flat_map(|a| means.iter().map(move |b| distance(a, b))).fold(0.0, f64::max)
}

/// Largest Euclidean norm of a member's standard deviations (variances are `[members][features]`): the uncertainty penalty
/// of MOPO (Yu et al. 2020), as its authors' code has it. Mostly aleatoric, and yet large where data are few.
#[doc(alias = "MOPO")]
pub fn max_std_norm(variances: &[Vec<f64>]) -> f64 {
    variances.iter().map(|v| v.iter().sum::<f64>().sqrt()).fold(0.0, f64::max)
}

/// Jensen-Rényi divergence of order 2 of an ensemble of diagonal Gaussians (MAX, Shyam et al. 2019), in nats: the Rényi
/// entropy of the mixture minus the mean of the members' entropies. Zero if all members agree. Means and variances are
/// `[members][features]`.
#[doc(alias = "Jensen-Renyi")]
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

/// Upper bound of the mutual information between outcome and member, in nats: `1/2 sum (ln(total variance) - mean of
/// ln(variance))` over features, which takes the mixture's entropy to be that of a Gaussian with the same variance. Means
/// and variances are `[members][features]`.
#[doc(alias = "information gain")]
pub fn mutual_information(means: &[Vec<f64>], variances: &[Vec<f64>]) -> f64 {
    let [_, aleatoric, epistemic] = split(means, variances);
    let total = aleatoric.iter().zip(&epistemic).map(|(a, e)| (a + e).ln());
    let n = variances.len() as f64;
    let own = (0..aleatoric.len()).map(|i| variances.iter().map(|v| v[i].ln()).sum::<f64>() / n);
    0.5 * total.zip(own).map(|(total, own)| total - own).sum::<f64>()
}

/// Risk measures: one score for the returns of a candidate's particles.
#[doc(alias = "risk-averse")]
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Risk {
    /// The mean.
    #[default]
    Neutral,
    /// The mean minus this many standard deviations; negative is risk-seeking.
    #[doc(alias = "mean-variance")]
    #[serde(rename = "mean-std", alias = "deviation")]
    MeanStd(f32),
    /// Conditional value at risk: the mean of the worst fraction (at least one particle) of the returns.
    #[doc(alias = "CVaR")]
    #[doc(alias = "conditional value at risk")]
    #[doc(alias = "expected shortfall")]
    #[serde(alias = "worst")]
    Cvar(f32),
    /// Entropic risk `-ln(mean(exp(-theta r))) / theta`: the larger theta, the more the worst returns count.
    #[doc(alias = "exponential utility")]
    Entropic(f32),
}

ranges!(enum Risk {
    Neutral,
    "mean-std" MeanStd: -1e6..=1e6,
    "cvar" Cvar: 0.0..=1.0,
    "entropic" Entropic: 1e-4..=1e3,
});

impl Risk {
    /// The score of these returns; NaN if one of them is, or if there are none.
    pub fn of(self, returns: &[f32]) -> f32 {
        if returns.is_empty() {
            return f32::NAN;
        }
        let n = returns.len() as f32;
        let mean = returns.iter().sum::<f32>() / n;
        match self {
            Risk::Neutral => mean,
            Risk::MeanStd(weight) => {
                mean - weight * (returns.iter().map(|r| (r - mean).powi(2)).sum::<f32>() / n).sqrt()
            }
            // Sorting puts NaN among the best, or among the worst.
            Risk::Cvar(_) if mean.is_nan() => f32::NAN,
            Risk::Cvar(fraction) => {
                let count = ((fraction * n).ceil() as usize).clamp(1, returns.len());
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
        near(max_std_norm(&variances), 0.360_555_13);
        near(jensen_renyi(&means, &variances), 0.147_265_01);
        near(mutual_information(&means, &variances), 0.161_468_63);
    }

    #[test]
    fn members_that_agree_have_no_epistemic_uncertainty() {
        let (means, variances) = (vec![vec![0.3, 0.1]; 4], vec![vec![0.2, 0.5]; 4]);
        near(jensen_renyi(&means, &variances), 0.0);
        near(mutual_information(&means, &variances), 0.0);
        // Distant means in a hundred dimensions, where a product of densities underflows.
        let distant = [vec![0.0; 100], vec![100.0; 100]];
        let found = jensen_renyi(&distant, &vec![vec![1e-4; 100]; 2]);
        near(found, 2.0_f64.ln());
    }

    #[test]
    fn what_is_not_a_number_has_no_risk() {
        for risk in [Risk::Neutral, Risk::MeanStd(0.5), Risk::Cvar(0.2), Risk::Entropic(0.5)] {
            assert!(risk.of(&[]).is_nan() && risk.of(&[1.0, f32::NAN, 2.0, 3.0, 4.0]).is_nan(), "{risk:?}");
        }
    }

    #[test]
    fn risk_is_that_of_the_reference() {
        let returns = [10.0, 12.0, 8.0, 11.0, 9.0, -5.0, 10.5, 9.5, 11.5, 10.0];
        for (risk, expected) in [
            (Risk::Neutral, 8.65),
            (Risk::MeanStd(0.5), 6.307_325),
            (Risk::Cvar(0.2), 1.5),
            (Risk::Entropic(0.5), -0.405_725_28),
        ] {
            let found = risk.of(&returns);
            assert!((found - expected).abs() < 1e-5, "{risk:?}: {found}, expected {expected}");
        }
    }
}
