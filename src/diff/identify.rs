//! System identification: estimates a block's mass and friction from a recorded push.
//!
//! The push is simulated in the [`Pusher`] with the recorded motion of the hand; dual numbers give the derivative of every pose
//! with respect to mass and friction, and least squares with a prior around the guess find both: a slow push tells next to
//! nothing about a mass.

use nalgebra::{Const, SVector, Vector2};
use num_dual::{Derivative, DualSVec64};

use super::least_squares::{Found, Residuals, direction, minimise};
use crate::error::{Error, Result};

use super::pusher::{DT, HALF, Pusher, SPEED, STATE};

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
/// let found = RecordedPush { hand, block }.identify(Pusher::default())?;
/// assert!(found.residual < 1e-3, "{} m", found.residual);
/// # Ok::<(), handful::error::Error>(())
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

impl RecordedPush {
    /// Estimates mass and friction near `guess`, whose other parameters are kept. The block starts at rest. The error of a whole
    /// trajectory has local minima, so the search starts nine times: from the guess, and a factor of three above and below.
    ///
    /// # Errors
    /// If there are fewer than two poses, hand and block do not have equally many, or a number is not finite.
    pub fn identify(&self, guess: Pusher<f64>) -> Result<Identified> {
        let (hands, blocks) = (self.hand.len(), self.block.len());
        if hands < 2 || hands != blocks {
            return Err(Error::Config(format!(
                "the recorded push has {hands} poses of the hand and {blocks} of the block; it needs equally many, at least two"
            )));
        }
        if self.hand.iter().flatten().chain(self.block.iter().flatten()).any(|x| !x.is_finite()) {
            return Err(Error::Config("the recorded push has a number that is not finite; leave its pose out".into()));
        }
        const FACTORS: [f64; 3] = [1.0, 1.0 / 3.0, 3.0];
        let beginnings = FACTORS.iter().flat_map(|mass| FACTORS.map(|friction| Vector2::new(mass.ln(), friction.ln())));
        let found = beginnings.map(|off| minimise(off, |off| self.residuals(&guess, off)));
        let Found { off, deviations, residual, iterations, .. } =
            found.min_by(|a, b| a.square.total_cmp(&b.square)).expect("several beginnings");
        let pusher = Pusher { mass: guess.mass * off[0].exp(), friction: guess.friction * off[1].exp(), ..guess };
        Ok(Identified { pusher, deviations, residual, iterations })
    }

    /// The poses that the block of `pusher` has under the recorded motion of the hand.
    ///
    /// # Panics
    /// If there is no pose of the hand, or none of the block.
    pub fn play(&self, pusher: &Pusher<f64>) -> Vec<[f64; 3]> {
        self.poses(pusher)
    }

    fn residuals(&self, guess: &Pusher<f64>, off: &Vector2<f64>) -> Residuals<2> {
        let factor = |i: usize| nalgebra::ComplexField::exp(DualSVec64::new(off[i], Derivative::some(direction(i))));
        let pusher = guess.cast::<DualSVec64<2>>();
        let poses =
            self.poses(&Pusher { mass: pusher.mass * factor(0), friction: pusher.friction * factor(1), ..pusher });
        let mut residuals = Residuals::prior(off, NOISE);
        for (pose, seen) in poses.iter().zip(&self.block).skip(1) {
            for ((number, seen), size) in pose.iter().zip(seen).zip([1.0, 1.0, HALF]) {
                let slope = number.eps.unwrap_generic(Const::<2>, Const::<1>);
                residuals.push((number.re, slope), *seen, size);
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
