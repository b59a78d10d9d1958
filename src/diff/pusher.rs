//! A planar pusher: a hand that pushes a block across a table with friction, seen from above, with smooth contact.
//!
//! Contact is compliant and smooth. The block is a square with slightly rounded corners (a ball of the 8-norm); the hand, one
//! or two disks, is pressed back by a force that is a softplus of the penetration. The stiffer the contact, the nearer to a
//! hard one, and the sharper the bend in the cost that gradients meet. Friction is regularised Coulomb friction: viscous below
//! a few millimetres per second, and integrated implicitly, so that it never reverses a motion.
//!
//! ```
//! use handful::diff::{Pusher, PusherTask};
//! use handful::nalgebra::{SVector, Vector2};
//!
//! // The hand at x = 0, the block 4 cm ahead; a second at full speed (0.2 m/s).
//! let mut state = SVector::from([0.0, 0.0, 0.04, 0.0, 0.0, 0.0, 0.0, 0.0]);
//! for _ in 0..20 {
//!     state = Pusher::default().step(&state, &Vector2::new(1.0, 0.0));
//! }
//! assert!((state[0] - 0.2).abs() < 1e-9 && state[2] > 0.2, "the block is pushed along");
//! let task = PusherTask { pusher: Pusher::default(), goal: [0.3, 0.0] };
//! assert!(task.distance(&state) < 0.1);
//! ```

use nalgebra::{RealField, SVector, Vector2};

use super::System;

/// Seconds of a control step.
pub const DT: f64 = 0.05;
/// Physics steps in it.
const SUBSTEPS: usize = 25;
/// Half the block's edge, m.
pub const HALF: f64 = 0.02;
/// Radius of a finger, m.
pub const FINGER: f64 = 0.01;
/// Speed of the hand at a full action, m/s.
pub const SPEED: f64 = 0.2;
const GRAVITY: f64 = 9.81;
/// Speed below which friction is viscous, m/s.
const STICKING: f64 = 2e-3;
/// The distance over which contact begins, m.
const SOFTNESS: f64 = 5e-4;

/// The parameters of block, hand and contact, in any kind of number: trajectories can be differentiated with respect to them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pusher<S> {
    /// Mass of the block, kg.
    pub mass: S,
    /// Friction between block and table.
    pub friction: S,
    /// Friction between hand and block.
    pub grip: S,
    /// Contact stiffness: force on a finger per penetration, N/m.
    pub stiffness: S,
    /// Distance of each of its two fingers from the hand's centre, along y, m. At zero there is only one.
    pub spread: S,
}

impl Default for Pusher<f64> {
    /// The cube of the `push` task: 4 cm, 64 g, friction 0.5.
    fn default() -> Self {
        Self { mass: 0.064, friction: 0.5, grip: 0.3, stiffness: 500.0, spread: 0.0 }
    }
}

impl Pusher<f64> {
    /// The same block in numbers of another kind.
    pub(super) fn cast<S: RealField + Copy>(&self) -> Pusher<S> {
        let Pusher { mass, friction, grip, stiffness, spread } = *self;
        let [mass, friction, grip, stiffness, spread] =
            [mass, friction, grip, stiffness, spread].map(nalgebra::convert);
        Pusher { mass, friction, grip, stiffness, spread }
    }
}

/// Dimension of a state: the hand's position (m), the block's position (m) and angle (rad), the block's velocity (m/s) and angular
/// velocity (rad/s), in this order.
pub const STATE: usize = 8;

impl<S: RealField + Copy> Pusher<S> {
    /// The state after a control step; the action is the hand's velocity divided by [`SPEED`].
    pub fn step(&self, state: &SVector<S, STATE>, action: &SVector<S, 2>) -> SVector<S, STATE> {
        let number = nalgebra::convert::<f64, S>;
        let dt = number(DT / SUBSTEPS as f64);
        let velocity = action * number(SPEED);
        let mut hand = Vector2::new(state[0], state[1]);
        let mut block = Vector2::new(state[2], state[3]);
        let mut angle = state[4];
        let mut moving = Vector2::new(state[5], state[6]);
        let mut spin = state[7];
        let inertia = self.mass * number(2.0 / 3.0 * HALF * HALF);
        // Mean distance of the block's sole from its middle.
        let lever = number(0.7652 * HALF);
        for _ in 0..SUBSTEPS {
            hand += velocity * dt;
            let (mut force, mut torque) = (Vector2::zeros(), S::zero());
            let fingers = [self.spread, -self.spread];
            for finger in &fingers[..if self.spread.is_zero() { 1 } else { 2 }] {
                let finger = hand + Vector2::new(S::zero(), *finger);
                let (press, arm) = self.contact(finger, velocity, block, angle, moving, spin);
                force += press;
                torque += arm.perp(&press);
            }
            moving += force * (dt / self.mass);
            spin += torque * (dt / inertia);
            let hold = self.friction * number(GRAVITY) * dt;
            let still = number(STICKING * STICKING);
            moving /= S::one() + hold / (moving.norm_squared() + still).sqrt();
            let rim = spin * lever;
            let turning = hold * self.mass * lever * lever / inertia;
            spin /= S::one() + turning / (rim * rim + still).sqrt();
            block += moving * dt;
            angle += spin * dt;
        }
        SVector::from([hand.x, hand.y, block.x, block.y, angle, moving.x, moving.y, spin])
    }

    /// A finger's force on the block, and where it acts, from the block's middle.
    fn contact(
        &self,
        finger: Vector2<S>,
        velocity: Vector2<S>,
        block: Vector2<S>,
        angle: S,
        moving: Vector2<S>,
        spin: S,
    ) -> (Vector2<S>, Vector2<S>) {
        let number = nalgebra::convert::<f64, S>;
        let (sin, cos) = angle.sin_cos();
        let away = finger - block;
        // In the block's frame, in halves of its edge.
        let half = number(HALF);
        let p = Vector2::new(cos * away.x + sin * away.y, cos * away.y - sin * away.x) / half;
        // |p|_8 and its gradient; never quite zero.
        let powers = p.x.powi(8) + p.y.powi(8) + number(1e-6);
        let size = powers.powf(number(0.125));
        let normal = Vector2::new(p.x.powi(7), p.y.powi(7)) * (size / powers);
        let entered = number(FINGER) - (size - S::one()) * half;
        let press = self.stiffness * softplus(entered, number(SOFTNESS));
        let out = Vector2::new(cos * normal.x - sin * normal.y, sin * normal.x + cos * normal.y);
        let out = out / (out.norm_squared() + number(1e-12)).sqrt();
        let arm = away - out * number(FINGER);
        // How the finger slides over the block's side.
        let side = Vector2::new(-out.y, out.x);
        let surface = moving + Vector2::new(-arm.y, arm.x) * spin;
        let slip = (velocity - surface).dot(&side);
        let drag = self.grip * press * slip / (slip * slip + number(1e-4)).sqrt();
        (side * drag - out * press, arm)
    }
}

/// `width ln(1 + exp(x / width))`, without overflow.
fn softplus<S: RealField + Copy>(x: S, width: S) -> S {
    let z = x / width;
    let positive = if z > S::zero() { z } else { S::zero() };
    width * (positive + (-z.abs()).exp().ln_1p())
}

/// Pushing the block to a goal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PusherTask {
    /// The block.
    pub pusher: Pusher<f64>,
    /// Goal of the block's centre, m.
    pub goal: [f64; 2],
}

impl PusherTask {
    /// A first guess of `steps` actions from `start`: round the block to the side away from the goal, then straight on. It
    /// does not push the block to the goal, but it makes contact; without contact the gradient is zero.
    pub fn guess(&self, start: &SVector<f64, STATE>, steps: usize) -> Vec<SVector<f64, 2>> {
        const ROUND: f64 = 3.5 * HALF;
        let (mut hand, block) = (Vector2::new(start[0], start[1]), Vector2::new(start[2], start[3]));
        let way = (Vector2::from(self.goal) - block).try_normalize(0.0).unwrap_or_else(Vector2::x);
        let mut pushing = false;
        let step = |_| {
            let off = hand - block;
            // How far round the block the hand still has to go, in (-pi, pi].
            let left = off.perp(&-way).atan2(-off.dot(&way));
            pushing |= left.abs() < 0.1 && off.norm() < 1.1 * ROUND;
            let velocity = if pushing {
                way * 0.4
            } else {
                let turned = off.y.atan2(off.x) + left.clamp(-0.4, 0.4);
                let next = block + Vector2::new(turned.cos(), turned.sin()) * ROUND;
                (next - hand) / (SPEED * DT)
            };
            let action = velocity / velocity.norm().max(1.0);
            hand += action * (SPEED * DT);
            action
        };
        (0..steps).map(step).collect()
    }

    /// Distance of the block from its goal, m.
    pub fn distance(&self, state: &SVector<f64, STATE>) -> f64 {
        (state[2] - self.goal[0]).hypot(state[3] - self.goal[1])
    }

    /// Squared distance of the block from its goal, dm^2.
    fn error<S: RealField + Copy>(&self, state: &SVector<S, STATE>) -> S {
        let number = nalgebra::convert::<f64, S>;
        let (x, y) = (state[2] - number(self.goal[0]), state[3] - number(self.goal[1]));
        number(100.0) * (x * x + y * y)
    }
}

impl System<STATE, 2> for PusherTask {
    fn step<S: RealField + Copy>(&self, state: &SVector<S, STATE>, action: &SVector<S, 2>) -> SVector<S, STATE> {
        self.pusher.cast().step(state, action)
    }

    fn cost<S: RealField + Copy>(&self, state: &SVector<S, STATE>, action: &SVector<S, 2>) -> S {
        nalgebra::convert::<f64, S>(0.1) * self.error(state) + nalgebra::convert::<f64, S>(1e-3) * action.norm_squared()
    }

    fn final_cost<S: RealField + Copy>(&self, state: &SVector<S, STATE>) -> S {
        nalgebra::convert::<f64, S>(50.0) * self.error(state)
    }
}
