//! Differentiable simulation: simulators are written once for any kind of number, and dual numbers carry exact derivatives
//! through them.
//!
//! A [`System`] is such a simulator with a cost to be minimised. [`derivatives`] has the Jacobians of a step and the gradients of
//! whole rollouts in forward mode and in reverse mode (the adjoint method). Built on them:
//!
//! - [`Ilqr`]: trajectory optimisation, and receding-horizon control with it ([`IlqrControl`]);
//! - [`AnalyticPolicyGradient`]: a policy network trained by backpropagation through simulator and network;
//! - [`RecordedPush::identify`], [`RecordedLift::identify`]: system identification;
//! - [`Simulated`]: a system as the objective of any planner in [`crate::plan`].
//!
//! ```
//! use handful::diff::derivatives::{gradient, gradient_by_differences};
//! use handful::diff::{Ilqr, IlqrConfig, PendulumSwing};
//! use handful::nalgebra::{Vector1, Vector2};
//!
//! let hanging = Vector2::new(std::f64::consts::PI, 0.0);
//! let guess = vec![Vector1::new(0.1); 60];
//! let (cost, exact, _) = gradient(&PendulumSwing, &hanging, &guess);
//! let approximate = gradient_by_differences(&PendulumSwing, &hanging, &guess, 1e-6);
//! assert!((exact[0] - approximate[0]).norm() < 1e-5 * exact[0].norm());
//!
//! let solution = Ilqr::new(IlqrConfig::default()).solve(&PendulumSwing, &hanging, &guess);
//! assert!(solution.cost < 0.9 * cost);
//! ```

pub mod arm;
pub mod derivatives;
mod identify;
mod ilqr;
mod least_squares;
mod lift;
mod policy;
pub mod pusher;
mod simulated;
mod swing;

use nalgebra::{RealField, SVector};

pub use arm::{FreeArm, ReachTask};
pub use identify::{Identified, RecordedPush};
pub use ilqr::{Ilqr, IlqrConfig, IlqrControl, Solution};
pub use lift::{IdentifiedLoad, RecordedLift};
pub use policy::{AnalyticPolicyGradient, AnalyticPolicyGradientConfig, PolicyEnv};
pub use pusher::{Pusher, PusherTask};
pub use simulated::Simulated;
pub use swing::{CartPoleSwing, PendulumSwing};

/// Dynamics with a state of `N` numbers and an action of `M`, each in [-1, 1], and a cost to be minimised. Generic over the
/// kind of number `S`, so that dual numbers can be put through.
///
/// ```
/// use handful::diff::derivatives::linearise;
/// use handful::diff::System;
/// use handful::nalgebra::{RealField, SVector, Vector1, Vector2, convert};
///
/// /// Position and velocity of a mass that is pushed, 0.1 s a step; it is to come to rest at zero.
/// struct Mass;
///
/// impl System<2, 1> for Mass {
///     fn step<S: RealField + Copy>(&self, state: &SVector<S, 2>, action: &SVector<S, 1>) -> SVector<S, 2> {
///         let dt: S = convert(0.1);
///         SVector::from([state[0] + state[1] * dt, state[1] + action[0] * dt])
///     }
///     fn cost<S: RealField + Copy>(&self, _state: &SVector<S, 2>, action: &SVector<S, 1>) -> S {
///         action[0] * action[0] * convert(0.01)
///     }
///     fn final_cost<S: RealField + Copy>(&self, state: &SVector<S, 2>) -> S {
///         state.norm_squared()
///     }
/// }
///
/// let linear = linearise(&Mass, &Vector2::new(1.0, 0.0), &Vector1::new(0.0));
/// assert_eq!((linear.by_state[(0, 1)], linear.by_action[(1, 0)]), (0.1, 0.1));
/// ```
#[doc(alias = "differentiable simulator")]
pub trait System<const N: usize, const M: usize>: Sync {
    /// How many numbers of the state, the first ones, a step depends on. The others only follow from them, for costs to read.
    const READS: usize = N;

    /// The state after a control step.
    fn step<S: RealField + Copy>(&self, state: &SVector<S, N>, action: &SVector<S, M>) -> SVector<S, N>;

    /// The cost of an action in a state. [`Ilqr`] takes it to be a function of the state plus one of the action.
    fn cost<S: RealField + Copy>(&self, state: &SVector<S, N>, action: &SVector<S, M>) -> S;

    /// The cost of the state that a rollout ends in. [`AnalyticPolicyGradient`] does not use it.
    fn final_cost<S: RealField + Copy>(&self, state: &SVector<S, N>) -> S;
}

/// The trajectory of states, `start` included (one more than `actions`), and its total cost with the final cost.
pub fn roll_out<S: RealField + Copy, const N: usize, const M: usize>(
    system: &impl System<N, M>,
    start: &SVector<S, N>,
    actions: &[SVector<S, M>],
) -> (Vec<SVector<S, N>>, S) {
    let mut states = vec![*start];
    let mut cost = S::zero();
    for action in actions {
        let state = states[states.len() - 1];
        cost += system.cost(&state, action);
        states.push(system.step(&state, action));
    }
    cost += system.final_cost(&states[states.len() - 1]);
    (states, cost)
}
