//! System identification: what a block must be like to have moved as it did.
//!
//! A recorded push is played again in the [`Pusher`]; dual numbers tell how every recorded pose would change with the block's
//! mass and friction, and Gauss-Newton steps (Levenberg's, damped) lead to those that explain it best. Both are sought as
//! logarithms, since both are positive, and believed to lie near the guess as long as the recording does not say otherwise: a
//! slow push tells next to nothing of a mass.

use nalgebra::{SMatrix, SVector, Vector2};
use num_dual::{Derivative, DualSVec64};

use super::pusher::{DT, HALF, Pusher, SPEED, STATE};

/// How far a guess may be off: the standard deviation of the two logarithms beforehand.
const DOUBT: f64 = 1.0;
/// What of a pose no simulator explains, m: the weight of the recording against the guess.
const NOISE: f64 = 1e-3;

/// A push as it was seen, once each control step, the start included.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordedPush {
    /// Where the hand was, m.
    pub hand: Vec<[f64; 2]>,
    /// Where the block was, m, and its angle, rad.
    pub block: Vec<[f64; 3]>,
}

/// What was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Identified {
    /// The block that explains the recording best.
    pub pusher: Pusher<f64>,
    /// Standard deviations of the logarithms of mass and friction, if what is left unexplained is noise. Where they are near one
    /// the recording has not told anything, and the guess was kept.
    pub deviations: [f64; 2],
    /// Root mean square of what is left unexplained, m; angles count by how far they move the middle of an edge.
    pub residual: f64,
    /// Gauss-Newton steps taken.
    pub iterations: usize,
}

/// Residuals of all poses, and their slopes with respect to the two logarithms.
struct Residuals {
    values: Vec<f64>,
    slopes: Vec<SVector<f64, 2>>,
}

impl RecordedPush {
    /// Finds mass and friction near `guess`, whose grip and stiffness are kept. The block is taken to be at rest at first. A
    /// whole trajectory has valleys that lead nowhere; so the search begins several times, a factor of three up and down too.
    pub fn identify(&self, guess: Pusher<f64>) -> Identified {
        const FACTORS: [f64; 3] = [1.0, 1.0 / 3.0, 3.0];
        let beginnings = FACTORS.iter().flat_map(|mass| FACTORS.map(|friction| Vector2::new(mass.ln(), friction.ln())));
        let found = beginnings.map(|off| self.descend(&guess, off));
        let (_, found) = found.min_by(|a, b| a.0.total_cmp(&b.0)).expect("several beginnings");
        found
    }

    /// Gauss-Newton steps from `off` the guess, in logarithms. Returns what was minimised, too.
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

    /// The poses that a block would have had under this hand.
    pub fn play(&self, pusher: &Pusher<f64>) -> Vec<[f64; 3]> {
        self.poses(pusher)
    }

    fn residuals(&self, guess: &Pusher<f64>, off: Vector2<f64>) -> Residuals {
        let direction = |i: usize| SVector::<f64, 2>::from_fn(|j, _| f64::from(u8::from(i == j)));
        let factor = |i: usize| nalgebra::ComplexField::exp(DualSVec64::new(off[i], Derivative::some(direction(i))));
        let pusher = guess.cast::<DualSVec64<2>>();
        let poses =
            self.poses(&Pusher { mass: pusher.mass * factor(0), friction: pusher.friction * factor(1), ..pusher });
        // The guess is two residuals more.
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

    /// Gauss-Newton's curvature and slope of half the square.
    fn normal(&self) -> (SMatrix<f64, 2, 2>, SVector<f64, 2>) {
        let pairs = self.values.iter().zip(&self.slopes);
        pairs.fold((SMatrix::zeros(), SVector::zeros()), |(curvature, slope), (value, of)| {
            (curvature + of * of.transpose(), slope + of * *value)
        })
    }
}
