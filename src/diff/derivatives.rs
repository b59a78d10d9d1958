//! Derivatives of steps and of rollouts.
//!
//! *Forward mode* pushes one direction through the rollout: its cost grows with the number of actions. *Reverse mode* (the
//! adjoint method, or backpropagation through time) goes back through the rollout once, whatever their number; it keeps all
//! states (`N` numbers a step) and the Jacobians of one step at a time, which forward mode computes.
//!
//! ```
//! use handful::diff::derivatives::{gradient, gradient_forward};
//! use handful::diff::CartPoleSwing;
//! use handful::nalgebra::{Vector1, Vector4};
//!
//! let start = Vector4::new(0.0, 0.0, 3.0, 0.0);
//! let actions = vec![Vector1::new(0.3); 20];
//! let (_cost, reverse, _by_start) = gradient(&CartPoleSwing, &start, &actions);
//! let forward = gradient_forward(&CartPoleSwing, &start, &actions);
//! assert!(reverse.iter().zip(&forward).all(|(a, b)| (a - b).norm() < 1e-10));
//! ```

use nalgebra::{SMatrix, SVector};
use num_dual::{Dual64, DualSVec64};

use super::{System, roll_out};

/// A step and its Jacobians: the linearised dynamics.
#[derive(Clone, Debug, PartialEq)]
pub struct Linear<const N: usize, const M: usize> {
    /// The state after the step.
    pub next: SVector<f64, N>,
    /// Its Jacobian with respect to the state before.
    pub by_state: SMatrix<f64, N, N>,
    /// Its Jacobian with respect to the action.
    pub by_action: SMatrix<f64, N, M>,
}

/// The most derivatives that each number carries through a step. With more, as the arm has them, copying them would dominate, and one
/// step for each column is four times as fast (`benches/diff.rs`).
const FEW: usize = 12;

/// The exact Jacobians of a step, by forward mode.
#[doc(alias = "linearize")]
#[doc(alias = "Jacobian")]
pub fn linearise<Sys: System<N, M>, const N: usize, const M: usize>(
    system: &Sys,
    state: &SVector<f64, N>,
    action: &SVector<f64, M>,
) -> Linear<N, M> {
    if N + M > FEW {
        return linearise_by_columns(system, state, action);
    }
    let fixed = action.map(DualSVec64::from_re);
    let (next, by_state) = num_dual::jacobian(|state| system.step(&state, &fixed), state);
    let fixed = state.map(DualSVec64::from_re);
    let (_, by_action) = num_dual::jacobian(|action| system.step(&fixed, &action), action);
    Linear { next, by_state, by_action }
}

/// The same, one direction at a time.
fn linearise_by_columns<Sys: System<N, M>, const N: usize, const M: usize>(
    system: &Sys,
    state: &SVector<f64, N>,
    action: &SVector<f64, M>,
) -> Linear<N, M> {
    let (mut state, mut action) = (state.map(Dual64::from_re), action.map(Dual64::from_re));
    let (mut by_state, mut by_action) = (SMatrix::<f64, N, N>::zeros(), SMatrix::<f64, N, M>::zeros());
    for i in 0..Sys::READS {
        state[i].eps = 1.0;
        by_state.set_column(i, &system.step(&state, &action).map(|number| number.eps));
        state[i].eps = 0.0;
    }
    let mut next = SVector::zeros();
    for i in 0..M {
        action[i].eps = 1.0;
        let step = system.step(&state, &action);
        by_action.set_column(i, &step.map(|number| number.eps));
        next = step.map(|number| number.re);
        action[i].eps = 0.0;
    }
    Linear { next, by_state, by_action }
}

/// The cost of a rollout and its gradients with respect to every action and to the start, by reverse mode. With the cost
/// c of a step f, the adjoint lambda obeys (from the final cost's gradient backwards)
///
/// dJ/da_t = dc/da_t + (df/da_t)' lambda_{t+1},   lambda_t = dc/ds_t + (df/ds_t)' lambda_{t+1}.
#[doc(alias = "adjoint")]
#[doc(alias = "reverse mode")]
#[doc(alias = "backpropagation through time")]
#[doc(alias = "BPTT")]
pub fn gradient<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    start: &SVector<f64, N>,
    actions: &[SVector<f64, M>],
) -> (f64, Vec<SVector<f64, M>>, SVector<f64, N>) {
    let (states, cost) = roll_out(system, start, actions);
    // The adjoint: the gradient of the remaining cost with respect to the state.
    let (_, mut adjoint) = num_dual::gradient(|state| system.final_cost(&state), &states[actions.len()]);
    let mut by_actions = vec![SVector::zeros(); actions.len()];
    for (t, action) in actions.iter().enumerate().rev() {
        let state = &states[t];
        let Linear { by_state, by_action, .. } = linearise(system, state, action);
        let fixed = state.map(DualSVec64::from_re);
        let (_, of_action) = num_dual::gradient(|action| system.cost(&fixed, &action), action);
        let fixed = action.map(DualSVec64::from_re);
        let (_, of_state) = num_dual::gradient(|state| system.cost(&state, &fixed), state);
        by_actions[t] = of_action + by_action.tr_mul(&adjoint);
        adjoint = of_state + by_state.tr_mul(&adjoint);
    }
    (cost, by_actions, adjoint)
}

/// The same gradient with respect to the actions by forward mode: a whole rollout for each number of each action.
#[doc(alias = "forward mode")]
#[doc(alias = "dual numbers")]
pub fn gradient_forward<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    start: &SVector<f64, N>,
    actions: &[SVector<f64, M>],
) -> Vec<SVector<f64, M>> {
    let start = start.map(Dual64::from_re);
    let mut actions: Vec<SVector<Dual64, M>> = actions.iter().map(|action| action.map(Dual64::from_re)).collect();
    let mut slopes = vec![SVector::zeros(); actions.len()];
    for t in 0..actions.len() {
        for i in 0..M {
            actions[t][i].eps = 1.0;
            slopes[t][i] = roll_out(system, &start, &actions).1.eps;
            actions[t][i].eps = 0.0;
        }
    }
    slopes
}

/// The same by central differences, `step` to either side: a check on the others. Near contact, where the cost bends within
/// `step`, it is wrong.
#[doc(alias = "finite differences")]
pub fn gradient_by_differences<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    start: &SVector<f64, N>,
    actions: &[SVector<f64, M>],
    step: f64,
) -> Vec<SVector<f64, M>> {
    let mut actions = actions.to_vec();
    let mut slopes = vec![SVector::zeros(); actions.len()];
    for t in 0..actions.len() {
        for i in 0..M {
            let here = actions[t][i];
            let mut at = |number: f64| {
                actions[t][i] = number;
                roll_out(system, start, &actions).1
            };
            let (above, below) = (at(here + step), at(here - step));
            actions[t][i] = here;
            slopes[t][i] = (above - below) / (2.0 * step);
        }
    }
    slopes
}
