//! System identification: what a block must be like to have moved as it did.
//!
//! A recorded push is played again in the [`Pusher`]; dual numbers tell how every recorded pose would change with the block's
//! mass and friction, and Gauss-Newton steps (Levenberg's, damped) lead to those that explain it best. Both are sought as
//! logarithms, since both are positive.

use nalgebra::{SMatrix, SVector, Vector2};
use num_dual::{Derivative, DualSVec64};

use super::pusher::{DT, HALF, Pusher, SPEED, STATE};

/// A push as it was seen, once each control step, the start included.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Recording {
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
    /// Standard deviations of the logarithms of mass and friction, if what is left unexplained is noise.
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

impl Recording {
    /// Finds mass and friction near `guess`, whose stiffness is kept. The block is taken to be at rest at first. A whole
    /// trajectory has valleys that lead nowhere; so the search begins several times, a factor of three up and down too.
    pub fn identify(&self, guess: Pusher<f64>) -> Identified {
        const FACTORS: [f64; 3] = [1.0, 1.0 / 3.0, 3.0];
        let beginnings = FACTORS.iter().flat_map(|mass| FACTORS.map(|friction| (mass, friction)));
        let found = beginnings.map(|(mass, friction)| {
            self.descend(Pusher { mass: guess.mass * mass, friction: guess.friction * friction, ..guess })
        });
        found.min_by(|a, b| a.residual.total_cmp(&b.residual)).expect("several beginnings")
    }

    fn descend(&self, guess: Pusher<f64>) -> Identified {
        const MOST: usize = 60;
        let mut at = Vector2::new(guess.mass.ln(), guess.friction.ln());
        let mut here = self.residuals(at, guess.stiffness);
        let mut damping = 1e-3;
        let mut iterations = 0;
        while iterations < MOST && damping < 1e8 {
            iterations += 1;
            let (curvature, slope) = here.normal();
            let damped = curvature + SMatrix::from_diagonal(&curvature.diagonal().map(|c| damping * c.max(1e-12)));
            let Some(step) = damped.try_inverse().map(|inverse| -(inverse * slope)) else { break };
            // No more than a factor of e at a time.
            let step = step / step.amax().max(1.0);
            let there = self.residuals(at + step, guess.stiffness);
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
        let count = here.values.len() as f64;
        let noise = here.square() / (count - 2.0).max(1.0);
        let spread = here
            .normal()
            .0
            .try_inverse()
            .map_or([f64::INFINITY; 2], |inverse| [0, 1].map(|i| (noise * inverse[(i, i)]).max(0.0).sqrt()));
        Identified {
            pusher: Pusher { mass: at[0].exp(), friction: at[1].exp(), stiffness: guess.stiffness },
            deviations: spread,
            residual: (here.square() / count).sqrt(),
            iterations,
        }
    }

    /// The poses that a block would have had under this hand.
    pub fn play(&self, pusher: &Pusher<f64>) -> Vec<[f64; 3]> {
        self.poses(pusher.mass, pusher.friction, pusher.stiffness)
    }

    fn residuals(&self, logarithms: Vector2<f64>, stiffness: f64) -> Residuals {
        let variable = |i: usize| {
            let direction = SVector::<f64, 2>::from_fn(|j, _| f64::from(u8::from(i == j)));
            let logarithm = DualSVec64::<2>::new(logarithms[i], Derivative::some(direction));
            nalgebra::ComplexField::exp(logarithm)
        };
        let poses = self.poses(variable(0), variable(1), DualSVec64::from_re(stiffness));
        let mut residuals = Residuals { values: Vec::new(), slopes: Vec::new() };
        for (pose, seen) in poses.iter().zip(&self.block).skip(1) {
            for ((number, seen), size) in pose.iter().zip(seen).zip([1.0, 1.0, HALF]) {
                residuals.values.push(size * (number.re - seen));
                let slope = number.eps.unwrap_generic(nalgebra::Const::<2>, nalgebra::Const::<1>);
                residuals.slopes.push(slope * size);
            }
        }
        residuals
    }

    fn poses<S: nalgebra::RealField + Copy>(&self, mass: S, friction: S, stiffness: S) -> Vec<[S; 3]> {
        let number = nalgebra::convert::<f64, S>;
        let pusher = Pusher { mass, friction, stiffness };
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
