//! `cartpole`: balance a pole on a cart by pushing the cart with any force up to 10 N.
//!
//! The continuous cart-pole of the PETS literature as mbrl-lib has it: the equations of Gym's CartPole-v1, the force
//! proportional to the action, reward 1 while the pole stands, 200 steps.
//!
//! ```
//! use handful::env::cartpole::CartPole;
//! use handful::prelude::*;
//!
//! let mut env = CartPole::default();
//! let obs = env.reset(0); // position (m), velocity (m/s), angle (rad), angular velocity (rad/s)
//! let step = env.step(&[0.1])?; // 1 N
//! assert!(step.success && step.reward == 1.0);
//! assert!(env.terminated(&[0.0, 0.0, 0.3, 0.0]), "0.3 rad is too far from upright");
//! # Ok::<(), Error>(())
//! ```

use nalgebra::{RealField, UnitQuaternion, Vector3};

use super::arm::{Pose, Primitive};
use super::scene::{Body, Camera};
use super::{Env, Feature, KnownReward, Snapshot, Spec, Step};
use crate::error::Result;
use crate::rng;

const GRAVITY: f64 = 9.8;
const CART: f64 = 1.0;
const POLE: f64 = 0.1;
/// Half the pole's length, m.
const HALF_LENGTH: f64 = 0.5;
const DT: f64 = 0.02;
/// Force of a full action, N.
pub const MAX_FORCE: f64 = 10.0;
/// The cart may be this far from the centre, m.
const MAX_POSITION: f64 = 2.4;
/// The pole may lean this far, rad (12 degrees).
const MAX_ANGLE: f64 = 12.0 * std::f64::consts::PI / 180.0;

/// Cart position (m) and velocity (m/s), pole angle from upright (rad) and its velocity (rad/s).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CartPoleState {
    /// Cart position.
    pub position: f64,
    /// Cart velocity.
    pub velocity: f64,
    /// Pole angle from upright.
    pub angle: f64,
    /// Pole angular velocity.
    pub spin: f64,
    elapsed: usize,
}

impl CartPoleState {
    /// A state at the start of an episode.
    pub fn new([position, velocity, angle, spin]: [f64; 4]) -> Self {
        Self { position, velocity, angle, spin, elapsed: 0 }
    }

    /// Pushes the cart with `force` (N) for one step of 0.02 s (explicit Euler, as in Gym).
    pub fn step(&mut self, force: f64) {
        let before = [self.position, self.velocity, self.angle, self.spin];
        [self.position, self.velocity, self.angle, self.spin] = roll(before, force);
        self.elapsed += 1;
    }

    fn observe(&self) -> Vec<f32> {
        [self.position, self.velocity, self.angle, self.spin].map(|x| x as f32).to_vec()
    }
}

/// Position, velocity, angle and angular velocity after a step under a force (N), for any kind of number: dual numbers
/// carry derivatives through it.
pub fn roll<S: RealField + Copy>([position, velocity, angle, spin]: [S; 4], force: S) -> [S; 4] {
    let number = nalgebra::convert::<f64, S>;
    let (sin, cos) = angle.sin_cos();
    let (total, lever) = (number(CART + POLE), number(POLE * HALF_LENGTH));
    let pushed = (force + lever * spin.powi(2) * sin) / total;
    let inertia = number(HALF_LENGTH) * (number(4.0 / 3.0) - number(POLE) * cos * cos / total);
    let turning = (number(GRAVITY) * sin - cos * pushed) / inertia;
    let sliding = pushed - lever * turning * cos / total;
    let dt = number(DT);
    [position + dt * velocity, velocity + dt * sliding, angle + dt * spin, spin + dt * turning]
}

/// The environment: observes the state; an action is a force divided by 10 N.
#[derive(Clone, Debug)]
pub struct CartPole {
    spec: Spec,
    state: CartPoleState,
}

impl Default for CartPole {
    fn default() -> Self {
        let observation = [("position", 1.0), ("velocity", 1.0), ("angle", 0.1), ("angular velocity", 1.0)]
            .map(|(name, scale)| Feature::new(name).around(0.0, scale));
        Self {
            spec: Spec::new("cartpole", observation, 1, 200, DT).stages(["standing"]),
            state: CartPoleState::new([0.0; 4]),
        }
    }
}

impl Env for CartPole {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        let mut rng = rng::stream(seed, "reset");
        self.state = CartPoleState::new([0; 4].map(|_| rng::uniform(&mut rng, -0.05, 0.05)));
        self.state.observe()
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        self.spec.check_action(action)?;
        self.state.step(MAX_FORCE * f64::from(action[0]).clamp(-1.0, 1.0));
        let observation = self.state.observe();
        let terminated = self.terminated(&observation);
        let truncated = !terminated && self.state.elapsed >= self.spec.horizon;
        let step = Step::new(observation, f32::from(!terminated)).terminated(terminated).truncated(truncated);
        Ok(step.success(!terminated).stage(usize::from(!terminated)))
    }

    fn scene(&self) -> Vec<Body> {
        let rail = Primitive::cuboid([MAX_POSITION, 0.02, 0.02], [0.0; 3]);
        let cart = Primitive::cuboid([0.2, 0.12, 0.1], [0.0; 3]);
        let pole = Primitive::capsule(0.03, [0.0; 3], [0.0, 0.0, 2.0 * HALF_LENGTH]);
        vec![
            Body::solid("rail", "#39424e", vec![rail]),
            Body::solid("cart", "#3c6fd8", vec![cart]),
            Body::solid("pole", "#c9a97c", vec![pole]),
        ]
    }

    fn poses(&self) -> Vec<Pose> {
        let at = Vector3::new(self.state.position, 0.0, 0.5);
        let lean = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), self.state.angle);
        let cart = Pose::translation(at.x, at.y, at.z);
        vec![Pose::translation(0.0, 0.0, 0.38), cart, Pose::from_parts(at.into(), lean)]
    }

    fn camera(&self) -> Camera {
        Camera { eye: [0.8, -4.6, 1.6], target: [0.0, 0.0, 0.9] }
    }

    /// The pole's tip.
    fn position_of(&self, obs: &[f32]) -> Option<[f64; 3]> {
        let (sin, cos) = f64::from(obs[2]).sin_cos();
        Some([f64::from(obs[0]) + 2.0 * HALF_LENGTH * sin, 0.0, 0.5 + 2.0 * HALF_LENGTH * cos])
    }
}

impl KnownReward for CartPole {
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        f32::from(!self.terminated(next_obs))
    }

    fn terminated(&self, next_obs: &[f32]) -> bool {
        f64::from(next_obs[0]).abs() > MAX_POSITION || f64::from(next_obs[2]).abs() > MAX_ANGLE
    }
}

impl Snapshot for CartPole {
    type State = CartPoleState;

    fn snapshot(&self) -> CartPoleState {
        self.state
    }

    fn restore(&mut self, state: &CartPoleState) {
        self.state = *state;
    }
}
