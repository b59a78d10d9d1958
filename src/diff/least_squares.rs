//! Nonlinear least squares: Levenberg-Marquardt steps (damped Gauss-Newton), which minimise the squared error of what was
//! recorded. The unknowns are the logarithms of positive parameters, as factors on a guess, with a Gaussian prior around it
//! (maximum a posteriori): a recording that tells nothing leaves the guess as it is.

use nalgebra::{SMatrix, SVector};

/// Standard deviation of the prior on each logarithm.
const DOUBT: f64 = 1.0;

/// Residuals, and their gradients with respect to `P` unknowns.
pub(super) struct Residuals<const P: usize> {
    values: Vec<f64>,
    slopes: Vec<SVector<f64, P>>,
}

/// The minimum that was found.
pub(super) struct Found<const P: usize> {
    /// The unknowns.
    pub off: SVector<f64, P>,
    /// The minimised sum of squares, the prior's included.
    pub square: f64,
    /// Standard deviations of the unknowns (Laplace approximation, the residual taken as noise), at most the prior's.
    pub deviations: [f64; P],
    /// Root-mean-square residual.
    pub residual: f64,
    /// Steps taken.
    pub iterations: usize,
}

/// The unit vector of the unknown `i`.
pub(super) fn direction<const P: usize>(i: usize) -> SVector<f64, P> {
    SVector::from_fn(|j, _| f64::from(u8::from(i == j)))
}

impl<const P: usize> Residuals<P> {
    /// The prior is one residual for each unknown; `noise` is the standard deviation of the error of a residual that no
    /// simulator explains: the weight of the recording against the prior.
    pub fn prior(off: &SVector<f64, P>, noise: f64) -> Self {
        Self {
            values: (off * (noise / DOUBT)).iter().copied().collect(),
            slopes: (0..P).map(|i| direction(i) * (noise / DOUBT)).collect(),
        }
    }

    /// Adds the residual of a number that was simulated, with its gradient, and `seen`; an error counts `size` times.
    pub fn push(&mut self, (number, slope): (f64, SVector<f64, P>), seen: f64, size: f64) {
        self.values.push(size * (number - seen));
        self.slopes.push(slope * size);
    }

    fn square(&self) -> f64 {
        self.values.iter().map(|value| value * value).sum()
    }

    /// Gauss-Newton's normal equations: curvature and gradient of half the sum of squares.
    fn normal(&self) -> (SMatrix<f64, P, P>, SVector<f64, P>) {
        let pairs = self.values.iter().zip(&self.slopes);
        pairs.fold((SMatrix::zeros(), SVector::zeros()), |(curvature, slope), (value, of)| {
            (curvature + of * of.transpose(), slope + of * *value)
        })
    }
}

/// Levenberg-Marquardt from `off`.
pub(super) fn minimise<const P: usize>(
    off: SVector<f64, P>,
    residuals: impl Fn(&SVector<f64, P>) -> Residuals<P>,
) -> Found<P> {
    const MOST: usize = 60;
    let mut at = off;
    let mut here = residuals(&at);
    let mut damping = 1e-3;
    let mut iterations = 0;
    while iterations < MOST && damping < 1e8 {
        iterations += 1;
        let (curvature, slope) = here.normal();
        let damped = curvature + SMatrix::from_diagonal(&(curvature.diagonal() * damping));
        let Some(step) = damped.try_inverse().map(|inverse| -(inverse * slope)) else { break };
        // No more than a factor of e at a time.
        let step = step / step.amax().max(1.0);
        let there = residuals(&(at + step));
        if there.square() < here.square() {
            let improved = here.square() - there.square();
            (at, here, damping) = (at + step, there, damping / 5.0);
            if improved < 1e-12 * here.square() {
                break;
            }
        } else if damping < 1.0 && step.amax() < 1e-8 {
            // Hardly damped, and yet this short: what is left is rounding.
            break;
        } else {
            damping *= 5.0;
        }
    }
    let seen = &here.values[P..];
    let square: f64 = seen.iter().map(|value| value * value).sum();
    let noise = (square / (seen.len() as f64 - P as f64).max(1.0)).sqrt();
    let inverse = here.normal().0.try_inverse().expect("a prior leaves nothing undecided");
    Found {
        off: at,
        square: here.square(),
        deviations: std::array::from_fn(|i| (noise * inverse[(i, i)].sqrt()).min(DOUBT)),
        residual: (square / seen.len() as f64).sqrt(),
        iterations,
    }
}
