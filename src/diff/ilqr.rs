//! The iterative linear-quadratic regulator.

use nalgebra::{SMatrix, SVector};
use num_dual::Dual2SVec64;
use serde::{Deserialize, Serialize};

use super::derivatives::{Linear, linearise};
use super::{System, roll_out};
use crate::settings::{must_hold, ranges};

/// Settings of [`Ilqr`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IlqrConfig {
    /// Iterations at most.
    pub iterations: usize,
    /// Converged when an iteration lowers the cost by less than this fraction of it.
    pub tolerance: f64,
    /// Initial regularisation of Q_uu; it grows by 4 when an iteration fails and shrinks by 8 after each.
    pub regularisation: f64,
}

impl Default for IlqrConfig {
    fn default() -> Self {
        Self { iterations: 100, tolerance: 1e-6, regularisation: 1.0 }
    }
}

ranges!(IlqrConfig { iterations: 0..=1_000_000, tolerance: 0.0..=1.0, regularisation: 1e-8..=1e9 });

/// Beyond this regularisation no further improvement is expected.
const MAX_REGULARISATION: f64 = 1e10;
/// The step sizes that the line search tries.
const STEP_SIZES: [f64; 8] = [1.0, 0.6, 0.35, 0.2, 0.1, 0.05, 0.02, 0.01];

/// The result of [`Ilqr::solve`].
#[derive(Clone, Debug, PartialEq)]
pub struct Solution<const N: usize, const M: usize> {
    /// The actions, each component in [-1, 1].
    pub actions: Vec<SVector<f64, M>>,
    /// The trajectory of states, the start included.
    pub states: Vec<SVector<f64, N>>,
    /// Feedback gains K, one for each action: off the trajectory, add K (state - planned state).
    pub gains: Vec<SMatrix<f64, M, N>>,
    /// Total cost.
    pub cost: f64,
    /// Iterations taken.
    pub iterations: usize,
    /// Steps simulated; a step that was differentiated counts once.
    pub steps: usize,
}

/// The iterative linear-quadratic regulator (iLQR; Li & Todorov 2004) with bounded actions (box-DDP; Tassa, Mansard & Todorov
/// 2014).
///
/// Each iteration linearises the dynamics and expands the cost to second order along the best trajectory so far. A backward
/// pass then gives the best change of the actions, in closed form but for a small quadratic program at the bounds, and a
/// forward pass with line search applies as much of it as lowers the cost. The backward pass is that of Tassa, Erez & Todorov
/// (2012); regularisation is their first kind, on Q_uu. The [module](crate::diff) has an example.
///
/// Second derivatives of the dynamics are left out (Gauss-Newton; with them it would be DDP), and so are mixed second
/// derivatives of the cost, which is taken to be a function of the state plus one of the action.
///
/// - W. Li, E. Todorov: "Iterative linear quadratic regulator design for nonlinear biological movement systems", ICINCO 2004.
/// - Y. Tassa, T. Erez, E. Todorov: "Synthesis and stabilization of complex behaviors through online trajectory
///   optimization", IROS 2012.
/// - Y. Tassa, N. Mansard, E. Todorov: "Control-limited differential dynamic programming", ICRA 2014.
#[doc(alias = "iLQR")]
#[doc(alias = "iLQG")]
#[doc(alias = "DDP")]
#[doc(alias = "differential dynamic programming")]
#[doc(alias = "trajectory optimisation")]
#[derive(Clone, Debug, Default)]
pub struct Ilqr {
    config: IlqrConfig,
}

/// A change of the actions, as the backward pass proposes it.
struct Change<const N: usize, const M: usize> {
    /// Open-loop terms k.
    open_loop: Vec<SVector<f64, M>>,
    /// Feedback gains K.
    gains: Vec<SMatrix<f64, M, N>>,
    /// The expected change of the cost: the terms linear and quadratic in the step size.
    expected: [f64; 2],
}

impl Ilqr {
    /// An optimiser with these settings.
    ///
    /// # Panics
    /// If a setting lies outside its range.
    pub fn new(config: IlqrConfig) -> Self {
        must_hold(&config, "ilqr");
        Self { config }
    }

    /// Optimises the actions of a rollout from `start`, beginning with `guess`, which is as long as the solution.
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
                    && forward(system, &mut best, &change)
                {
                    break true;
                }
                regularisation *= 4.0;
                if regularisation > MAX_REGULARISATION {
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

/// Receding-horizon control (MPC) with [`Ilqr`], warm-started: at every step the last solution is shifted and improved.
///
/// ```
/// use handful::diff::{Ilqr, IlqrConfig, IlqrControl, PendulumSwing, System};
/// use handful::nalgebra::{Vector1, Vector2};
///
/// let ilqr = Ilqr::new(IlqrConfig { iterations: 5, ..IlqrConfig::default() });
/// let mut control = IlqrControl::new(ilqr, vec![Vector1::new(0.0); 30]);
/// let mut state = Vector2::new(0.2, 0.0);
/// for _ in 0..60 {
///     let (action, _) = control.act(&PendulumSwing, &state);
///     state = PendulumSwing.step(&state, &action);
/// }
/// assert!(state[0].cos() > 0.99, "balanced upright: {state}");
/// ```
#[doc(alias = "MPC")]
#[derive(Clone, Debug)]
pub struct IlqrControl<const M: usize> {
    ilqr: Ilqr,
    ahead: Vec<SVector<f64, M>>,
}

impl<const M: usize> IlqrControl<M> {
    /// A controller whose planning horizon is the length of `guess`, its first plan.
    ///
    /// # Panics
    /// If the guess is empty.
    pub fn new(ilqr: Ilqr, guess: Vec<SVector<f64, M>>) -> Self {
        assert!(!guess.is_empty(), "a horizon of at least one step");
        Self { ilqr, ahead: guess }
    }

    /// The next action, and the solution whose first action it is.
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

/// The backward pass (Tassa et al. 2012, Eqs. 5 and 11): from the end, with the value function V' of the next step,
///
/// Qx = cx + fx' Vx',  Qu = cu + fu' Vx',  Qxx = cxx + fx' Vxx' fx,  Qux = fu' Vxx' fx,  Quu = cuu + fu' Vxx' fu,
/// k = argmin of k' Quu k / 2 + Qu' k within the bounds,  K = -Quu^-1 Qux for free actions,
/// Vx = Qx + K' Quu k + K' Qu + Qux' k,  Vxx = Qxx + K' Quu K + K' Qux + Qux' K.
///
/// None if the regularised Quu is not positive definite among the actions that are not held at a bound.
fn backward<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    about: &Solution<N, M>,
    lines: &[Linear<N, M>],
    regularisation: f64,
) -> Option<Change<N, M>> {
    let end = &about.states[lines.len()];
    let (_, mut v_x, mut v_xx) = num_dual::hessian(|state| system.final_cost(&state), end);
    let mut change =
        Change { open_loop: vec![SVector::zeros(); lines.len()], gains: about.gains.clone(), expected: [0.0; 2] };
    for (t, Linear { by_state: f_x, by_action: f_u, .. }) in lines.iter().enumerate().rev() {
        let (state, action) = (&about.states[t], &about.actions[t]);
        let fixed = action.map(Dual2SVec64::from_re);
        let (_, c_x, c_xx) = num_dual::hessian(|state| system.cost(&state, &fixed), state);
        let fixed = state.map(Dual2SVec64::from_re);
        let (_, c_u, c_uu) = num_dual::hessian(|action| system.cost(&fixed, &action), action);

        let q_x = c_x + f_x.tr_mul(&v_x);
        let q_u = c_u + f_u.tr_mul(&v_x);
        let q_xx = c_xx + f_x.tr_mul(&v_xx) * f_x;
        let q_ux = f_u.tr_mul(&v_xx) * f_x;
        let q_uu = c_uu + f_u.tr_mul(&v_xx) * f_u;
        let regularised = q_uu + SMatrix::<f64, M, M>::identity() * regularisation;
        let bounds = [action.map(|a| -1.0 - a), action.map(|a| 1.0 - a)];
        let (open_loop, free) = box_qp(&regularised, &q_u, bounds)?;
        // Actions at a bound have no feedback.
        let gain = -solve_free(&regularised, &q_ux, &free)?;

        change.expected[0] += open_loop.dot(&q_u);
        change.expected[1] += 0.5 * open_loop.dot(&(q_uu * open_loop));
        v_x = q_x + gain.tr_mul(&(q_uu * open_loop)) + gain.tr_mul(&q_u) + q_ux.tr_mul(&open_loop);
        v_xx = q_xx + gain.tr_mul(&(q_uu * gain)) + gain.tr_mul(&q_ux) + q_ux.tr_mul(&gain);
        v_xx = (v_xx + v_xx.transpose()) * 0.5;
        (change.open_loop[t], change.gains[t]) = (open_loop, gain);
    }
    Some(change)
}

/// The forward pass with line search: rolls out u + alpha k + K (x' - x) for smaller and smaller alpha, and accepts the first
/// that lowers the cost by a fraction of what was expected.
fn forward<const N: usize, const M: usize>(
    system: &impl System<N, M>,
    best: &mut Solution<N, M>,
    change: &Change<N, M>,
) -> bool {
    let [linear, quadratic] = change.expected;
    for alpha in STEP_SIZES {
        let mut states = vec![best.states[0]];
        let mut actions = Vec::with_capacity(best.actions.len());
        let mut cost = 0.0;
        for (t, before) in best.actions.iter().enumerate() {
            let state = states[t];
            let action = before + change.open_loop[t] * alpha + change.gains[t] * (state - best.states[t]);
            let action = action.map(|a| a.clamp(-1.0, 1.0));
            cost += system.cost(&state, &action);
            states.push(system.step(&state, &action));
            actions.push(action);
        }
        cost += system.final_cost(&states[actions.len()]);
        best.steps += actions.len();
        let expected = -(alpha * linear + alpha * alpha * quadratic);
        if cost.is_finite() && best.cost - cost > 1e-4 * expected.max(0.0) && cost < best.cost {
            (best.states, best.actions, best.cost) = (states, actions, cost);
            best.gains.clone_from(&change.gains);
            return true;
        }
    }
    false
}

/// The box-constrained quadratic program of box-DDP (Tassa et al. 2014): the x within bounds that minimises x' H x / 2 + g' x,
/// and which of its numbers are free (not held at a bound), by projected Newton steps. None if H is not positive definite among the
/// free ones.
fn box_qp<const M: usize>(
    h: &SMatrix<f64, M, M>,
    g: &SVector<f64, M>,
    [low, high]: [SVector<f64, M>; 2],
) -> Option<(SVector<f64, M>, [bool; M])> {
    let clamped = |x: SVector<f64, M>| SVector::<f64, M>::from_fn(|i, _| x[i].clamp(low[i], high[i]));
    let value = |x: &SVector<f64, M>| 0.5 * x.dot(&(h * x)) + g.dot(x);
    let mut x = clamped(SVector::zeros());
    let mut free = [true; M];
    for _ in 0..20 {
        let gradient = g + h * x;
        free = std::array::from_fn(|i| !(x[i] <= low[i] && gradient[i] > 0.0 || x[i] >= high[i] && gradient[i] < 0.0));
        let step = -solve_free(h, &gradient, &free)?;
        if step.norm() < 1e-10 {
            break;
        }
        let mut alpha = 1.0;
        let mut next = clamped(x + step);
        while value(&next) > value(&x) - 1e-12 && alpha > 1e-3 {
            alpha *= 0.5;
            next = clamped(x + step * alpha);
        }
        x = next;
    }
    Some((x, free))
}

/// H^-1 b among the free numbers; zero for the others. None if H is not positive definite there.
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

    /// A quadratic whose minimum lies outside the bounds: at the bound in one number, and optimal in the other given that.
    #[test]
    fn a_bounded_minimum_is_found() {
        let h = SMatrix::<f64, 2, 2>::new(2.0, 1.0, 1.0, 2.0);
        let g = SVector::<f64, 2>::new(-8.0, 0.0);
        let bounds = [SVector::repeat(-1.0), SVector::repeat(1.0)];
        let (x, free) = box_qp(&h, &g, bounds).expect("positive definite");
        assert!((x[0] - 1.0).abs() < 1e-9 && (x[1] + 0.5).abs() < 1e-9, "{x}");
        assert_eq!(free, [false, true]);
    }
}
