//! System identification: the mass of what the hand holds, from one recorded lift.
//!
//! What is recorded is what an arm's own sensors say, joint angles and velocities, and the actions that were commanded; no camera,
//! no force sensor, no torques. The mass is observable because the controller knows only the arm: its motors carry the weight of
//! the links (the term g(q) of the torque), and nothing carries m g of the load. The hand sinks until the spring that draws it to
//! its goal, which has the stiffness 150/s2 per kilogram of operational-space inertia, balances that force; while it accelerates
//! it lags behind. Nothing else in the equations of motion depends on the load:
//!
//! M(q, m) q'' = tau - D q' - friction - c(q, q', m) - (g(q, m) - g(q, 0)).
//!
//! Each half second of the recording is simulated in the [`FreeArm`] from the angles and velocities that were measured at its
//! start, and a residual is the error of an angle at its end: by then the load has moved the joints by many times the resolution
//! of their sensors, and errors of the simulator have not piled up. (The angles in between err with it, and would only pretend to
//! be more data.) Dual numbers give the derivative of every angle with respect to the mass.
//!
//! - C. G. Atkeson, C. H. An, J. M. Hollerbach: "Estimation of inertial parameters of manipulator loads and links", International
//!   Journal of Robotics Research 5(3), 1986; there from measured torques.

use nalgebra::{SVector, Vector1, Vector3, convert};
use num_dual::Dual64;

use super::FreeArm;
use super::least_squares::{Residuals, minimise};
use crate::env::arm::{Inertia, JointVector};
use crate::error::{Error, Result};

/// Standard deviation of the error of an angle that no simulator explains, rad: the weight of the recording against the prior.
const NOISE: f64 = 1e-5;
/// Control steps that are simulated before the state is set to what was measured.
const WINDOW: usize = 10;

/// A recorded motion of the arm while its hand holds something and nothing else touches either.
///
/// ```
/// use handful::diff::{FreeArm, RecordedLift};
/// use handful::env::arm::{ArmDescription, Inertia};
/// use handful::nalgebra::Vector3;
///
/// let panda = ArmDescription::panda();
/// let arm = FreeArm::new(&panda, &panda.home);
/// let cube = |mass: f64| Inertia::cube(mass, 0.02, Vector3::zeros());
///
/// // A cube of 64 g is held up for a second.
/// let (loaded, mut state) = (arm.clone().holding(&cube(0.064)), arm.at_rest(&panda.home));
/// let mut lift = RecordedLift::from_start(panda.home, panda.home * 0.0);
/// for _ in 0..20 {
///     let action = Vector3::new(0.0, 0.0, 0.1);
///     state = loaded.step(&state, &action);
///     lift.push(action, state.fixed_rows::<7>(0).into(), state.fixed_rows::<7>(7).into());
/// }
/// let found = lift.identify(&arm, &cube(0.1))?;
/// assert!((found.body.mass / 0.064 - 1.0).abs() < 1e-3);
/// # Ok::<(), handful::error::Error>(())
/// ```
#[doc(alias = "payload")]
#[doc(alias = "load identification")]
#[derive(Clone, Debug, PartialEq)]
pub struct RecordedLift {
    /// Joint angles (rad) and velocities (rad/s) at each control step, the start included.
    joints: Vec<[JointVector; 2]>,
    /// Actions, one less: where the goal of the hand lay, seen from the hand.
    actions: Vec<Vector3<f64>>,
}

/// The result of [`RecordedLift::identify`].
#[derive(Clone, Debug)]
pub struct IdentifiedLoad {
    /// The guess, with the mass that explains the recording best.
    pub body: Inertia,
    /// Standard deviation of the logarithm of the mass, and so, where it is small, of the mass relative to itself (Laplace
    /// approximation, the residual taken as noise). Near one, that of the prior, the recording carries no information.
    pub deviation: f64,
    /// Root-mean-square residual of a joint angle, rad.
    pub residual: f64,
    /// Gauss-Newton steps taken.
    pub iterations: usize,
}

impl RecordedLift {
    /// A recording that begins at these joint angles (rad) and velocities (rad/s).
    pub fn from_start(q: JointVector, qd: JointVector) -> Self {
        Self { joints: vec![[q, qd]], actions: Vec::new() }
    }

    /// Adds a control step: the action, each component in [-1, 1], and the joint angles (rad) and velocities (rad/s) after it.
    pub fn push(&mut self, action: Vector3<f64>, q: JointVector, qd: JointVector) {
        self.actions.push(action);
        self.joints.push([q, qd]);
    }

    /// Control steps recorded.
    pub fn steps(&self) -> usize {
        self.actions.len()
    }

    /// Estimates the mass of what `arm`, itself with an empty hand, has held. Centre of mass and shape are those of `guess`; a
    /// centre that is off by 4 mm, seen from a shoulder half a metre away, puts the mass wrong by up to a percent.
    ///
    /// # Errors
    /// If no control step was recorded, or a number is not finite.
    pub fn identify(&self, arm: &FreeArm, guess: &Inertia) -> Result<IdentifiedLoad> {
        if self.actions.is_empty() {
            return Err(Error::Config("the recorded lift has no control step; `push` at least one".into()));
        }
        let finite =
            |(t, joints): (usize, &[JointVector; 2])| joints.iter().flatten().any(|x| !x.is_finite()).then_some(t);
        if let Some(t) = self.joints.iter().enumerate().find_map(finite) {
            return Err(Error::Config(format!("joint state {t} of the recorded lift is not finite; leave it out")));
        }
        if let Some(t) = self.actions.iter().position(|action| action.iter().any(|a| !a.is_finite())) {
            return Err(Error::Config(format!("action {t} of the recorded lift is not finite; leave its step out")));
        }
        let arm = arm.cast::<Dual64>();
        let found = minimise(Vector1::zeros(), |off| self.residuals(&arm, guess, off));
        let factor = found.off[0].exp();
        let body = Inertia { mass: guess.mass * factor, com: guess.com, tensor: guess.tensor * factor };
        let [deviation] = found.deviations;
        Ok(IdentifiedLoad { body, deviation, residual: found.residual, iterations: found.iterations })
    }

    fn residuals(&self, arm: &FreeArm<Dual64>, guess: &Inertia, off: &Vector1<f64>) -> Residuals<1> {
        let factor = nalgebra::ComplexField::exp(Dual64::new(off[0], 1.0));
        let guess = guess.cast::<Dual64>();
        let body = Inertia { mass: guess.mass * factor, com: guess.com, tensor: guess.tensor * factor };
        let arm = arm.clone().holding(&body);
        let mut residuals = Residuals::prior(off, NOISE);
        let mut state = SVector::zeros();
        for (t, action) in self.actions.iter().enumerate() {
            if t % WINDOW == 0 {
                let [q, qd] = self.joints[t].map(|numbers| numbers.map(convert));
                state = arm.state(&q, &qd);
            }
            state = arm.step(&state, &action.map(convert));
            if (t + 1) % WINDOW == 0 || t + 1 == self.actions.len() {
                let [q, _] = self.joints[t + 1];
                let angles = state.iter().zip(&q);
                angles.for_each(|(x, seen)| residuals.push((x.re, Vector1::new(x.eps)), *seen, 1.0));
            }
        }
        residuals
    }
}
