//! The model for planning: plain weights, and panels of candidates that pass through all networks of all time steps while they
//! stay in the processor's cache.

use rayon::prelude::*;

use super::policy::log_std;
use super::{ImplicitModel, PolicyPrior, SMALLEST};
use crate::nn::SymlogBins;
use crate::nn::frozen::{Feature, FrozenMlp, PANEL, Panels};
use crate::nn::kernels::{exp, tanh};
use crate::nn::simnorm::sim_norm_panel;

/// A snapshot of model and policy.
#[derive(Clone, Debug)]
pub(crate) struct FrozenModel {
    group: usize,
    residual: bool,
    bins: SymlogBins,
    actions: usize,
    dynamics: FrozenMlp,
    reward: FrozenMlp,
    critics: Vec<FrozenMlp>,
    termination: Option<FrozenMlp>,
    policy: FrozenMlp,
}

impl FrozenModel {
    /// The present weights.
    pub fn new(model: &ImplicitModel, policy: &PolicyPrior) -> Self {
        Self {
            group: model.config.group,
            residual: model.config.residual,
            bins: model.bins.clone(),
            actions: policy.actions,
            dynamics: model.dynamics.frozen(0),
            reward: model.reward.frozen(0),
            critics: (0..model.config.critics).map(|i| model.critics.frozen(i)).collect(),
            termination: model.termination.as_ref().map(|head| head.frozen(0)),
            policy: policy.head.frozen(0),
        }
    }

    /// The return of each action sequence (`[count, horizon, actions]`) from the latent state `z`: discounted rewards, and the
    /// value of the last state,
    ///
    /// ```text
    /// G = sum_t discount^t R(z_t, a_t) + discount^H (Q_i + Q_j)(z_H, a) / 2,   a ~ p(z_H)
    /// ```
    ///
    /// with two of the critics, `pair`, and standard normal `noise` for the last action, `[count, actions]`. After a predicted
    /// end of the task nothing is added.
    pub fn returns(
        &self,
        z: &[f32],
        sequences: &[f32],
        horizon: usize,
        noise: &[f32],
        pair: [usize; 2],
        discount: f32,
    ) -> Vec<f32> {
        let (width, actions) = (horizon * self.actions, self.actions);
        let panels = sequences.par_chunks(PANEL * width).zip(noise.par_chunks(PANEL * actions));
        let returns = panels.flat_map_iter(|(sequences, noise)| {
            let mut rollout = Rollout::new(self, z);
            let mut sum = Sum::default();
            for t in 0..horizon {
                rollout.set_actions(|row, i| sequences.get(row * width + t * actions + i).copied());
                sum.add(rollout.rewards());
                rollout.advance();
                sum.advance(discount, rollout.ends());
            }
            rollout.draw_actions(|row, i| noise.get(row * actions + i).copied());
            sum.add(rollout.values(pair));
            sum.total.into_iter().take(sequences.len() / width)
        });
        returns.collect()
    }

    /// Action sequences of the policy from the latent state `z`, for standard normal `noise`; both `[count, horizon, actions]`.
    pub fn policy_sequences(&self, z: &[f32], horizon: usize, noise: &[f32]) -> Vec<f32> {
        let (width, actions) = (horizon * self.actions, self.actions);
        let panels = noise.par_chunks(PANEL * width).flat_map_iter(|noise| {
            let mut sequences = vec![0.0; noise.len()];
            let mut rollout = Rollout::new(self, z);
            for t in 0..horizon {
                rollout.draw_actions(|row, i| noise.get(row * width + t * actions + i).copied());
                for (row, sequence) in sequences.chunks_exact_mut(width).enumerate() {
                    (0..actions).for_each(|i| sequence[t * actions + i] = rollout.action(i).0[row]);
                }
                rollout.advance();
            }
            sequences
        });
        panels.collect()
    }
}

/// A panel of rollouts side by side.
struct Rollout<'a> {
    model: &'a FrozenModel,
    panels: Panels,
    /// Latent states and actions, a feature after the other: the networks' input.
    state_action: Vec<Feature>,
    latent: usize,
}

impl<'a> Rollout<'a> {
    fn new(model: &'a FrozenModel, z: &[f32]) -> Self {
        let state = z.iter().map(|z| Feature([*z; PANEL]));
        let actions = std::iter::repeat_n(Feature([0.0; PANEL]), model.actions);
        Self { model, panels: Panels::default(), state_action: state.chain(actions).collect(), latent: z.len() }
    }

    fn action(&self, i: usize) -> &Feature {
        &self.state_action[self.latent + i]
    }

    /// Sets the actions; rows that have none get zeros.
    fn set_actions(&mut self, of: impl Fn(usize, usize) -> Option<f32>) {
        for (i, action) in self.state_action[self.latent..].iter_mut().enumerate() {
            action.0 = std::array::from_fn(|row| of(row, i).unwrap_or(0.0));
        }
    }

    /// Sets the actions to those of the policy, `tanh(m + std noise)`.
    fn draw_actions(&mut self, noise: impl Fn(usize, usize) -> Option<f32>) {
        let actions = self.model.actions;
        self.panels.input(self.latent).copy_from_slice(&self.state_action[..self.latent]);
        let head = self.model.policy.forward(&mut self.panels);
        for i in 0..actions {
            let (mean, raw) = (&head[i].0, &head[actions + i].0);
            let draw = |row: usize| tanh(mean[row] + exp(log_std(raw[row])) * noise(row, i).unwrap_or(0.0));
            self.state_action[self.latent + i].0 = std::array::from_fn(draw);
        }
    }

    fn of_state_action(&mut self, network: &FrozenMlp) -> &[Feature] {
        self.panels.input(self.state_action.len()).copy_from_slice(&self.state_action);
        network.forward(&mut self.panels)
    }

    fn rewards(&mut self) -> [f32; PANEL] {
        let FrozenModel { bins, reward, .. } = self.model;
        bins.decode_panel(self.of_state_action(reward))
    }

    /// The mean of two critics.
    fn values(&mut self, pair: [usize; 2]) -> [f32; PANEL] {
        let FrozenModel { bins, critics, .. } = self.model;
        let [one, other] = pair.map(|i| bins.decode_panel(self.of_state_action(&critics[i])));
        std::array::from_fn(|row| 0.5 * (one[row] + other[row]))
    }

    /// One step of the latent dynamics.
    fn advance(&mut self) {
        let FrozenModel { dynamics, residual, group, .. } = self.model;
        self.panels.input(self.state_action.len()).copy_from_slice(&self.state_action);
        let ahead = dynamics.forward(&mut self.panels);
        let state = &mut self.state_action[..self.latent];
        for (z, ahead) in state.iter_mut().zip(ahead) {
            let before = |row: usize| if *residual { z.0[row].max(SMALLEST).ln() } else { 0.0 };
            z.0 = std::array::from_fn(|row| before(row) + ahead.0[row]);
        }
        sim_norm_panel(state, *group);
    }

    /// Where the task has ended, more likely than not.
    fn ends(&mut self) -> [bool; PANEL] {
        let Some(head) = &self.model.termination else { return [false; PANEL] };
        self.panels.input(self.latent).copy_from_slice(&self.state_action[..self.latent]);
        head.forward(&mut self.panels)[0].0.map(|logit| logit > 0.0)
    }
}

/// Discounted sums of a panel of rollouts, to which nothing is added after an end.
struct Sum {
    total: [f32; PANEL],
    discount: f32,
    ended: [bool; PANEL],
}

impl Default for Sum {
    fn default() -> Self {
        Self { total: [0.0; PANEL], discount: 1.0, ended: [false; PANEL] }
    }
}

impl Sum {
    fn add(&mut self, values: [f32; PANEL]) {
        let open = self.total.iter_mut().zip(values).zip(self.ended).filter(|(_, ended)| !ended);
        open.for_each(|((total, value), _)| *total += self.discount * value);
    }

    fn advance(&mut self, discount: f32, ends: [bool; PANEL]) {
        self.discount *= discount;
        (0..PANEL).for_each(|row| self.ended[row] |= ends[row]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_are_the_references() {
        for (end, expected) in [(None, 11.775_75), (Some(1), 0.675)] {
            let mut sum = Sum::default();
            for (t, reward) in [0.2, 0.5, 0.9].into_iter().enumerate() {
                sum.add([reward; PANEL]);
                sum.advance(0.95, [end == Some(t); PANEL]);
            }
            sum.add([12.0; PANEL]);
            assert!((sum.total[5] - expected).abs() < 1e-5, "{}, expected {expected}", sum.total[5]);
        }
    }
}
