//! Swing-up of pendulum and cart-pole as differentiable systems; the equations are those of [`crate::env`].

use std::f64::consts::PI;

use nalgebra::{RealField, SVector};

use super::{PolicyEnv, System};
use crate::env::{cartpole, pendulum};
use crate::rng::{Rng, uniform};

/// The pendulum: angle from upright (rad) and angular velocity (rad/s); the action is a torque divided by 2 N m. The cost is
/// smooth where the environment's has a kink as the angle wraps: 5 (1 - cos angle) instead of angle^2. Both are zero upright and about 10
/// hanging; near upright this one is 2.5 times as large.
#[derive(Clone, Copy, Debug, Default)]
pub struct PendulumSwing;

impl System<2, 1> for PendulumSwing {
    fn step<S: RealField + Copy>(&self, state: &SVector<S, 2>, action: &SVector<S, 1>) -> SVector<S, 2> {
        let torque = nalgebra::convert::<f64, S>(pendulum::MAX_TORQUE) * action[0];
        SVector::from(pendulum::swing([state[0], state[1]], torque))
    }

    fn cost<S: RealField + Copy>(&self, state: &SVector<S, 2>, action: &SVector<S, 1>) -> S {
        let number = nalgebra::convert::<f64, S>;
        let height = S::one() - state[0].cos();
        number(5.0) * height + number(0.1) * state[1] * state[1] + number(0.004) * action[0] * action[0]
    }

    fn final_cost<S: RealField + Copy>(&self, state: &SVector<S, 2>) -> S {
        let number = nalgebra::convert::<f64, S>;
        number(50.0) * (S::one() - state[0].cos()) + number(5.0) * state[1] * state[1]
    }
}

/// The environment's observations and initial states.
impl PolicyEnv<2, 1, 3> for PendulumSwing {
    fn observe<S: RealField + Copy>(&self, state: &SVector<S, 2>) -> SVector<S, 3> {
        SVector::from([state[0].cos(), state[0].sin(), state[1]])
    }

    fn start(&self, rng: &mut Rng) -> SVector<f64, 2> {
        SVector::from([uniform(rng, -PI, PI), uniform(rng, -1.0, 1.0)])
    }
}

/// The cart-pole, from hanging to upright in the middle: position (m), velocity (m/s), angle from upright (rad), angular
/// velocity (rad/s); the action is a force divided by 10 N.
#[derive(Clone, Copy, Debug, Default)]
pub struct CartPoleSwing;

impl System<4, 1> for CartPoleSwing {
    fn step<S: RealField + Copy>(&self, state: &SVector<S, 4>, action: &SVector<S, 1>) -> SVector<S, 4> {
        let force = nalgebra::convert::<f64, S>(cartpole::MAX_FORCE) * action[0];
        SVector::from(cartpole::roll([state[0], state[1], state[2], state[3]], force))
    }

    fn cost<S: RealField + Copy>(&self, state: &SVector<S, 4>, action: &SVector<S, 1>) -> S {
        let number = nalgebra::convert::<f64, S>;
        number(0.1) * state[0] * state[0]
            + (S::one() - state[2].cos())
            + number(0.01) * (state[1] * state[1] + state[3] * state[3])
            + number(0.01) * action[0] * action[0]
    }

    fn final_cost<S: RealField + Copy>(&self, state: &SVector<S, 4>) -> S {
        let number = nalgebra::convert::<f64, S>;
        let motion = state[1] * state[1] + state[3] * state[3];
        number(100.0) * (S::one() - state[2].cos()) + number(10.0) * (motion + state[0] * state[0])
    }
}
