//! Simulators that can be differentiated: their lines are written once for any kind of number, and dual numbers carry
//! derivatives through them, exactly.
//!
//! A [`System`] is such a simulator with a cost to be kept low. [`derivatives`] has the Jacobians of a step and the gradients of
//! whole roll-outs, forwards and backwards; [`Ilqr`] finds good actions with them, [`AnalyticPolicyGradient`] good policies, and
//! [`RecordedPush::identify`] the world's own parameters.

pub mod derivatives;
mod identify;
mod ilqr;
mod policy;
pub mod pusher;
mod simulated;
mod swing;

use nalgebra::{RealField, SVector};

pub use identify::{Identified, RecordedPush};
pub use ilqr::{Ilqr, IlqrConfig, IlqrControl, Solution};
pub use policy::{AnalyticPolicyGradient, AnalyticPolicyGradientConfig, PolicyEnv};
pub use pusher::{Pusher, PusherTask};
pub use simulated::Simulated;
pub use swing::{CartPoleSwing, PendulumSwing};

/// A world of `N` numbers that is moved by `M`, each in [-1, 1], and what it costs.
pub trait System<const N: usize, const M: usize>: Sync {
    /// The state after a control step.
    fn step<S: RealField + Copy>(&self, state: &SVector<S, N>, action: &SVector<S, M>) -> SVector<S, N>;

    /// What it costs to act so in this state.
    fn cost<S: RealField + Copy>(&self, state: &SVector<S, N>, action: &SVector<S, M>) -> S;

    /// What it costs to end in this state.
    fn final_cost<S: RealField + Copy>(&self, state: &SVector<S, N>) -> S;
}

/// The states that actions lead through, the first one included, and what all of it costs.
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
