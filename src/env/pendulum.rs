//! `pendulum`: swing a pendulum up and hold it upright. Gymnasium's Pendulum-v1, number for number.
//!
//! ```
//! use handful::env::pendulum::{Pendulum, PendulumState};
//! use handful::prelude::*;
//!
//! let mut env = Pendulum::default();
//! let obs = env.reset(3); // cos, sin, angular velocity (rad/s)
//! let step = env.step(&[1.0])?; // 2 N m
//! assert!((obs[0].hypot(obs[1]) - 1.0).abs() < 1e-6 && step.reward <= 0.0);
//!
//! // Without the environment around it: angle 0 is upright.
//! let mut state = PendulumState::new(0.0, 0.0);
//! assert_eq!(state.step(0.0), 0.0);
//! # Ok::<(), Error>(())
//! ```

use std::f64::consts::PI;

use nalgebra::{RealField, UnitQuaternion, Vector3};

use super::arm::{Pose, Primitive};
use super::scene::{Body, Camera};
use super::{Env, Feature, KnownReward, Snapshot, Spec, Step};
use crate::error::Result;
use crate::rng;

const GRAVITY: f64 = 10.0;
const DT: f64 = 0.05;
const MAX_SPEED: f64 = 8.0;
/// Torque of a full action, N m.
pub const MAX_TORQUE: f64 = 2.0;

/// Angle from upright (rad, not wrapped) and angular velocity (rad/s).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PendulumState {
    /// Angle from upright.
    pub angle: f64,
    /// Angular velocity.
    pub speed: f64,
    elapsed: usize,
}

impl PendulumState {
    /// A state at the start of an episode.
    pub fn new(angle: f64, speed: f64) -> Self {
        Self { angle, speed, elapsed: 0 }
    }

    /// Applies a torque (N m; clipped to 2) for one step of 0.05 s. Returns the reward, which is that of the state *before*
    /// the step.
    pub fn step(&mut self, torque: f64) -> f64 {
        let torque = torque.clamp(-MAX_TORQUE, MAX_TORQUE);
        let reward = reward(self.angle, self.speed, torque);
        [self.angle, self.speed] = swing([self.angle, self.speed], torque);
        self.elapsed += 1;
        reward
    }

    fn observe(&self) -> Vec<f32> {
        vec![self.angle.cos() as f32, self.angle.sin() as f32, self.speed as f32]
    }

    fn upright(&self) -> bool {
        wrapped(self.angle).abs() < 0.2
    }
}

/// Angle and angular velocity after a step under a torque (N m), for any kind of number: dual numbers carry derivatives
/// through it.
pub fn swing<S: RealField + Copy>([angle, speed]: [S; 2], torque: S) -> [S; 2] {
    let number = nalgebra::convert::<f64, S>;
    let acceleration = number(1.5 * GRAVITY) * angle.sin() + number(3.0) * torque;
    let speed = (speed + acceleration * number(DT)).clamp(number(-MAX_SPEED), number(MAX_SPEED));
    [angle + speed * number(DT), speed]
}

fn reward(angle: f64, speed: f64, torque: f64) -> f64 {
    -(wrapped(angle).powi(2) + 0.1 * speed.powi(2) + 0.001 * torque.powi(2))
}

/// The same angle in [-pi, pi).
fn wrapped(angle: f64) -> f64 {
    (angle + PI).rem_euclid(2.0 * PI) - PI
}

/// The environment: observes (cos, sin, angular velocity); an action is a torque divided by 2 N m.
#[derive(Clone, Debug)]
pub struct Pendulum {
    spec: Spec,
    state: PendulumState,
}

impl Default for Pendulum {
    fn default() -> Self {
        let speed = Feature::new("angular velocity").around(0.0, MAX_SPEED as f32);
        Self {
            spec: Spec::new("pendulum", [Feature::new("cos angle"), Feature::new("sin angle"), speed], 1, 200, DT)
                .stages(["upright"]),
            state: PendulumState::new(PI, 0.0),
        }
    }
}

impl Env for Pendulum {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        let mut rng = rng::stream(seed, "reset");
        let angle = rng::uniform(&mut rng, -PI, PI);
        self.state = PendulumState::new(angle, rng::uniform(&mut rng, -1.0, 1.0));
        self.state.observe()
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        self.spec.check_action(action)?;
        let reward = self.state.step(MAX_TORQUE * f64::from(action[0]));
        let success = self.state.upright();
        let truncated = self.state.elapsed >= self.spec.horizon;
        let step = Step::new(self.state.observe(), reward as f32).truncated(truncated);
        Ok(step.success(success).stage(usize::from(success)))
    }

    fn scene(&self) -> Vec<Body> {
        let rod = vec![Primitive::capsule(0.03, [0.0; 3], [0.0, 0.0, 1.0]), Primitive::ball(0.06, [0.0; 3])];
        let tip = vec![Primitive::ball(0.08, [0.0; 3])];
        vec![Body::solid("rod", "#c9a97c", rod), Body::solid("hand", "#d8443c", tip)]
    }

    fn poses(&self) -> Vec<Pose> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), self.state.angle);
        let rod = Pose::from_parts(Vector3::new(0.0, 0.0, 1.2).into(), turn);
        vec![rod, rod * Pose::translation(0.0, 0.0, 1.0)]
    }

    fn camera(&self) -> Camera {
        Camera { eye: [4.2, 0.6, 1.6], target: [0.0, 0.0, 1.2] }
    }

    /// The pendulum's tip.
    fn position_of(&self, obs: &[f32]) -> Option<[f64; 3]> {
        Some([0.0, -f64::from(obs[1]), 1.2 + f64::from(obs[0])])
    }
}

impl KnownReward for Pendulum {
    fn reward(&self, obs: &[f32], action: &[f32], _next_obs: &[f32]) -> f32 {
        let angle = f64::from(obs[1]).atan2(obs[0].into());
        let torque = (MAX_TORQUE * f64::from(action[0])).clamp(-MAX_TORQUE, MAX_TORQUE);
        reward(angle, obs[2].into(), torque) as f32
    }
}

impl Snapshot for Pendulum {
    type State = PendulumState;

    fn snapshot(&self) -> PendulumState {
        self.state
    }

    fn restore(&mut self, state: &PendulumState) {
        self.state = *state;
    }
}
