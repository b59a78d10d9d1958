//! Derivatives of steps and of roll-outs.
//!
//! *Forward mode* pushes one direction through everything: its cost grows with the number of actions. *Reverse mode*, the
//! adjoint recursion, goes back through a roll-out once, whatever their number; it keeps all states (`N` numbers a step) and
//! the Jacobians of one step at a time, which forward mode gives it.

use nalgebra::{SMatrix, SVector};
use num_dual::{Dual64, DualSVec64};

use super::{System, roll_out};

/// A step and how it changes with state and action.
#[derive(Clone, Debug, PartialEq)]
pub struct Linear<const N: usize, const M: usize> {
    /// The state after the step.
    pub next: SVector<f64, N>,
    /// Its Jacobian with respect to the state before.
    pub by_state: SMatrix<f64, N, N>,
    /// Its Jacobian with respect to the action.
    pub by_action: SMatrix<f64, N, M>,
}

/// The Jacobians of a step, exact.
pub fn linearise<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    state: &SVector<f64, N>,
    action: &SVector<f64, M>,
) -> Linear<N, M> {
    let fixed = action.map(DualSVec64::from_re);
    let (next, by_state) = num_dual::jacobian(|state| system.step(&state, &fixed), state);
    let fixed = state.map(DualSVec64::from_re);
    let (_, by_action) = num_dual::jacobian(|action| system.step(&fixed, &action), action);
    Linear { next, by_state, by_action }
}

/// What a roll-out costs, and how that changes with every action and with the start: reverse mode.
pub fn gradient<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    start: &SVector<f64, N>,
    actions: &[SVector<f64, M>],
) -> (f64, Vec<SVector<f64, M>>, SVector<f64, N>) {
    let (states, cost) = roll_out(system, start, actions);
    // The adjoint: how the cost of all that is to come changes with the state.
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

/// The same gradient with respect to the actions by forward mode: a whole roll-out for each number of each action.
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

/// The same by central differences: what everyone can do, and nobody should trust near contact.
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
