//! The iterative linear-quadratic regulator with bounded actions (Tassa, Mansard & Todorov 2014): along the best roll-out so
//! far, dynamics are taken to be linear and costs to be quadratic; the best change of the actions then follows in one pass
//! backwards, and a line search sees how much of it is true.
//!
//! Second derivatives of the dynamics are left out, as in Gauss and Newton's method. Costs are taken to be sums of a function
//! of the state and one of the action.

use nalgebra::{SMatrix, SVector};
use num_dual::Dual2SVec64;
use serde::{Deserialize, Serialize};

use super::derivatives::{Linear, linearise};
use super::{System, roll_out};

/// Settings of [`Ilqr`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IlqrConfig {
    /// Iterations at most.
    pub iterations: usize,
    /// It ends when an iteration lowers the cost by less than this share of it.
    pub tolerance: f64,
    /// What is added to the curvature at the start, and how it grows and shrinks.
    pub regularisation: f64,
}

impl Default for IlqrConfig {
    fn default() -> Self {
        Self { iterations: 100, tolerance: 1e-6, regularisation: 1.0 }
    }
}

/// Regularisation beyond this means that there is nothing more to be found.
const MOST_REGULARISATION: f64 = 1e10;
/// The shares of a change that the line search tries.
const SHARES: [f64; 8] = [1.0, 0.6, 0.35, 0.2, 0.1, 0.05, 0.02, 0.01];

/// What it found.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution<const N: usize, const M: usize> {
    /// The actions, each number in [-1, 1].
    pub actions: Vec<SVector<f64, M>>,
    /// The states that they lead through, the start included.
    pub states: Vec<SVector<f64, N>>,
    /// How actions should answer to states that are not those.
    pub gains: Vec<SMatrix<f64, M, N>>,
    /// What it costs.
    pub cost: f64,
    /// Iterations that it took.
    pub iterations: usize,
    /// Steps simulated on the way, those that were differentiated among them (each counts once).
    pub steps: usize,
}

/// The optimiser.
#[derive(Clone, Debug, Default)]
pub struct Ilqr {
    config: IlqrConfig,
}

/// A change of the actions that a pass backwards proposes.
struct Change<const N: usize, const M: usize> {
    open: Vec<SVector<f64, M>>,
    gains: Vec<SMatrix<f64, M, N>>,
    /// By how much it should lower the cost: the linear and the quadratic part.
    promised: [f64; 2],
}

impl Ilqr {
    /// With these settings.
    pub fn new(config: IlqrConfig) -> Self {
        Self { config }
    }

    /// Improves `guess`, from `start`.
    pub fn solve<const N: usize, const M: usize>(
        &self,
        system: &impl System<N, M>,
        start: &SVector<f64, N>,
        guess: &[SVector<f64, M>],
    ) -> Solution<N, M> {
        let actions: Vec<SVector<f64, M>> = guess.iter().map(|action| action.map(|a| a.clamp(-1.0, 1.0))).collect();
        let (states, cost) = roll_out(system, start, &actions);
        let gains = vec![SMatrix::zeros(); actions.len()];
        let mut best = Solution { steps: actions.len(), actions, states, gains, cost, iterations: 0 };
        let mut regularisation = self.config.regularisation;
        while best.iterations < self.config.iterations {
            best.iterations += 1;
            let lines: Vec<Linear<N, M>> =
                best.actions.iter().zip(&best.states).map(|(action, state)| linearise(system, state, action)).collect();
            best.steps += lines.len();
            let before = best.cost;
            let improved = loop {
                if let Some(change) = backward(system, &best, &lines, regularisation)
                    && try_out(system, &mut best, &change)
                {
                    break true;
                }
                regularisation *= 4.0;
                if regularisation > MOST_REGULARISATION {
                    break false;
                }
            };
            regularisation = (regularisation / 8.0).max(1e-8);
            if !improved || before - best.cost < self.config.tolerance * best.cost.abs() {
                break;
            }
        }
        best
    }
}

/// Receding-horizon control with it: at every step the last solution, moved on, is improved a little.
pub struct IlqrControl<const M: usize> {
    ilqr: Ilqr,
    ahead: Vec<SVector<f64, M>>,
}

impl<const M: usize> IlqrControl<M> {
    /// A controller that begins with a guess as long as it is to look ahead.
    ///
    /// # Panics
    /// If the guess is empty.
    pub fn new(ilqr: Ilqr, guess: Vec<SVector<f64, M>>) -> Self {
        assert!(!guess.is_empty(), "at least one step to look ahead");
        Self { ilqr, ahead: guess }
    }

    /// The next action, and the solution that it is the first of.
    pub fn act<const N: usize>(
        &mut self,
        system: &impl System<N, M>,
        state: &SVector<f64, N>,
    ) -> (SVector<f64, M>, Solution<N, M>) {
        let solution = self.ilqr.solve(system, state, &self.ahead);
        self.ahead.clone_from(&solution.actions);
        let first = self.ahead.remove(0);
        self.ahead.push(self.ahead.last().copied().unwrap_or(first));
        (first, solution)
    }
}

/// The pass backwards. `None` if the curvature is not positive, so that no best change exists.
fn backward<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    about: &Solution<N, M>,
    lines: &[Linear<N, M>],
    regularisation: f64,
) -> Option<Change<N, M>> {
    let end = &about.states[lines.len()];
    let (_, mut slope, mut curvature) = num_dual::hessian(|state| system.final_cost(&state), end);
    let mut change =
        Change { open: vec![SVector::zeros(); lines.len()], gains: about.gains.clone(), promised: [0.0; 2] };
    for (t, Linear { by_state, by_action, .. }) in lines.iter().enumerate().rev() {
        let (state, action) = (&about.states[t], &about.actions[t]);
        let fixed = action.map(Dual2SVec64::from_re);
        let (_, of_state, by_states) = num_dual::hessian(|state| system.cost(&state, &fixed), state);
        let fixed = state.map(Dual2SVec64::from_re);
        let (_, of_action, by_actions) = num_dual::hessian(|action| system.cost(&fixed, &action), action);

        let q_state = of_state + by_state.tr_mul(&slope);
        let q_action = of_action + by_action.tr_mul(&slope);
        let q_states = by_states + by_state.tr_mul(&curvature) * by_state;
        let q_mixed = by_action.tr_mul(&curvature) * by_state;
        let q_actions = by_actions + by_action.tr_mul(&curvature) * by_action;
        let regular = q_actions + SMatrix::<f64, M, M>::identity() * regularisation;
        let bounds = [action.map(|a| -1.0 - a), action.map(|a| 1.0 - a)];
        let (open, free) = within_bounds(&regular, &q_action, bounds)?;
        // Actions that lie at their bound do not answer to the state.
        let gain = -solve_free(&regular, &q_mixed, &free)?;

        change.promised[0] += open.dot(&q_action);
        change.promised[1] += 0.5 * open.dot(&(q_actions * open));
        slope = q_state + gain.tr_mul(&(q_actions * open)) + gain.tr_mul(&q_action) + q_mixed.tr_mul(&open);
        curvature = q_states + gain.tr_mul(&(q_actions * gain)) + gain.tr_mul(&q_mixed) + q_mixed.tr_mul(&gain);
        curvature = (curvature + curvature.transpose()) * 0.5;
        (change.open[t], change.gains[t]) = (open, gain);
    }
    Some(change)
}

/// Tries larger and smaller shares of a change; takes over the first that lowers the cost by a fair part of what was promised.
fn try_out<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    best: &mut Solution<N, M>,
    change: &Change<N, M>,
) -> bool {
    let [linear, quadratic] = change.promised;
    for share in SHARES {
        let mut states = vec![best.states[0]];
        let mut actions = Vec::with_capacity(best.actions.len());
        let mut cost = 0.0;
        for (t, before) in best.actions.iter().enumerate() {
            let state = states[t];
            let action = before + change.open[t] * share + change.gains[t] * (state - best.states[t]);
            let action = action.map(|a| a.clamp(-1.0, 1.0));
            cost += system.cost(&state, &action);
            states.push(system.step(&state, &action));
            actions.push(action);
        }
        cost += system.final_cost(&states[actions.len()]);
        best.steps += actions.len();
        let promised = -(share * linear + share * share * quadratic);
        if cost.is_finite() && best.cost - cost > 1e-4 * promised.max(0.0) && cost < best.cost {
            (best.states, best.actions, best.cost) = (states, actions, cost);
            best.gains.clone_from(&change.gains);
            return true;
        }
    }
    false
}

/// The change x within bounds that minimises `x' H x / 2 + g' x`, and which of its numbers are free, by projected Newton
/// steps. `None` if H is not positive definite.
fn within_bounds<const M: usize>(
    h: &SMatrix<f64, M, M>,
    g: &SVector<f64, M>,
    [low, high]: [SVector<f64, M>; 2],
) -> Option<(SVector<f64, M>, [bool; M])> {
    let clamped = |x: SVector<f64, M>| SVector::<f64, M>::from_fn(|i, _| x[i].clamp(low[i], high[i]));
    let value = |x: &SVector<f64, M>| 0.5 * x.dot(&(h * x)) + g.dot(x);
    let mut x = clamped(SVector::zeros());
    let mut free = [true; M];
    for _ in 0..20 {
        let slope = g + h * x;
        free = std::array::from_fn(|i| !(x[i] <= low[i] && slope[i] > 0.0 || x[i] >= high[i] && slope[i] < 0.0));
        let step = -solve_free(h, &slope, &free)?;
        if step.norm() < 1e-10 {
            break;
        }
        let mut share = 1.0;
        let mut next = clamped(x + step);
        while value(&next) > value(&x) - 1e-12 && share > 1e-3 {
            share *= 0.5;
            next = clamped(x + step * share);
        }
        x = next;
    }
    Some((x, free))
}

/// `H^-1 b` among the free numbers; zero for the others. `None` if H is not positive definite there.
fn solve_free<const M: usize, const C: usize>(
    h: &SMatrix<f64, M, M>,
    b: &SMatrix<f64, M, C>,
    free: &[bool; M],
) -> Option<SMatrix<f64, M, C>> {
    let among = SMatrix::<f64, M, M>::from_fn(|i, j| match (free[i] && free[j], i == j) {
        (true, _) => h[(i, j)],
        (false, same) => f64::from(u8::from(same)),
    });
    let b = SMatrix::<f64, M, C>::from_fn(|i, j| if free[i] { b[(i, j)] } else { 0.0 });
    Some(among.cholesky()?.solve(&b))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Minimum of a bowl whose bottom lies outside: at the bound in one number, and best in the other given that.
    #[test]
    fn a_bounded_minimum_is_found() {
        let h = SMatrix::<f64, 2, 2>::new(2.0, 1.0, 1.0, 2.0);
        let g = SVector::<f64, 2>::new(-8.0, 0.0);
        let bounds = [SVector::repeat(-1.0), SVector::repeat(1.0)];
        let (x, free) = within_bounds(&h, &g, bounds).expect("positive definite");
        assert!((x[0] - 1.0).abs() < 1e-9 && (x[1] + 0.5).abs() < 1e-9, "{x}");
        assert_eq!(free, [false, true]);
    }
}
