//! System identification: estimates a block's mass and friction from a recorded push.
//!
//! The push is simulated in the [`Pusher`] with the recorded motion of the hand; dual numbers give the derivative of every pose
//! with respect to mass and friction, and Levenberg-Marquardt steps (damped Gauss-Newton) minimise the squared error of the
//! poses. The unknowns are logarithms, since mass and friction are positive, with a Gaussian prior around the guess (maximum a
//! posteriori): a slow push tells next to nothing about a mass.

use nalgebra::{SMatrix, SVector, Vector2};
use num_dual::{Derivative, DualSVec64};

use super::pusher::{DT, HALF, Pusher, SPEED, STATE};

/// Standard deviation of the prior on the two logarithms.
const DOUBT: f64 = 1.0;
/// Standard deviation of the error of a pose that no simulator explains, m: the weight of the recording against the prior.
const NOISE: f64 = 1e-3;

/// A recorded push: one pose of hand and block for each control step, the start included.
///
/// ```
/// use handful::diff::{Pusher, RecordedPush};
///
/// // A hand moves 10 cm along x and pushes the block before it.
/// let hand: Vec<[f64; 2]> = (0..20).map(|t| [0.005 * t as f64, 0.001]).collect();
/// let start = vec![[0.04, 0.0, 0.0]];
/// let light = Pusher { mass: 0.05, friction: 0.3, ..Pusher::default() };
/// let block = RecordedPush { hand: hand.clone(), block: start }.play(&light);
///
/// let found = RecordedPush { hand, block }.identify(Pusher::default());
/// assert!(found.residual < 1e-3, "{} m", found.residual);
/// ```
#[doc(alias = "system identification")]
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordedPush {
    /// Positions of the hand, m.
    pub hand: Vec<[f64; 2]>,
    /// Positions of the block, m, and its angle, rad.
    pub block: Vec<[f64; 3]>,
}

/// The result of [`RecordedPush::identify`].
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    /// The block that explains the recording best.
    pub pusher: Pusher<f64>,
    /// Standard deviations of the logarithms of mass and friction (Laplace approximation, the residual taken as noise). Near
    /// one, that of the prior, the recording carries no information, and the guess was kept.
    pub deviations: [f64; 2],
    /// Root-mean-square residual, m; angles count by how far they move the middle of an edge.
    pub residual: f64,
    /// Gauss-Newton steps taken.
    pub iterations: usize,
}

/// Residuals of all poses, and their gradients with respect to the two logarithms.
struct Residuals {
    values: Vec<f64>,
    slopes: Vec<SVector<f64, 2>>,
}

impl RecordedPush {
    /// Estimates mass and friction near `guess`, whose other parameters are kept. The block starts at rest. The error of a whole
    /// trajectory has local minima, so the search starts nine times: from the guess, and a factor of three above and below.
    pub fn identify(&self, guess: Pusher<f64>) -> Identified {
        const FACTORS: [f64; 3] = [1.0, 1.0 / 3.0, 3.0];
        let beginnings = FACTORS.iter().flat_map(|mass| FACTORS.map(|friction| Vector2::new(mass.ln(), friction.ln())));
        let found = beginnings.map(|off| self.descend(&guess, off));
        let (_, found) = found.min_by(|a, b| a.0.total_cmp(&b.0)).expect("several beginnings");
        found
    }

    /// Levenberg-Marquardt from `off`, the logarithm of the factors on the guess. Returns the minimised sum of squares, too.
    fn descend(&self, guess: &Pusher<f64>, off: Vector2<f64>) -> (f64, Identified) {
        const MOST: usize = 60;
        let mut at = off;
        let mut here = self.residuals(guess, at);
        let mut damping = 1e-3;
        let mut iterations = 0;
        while iterations < MOST && damping < 1e8 {
            iterations += 1;
            let (curvature, slope) = here.normal();
            let damped = curvature + SMatrix::from_diagonal(&(curvature.diagonal() * damping));
            let Some(step) = damped.try_inverse().map(|inverse| -(inverse * slope)) else { break };
            // No more than a factor of e at a time.
            let step = step / step.amax().max(1.0);
            let there = self.residuals(guess, at + step);
            if there.square() < here.square() {
                let improved = here.square() - there.square();
                (at, here, damping) = (at + step, there, damping / 5.0);
                if improved < 1e-12 * here.square() {
                    break;
                }
            } else {
                damping *= 5.0;
            }
        }
        let seen = &here.values[2..];
        let square: f64 = seen.iter().map(|value| value * value).sum();
        let noise = (square / (seen.len() as f64 - 2.0).max(1.0)).sqrt();
        let inverse = here.normal().0.try_inverse().expect("a guess leaves nothing undecided");
        let identified = Identified {
            pusher: Pusher { mass: guess.mass * at[0].exp(), friction: guess.friction * at[1].exp(), ..*guess },
            deviations: [0, 1].map(|i| (noise * inverse[(i, i)].sqrt()).min(DOUBT)),
            residual: (square / seen.len() as f64).sqrt(),
            iterations,
        };
        (here.square(), identified)
    }

    /// The poses that the block of `pusher` has under the recorded motion of the hand.
    pub fn play(&self, pusher: &Pusher<f64>) -> Vec<[f64; 3]> {
        self.poses(pusher)
    }

    fn residuals(&self, guess: &Pusher<f64>, off: Vector2<f64>) -> Residuals {
        let direction = |i: usize| SVector::<f64, 2>::from_fn(|j, _| f64::from(u8::from(i == j)));
        let factor = |i: usize| nalgebra::ComplexField::exp(DualSVec64::new(off[i], Derivative::some(direction(i))));
        let pusher = guess.cast::<DualSVec64<2>>();
        let poses =
            self.poses(&Pusher { mass: pusher.mass * factor(0), friction: pusher.friction * factor(1), ..pusher });
        // The prior is two more residuals.
        let mut residuals = Residuals {
            values: (off * (NOISE / DOUBT)).iter().copied().collect(),
            slopes: [0, 1].map(|i| direction(i) * (NOISE / DOUBT)).to_vec(),
        };
        for (pose, seen) in poses.iter().zip(&self.block).skip(1) {
            for ((number, seen), size) in pose.iter().zip(seen).zip([1.0, 1.0, HALF]) {
                residuals.values.push(size * (number.re - seen));
                let slope = number.eps.unwrap_generic(nalgebra::Const::<2>, nalgebra::Const::<1>);
                residuals.slopes.push(slope * size);
            }
        }
        residuals
    }

    fn poses<S: nalgebra::RealField + Copy>(&self, pusher: &Pusher<S>) -> Vec<[S; 3]> {
        let number = nalgebra::convert::<f64, S>;
        let ([x, y], [block_x, block_y, angle]) = (self.hand[0], self.block[0]);
        let mut state = SVector::<S, STATE>::zeros();
        [x, y, block_x, block_y, angle].into_iter().enumerate().for_each(|(i, value)| state[i] = number(value));
        let mut poses = vec![[state[2], state[3], state[4]]];
        for hand in self.hand.windows(2) {
            (state[0], state[1]) = (number(hand[0][0]), number(hand[0][1]));
            let action = SVector::from([0, 1].map(|i| number((hand[1][i] - hand[0][i]) / (SPEED * DT))));
            state = pusher.step(&state, &action);
            poses.push([state[2], state[3], state[4]]);
        }
        poses
    }
}

impl Residuals {
    fn square(&self) -> f64 {
        self.values.iter().map(|value| value * value).sum()
    }

    /// Gauss-Newton's normal equations: curvature and gradient of half the sum of squares.
    fn normal(&self) -> (SMatrix<f64, 2, 2>, SVector<f64, 2>) {
        let pairs = self.values.iter().zip(&self.slopes);
        pairs.fold((SMatrix::zeros(), SVector::zeros()), |(curvature, slope), (value, of)| {
            (curvature + of * of.transpose(), slope + of * *value)
        })
    }
}
