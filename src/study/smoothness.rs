//! Smoothness of a movement: SPARC and LDLJ; and of the actions that made it.
//!
//! [`of_path`] measures the movement alone: the part between the first and the last time step at which the hand is faster
//! than a twentieth of its top speed.
//!
//! ```
//! use handful::study::smoothness::of_path;
//!
//! // A minimum-jerk movement of 0.3 m along x in 2 s, sampled at 20 Hz.
//! let position = |tau: f64| 0.3 * (10.0 * tau.powi(3) - 15.0 * tau.powi(4) + 6.0 * tau.powi(5));
//! let path: Vec<[f64; 3]> = (0..=40).map(|t| [position(f64::from(t) / 40.0), 0.0, 0.0]).collect();
//! let (sparc, ldlj) = of_path(&path, 0.05).expect("it moves");
//! assert!((sparc + 1.4).abs() < 0.1, "{sparc}");
//! assert!(ldlj < 0.0, "{ldlj}");
//! ```

use rustfft::FftPlanner;
use rustfft::num_complex::Complex;

use super::statistics::mean;

/// Speeds below this fraction of the top speed count as rest.
const REST: f64 = 0.05;
/// The highest frequency that SPARC uses, in Hz; never more than half the sampling rate.
const CUT_OFF: f64 = 10.0;
/// SPARC uses the frequencies between the first and the last whose magnitude is at least this fraction of the largest.
const THRESHOLD: f64 = 0.05;

/// Smoothness of a path of hand positions (m) sampled every `dt` seconds: [`sparc`] and [`ldlj`], both dimensionless,
/// and larger (less negative) for a smoother movement. `None` where nothing moves.
#[doc(alias = "smoothness")]
#[doc(alias = "jerk")]
pub fn of_path(path: &[[f64; 3]], dt: f64) -> Option<(f64, f64)> {
    let velocity: Vec<[f64; 3]> = path.windows(2).map(|p| std::array::from_fn(|i| (p[1][i] - p[0][i]) / dt)).collect();
    let speed: Vec<f64> = velocity.iter().map(norm).collect();
    let top = speed.iter().copied().fold(0.0, f64::max);
    let moving = |v: &&f64| **v >= REST * top;
    if top < 1e-3 {
        return None;
    }
    let first = speed.iter().position(|v| moving(&v))?;
    let last = speed.iter().rposition(|v| moving(&v))?;
    (last - first >= 3).then(|| (sparc(&speed[first..=last], 1.0 / dt), ldlj(&velocity[first..=last], 1.0 / dt)))
}

/// Root mean square change from one action to the next, over their numbers and the time steps: 0 for actions that never change,
/// 2 for those that jump from end to end of their range. None for fewer than two actions.
#[doc(alias = "action smoothness")]
pub fn action_change(actions: &[Vec<f32>]) -> Option<f64> {
    let changes =
        actions.windows(2).flat_map(|pair| pair[0].iter().zip(&pair[1]).map(|(a, b)| f64::from(b - a).powi(2)));
    let squares: Vec<f64> = changes.collect();
    (!squares.is_empty()).then(|| mean(&squares).sqrt())
}

fn norm(v: &[f64; 3]) -> f64 {
    v.iter().map(|x| x * x).sum::<f64>().sqrt()
}

/// Spectral arc length of a speed profile (m/s) sampled at `rate` Hz: dimensionless, independent of amplitude and
/// duration. A minimum-jerk movement has about -1.4; less smooth ones are more negative. Tremor below 5 % of the
/// spectrum's peak goes unseen.
///
/// Balasubramanian et al., "On the analysis of movement smoothness", Journal of NeuroEngineering and Rehabilitation 12
/// (2015), with its cut-off of 10 Hz and threshold of 0.05; the cut-off is never above half the sampling rate here.
#[doc(alias = "SPARC")]
#[doc(alias = "spectral arc length")]
pub fn sparc(speed: &[f64], rate: f64) -> f64 {
    let bins = (speed.len().next_power_of_two() << 4).max(16);
    let mut spectrum: Vec<Complex<f64>> = speed.iter().map(|&v| v.into()).collect();
    spectrum.resize(bins, 0.0.into());
    FftPlanner::new().plan_fft_forward(bins).process(&mut spectrum);
    let step = rate / bins as f64;
    let kept = ((CUT_OFF.min(rate / 2.0) / step) as usize + 1).min(bins / 2 + 1);
    let magnitude: Vec<f64> = spectrum[..kept].iter().map(|c| c.norm()).collect();
    let largest = magnitude.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    let relative: Vec<f64> = magnitude.iter().map(|m| m / largest).collect();
    let loud = |m: &f64| *m >= THRESHOLD;
    let (Some(first), Some(last)) = (relative.iter().position(loud), relative.iter().rposition(loud)) else {
        return 0.0;
    };
    let width = 1.0 / (last - first).max(1) as f64;
    -relative[first..=last].windows(2).map(|m| width.hypot(m[1] - m[0])).sum::<f64>()
}

/// Log dimensionless jerk of a velocity (m/s) sampled at `rate` Hz: `-ln(T^3 / v_peak^2 * sum(|jerk|^2) dt)`, with the
/// duration `T` = samples * dt. A minimum-jerk movement has about -5.3; less smooth ones are more negative. Very sensitive
/// to noise and to the sampling rate: compare only at equal rates.
///
/// Balasubramanian et al. (2015), there of the speed; here the jerk is that of the velocity vector, so that curved
/// movements count.
#[doc(alias = "LDLJ")]
#[doc(alias = "dimensionless jerk")]
pub fn ldlj(velocity: &[[f64; 3]], rate: f64) -> f64 {
    let dt = 1.0 / rate;
    let duration = velocity.len() as f64 * dt;
    let top = velocity.iter().map(norm).fold(0.0, f64::max);
    let jerk = velocity.windows(3).map(|v| {
        let jerk: [f64; 3] = std::array::from_fn(|i| (v[2][i] - 2.0 * v[1][i] + v[0][i]) / (dt * dt));
        norm(&jerk).powi(2) * dt
    });
    -(duration.powi(3) / (top * top) * jerk.sum::<f64>()).ln()
}
