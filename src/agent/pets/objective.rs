//! The objective that PETS plans with: returns in the imagination of an ensemble.

use super::{DynReward, PetsConfig};
use crate::agent::ImaginedTrajectory;
use crate::env::KnownReward;
use crate::model::uncertainty::Risk;
use crate::model::{Differentiable, Dynamics, Imagination, ImaginedReturns, Reward, Value};
use crate::plan::{ActionSequences, Objective};
use crate::rng::{self, Rng};

/// The score of action sequences from `obs` (Chua et al. 2018, Algorithm 1: the mean over particles of summed rewards;
/// here any [`Risk`] measure of them, plus a weight times the disagreement along the way).
pub(super) struct EnsembleObjective<'a> {
    pub(super) imagination: Imagination<'a>,
    pub(super) obs: &'a [f32],
    pub(super) risk: Risk,
    /// Return for each unit of disagreement: the bonus less the penalty.
    pub(super) disagreement: f32,
    pub(super) rng: Rng,
    /// Made when the first gradient is asked for.
    pub(super) differentiable: Option<Differentiable>,
}

impl Objective for EnsembleObjective<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        let ImaginedReturns { particles, returns, disagreement } =
            self.imagination.imagined_returns(self.obs, &sequences.values, sequences.horizon, &mut self.rng);
        let scores = returns.chunks_exact(particles).zip(disagreement);
        scores.map(|(returns, disagreement)| self.risk.of(returns) + self.disagreement * disagreement).collect()
    }

    /// An approximation of the gradient of [`Objective::returns`]: members follow their means, to the horizon even where the task
    /// terminates. Of the risk measures, only `MeanStd` is differentiated (then without the disagreement term); otherwise, the weight
    /// of the disagreement multiplies the standard deviation of the members' returns.
    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        let Imagination { dynamics, reward, .. } = self.imagination;
        let model = self.differentiable.get_or_insert_with(|| Differentiable::new(dynamics));
        let disagreement_penalty = if let Risk::MeanStd(weight) = self.risk { weight } else { -self.disagreement };
        model.gradients(reward, self.obs, &sequences.values, sequences.horizon, disagreement_penalty)
    }
}

/// The learned model with what planning in it needs.
pub(super) struct PlanningModel<'a> {
    pub(super) config: &'a PetsConfig,
    dynamics: &'a Dynamics,
    /// None if the ensemble has learned it.
    pub(super) reward: Option<&'a DynReward>,
    /// The terminal value: of a plan's last state.
    terminal: Option<Box<Value<'a>>>,
}

impl<'a> PlanningModel<'a> {
    pub(super) fn new(config: &'a PetsConfig, dynamics: &'a Dynamics, reward: Option<&'a DynReward>) -> Self {
        let reward = reward.filter(|_| !config.ensemble.learn_reward);
        let of_rest = reward.map(|known| known as &(dyn KnownReward + Sync));
        let of_rest = of_rest.or_else(|| dynamics.learned_reward().map(|learned| learned as _));
        let actions = dynamics.action_size();
        let terminal = of_rest.filter(|_| config.terminal_weight > 0.0).map(|reward| -> Box<Value<'a>> {
            Box::new(move |states: &[f32], values: &mut [f32]| {
                reward.rewards(states, &vec![0.0; values.len() * actions], states, values);
                values.iter_mut().for_each(|value| *value *= config.terminal_weight);
            })
        });
        Self { config, dynamics, reward, terminal }
    }

    pub(super) fn imagination(&self) -> Imagination<'_> {
        Imagination {
            dynamics: self.dynamics,
            reward: self.reward.map_or(Reward::Learned, |reward| Reward::Known(reward)),
            propagation: self.config.propagation,
            particles: self.config.particles,
            value: self.terminal.as_deref(),
        }
    }

    /// The trajectories that some action sequences lead to from `obs`: the mean over particles for each sequence, and then
    /// each particle's of the first sequence.
    pub(super) fn imagine_trajectories(&self, obs: &[f32], sequences: &ActionSequences) -> Vec<ImaginedTrajectory> {
        let imagination = self.imagination();
        let (states, imagined) =
            imagination.trajectories(obs, &sequences.values, sequences.horizon, &mut rng::stream(0, "pets imagined"));
        let (width, count, particles) = (obs.len(), sequences.count(), imagined.particles);
        let at = |t: usize, p: usize, c: usize| &states[t][(p * count + c) * width..][..width];
        let mean = |t: usize, c: usize| -> Vec<f32> {
            let sum = |i: usize| (0..particles).map(|p| at(t, p, c)[i]).sum::<f32>();
            (0..width).map(|i| sum(i) / particles as f32).collect()
        };
        let returns = |c: usize| &imagined.returns[c * particles..][..particles];
        let expected = (0..count).map(|c| ImaginedTrajectory {
            observations: (0..=sequences.horizon).map(|t| mean(t, c)).collect(),
            value: Risk::Neutral.of(returns(c)),
            disagreement: imagined.disagreement[c],
        });
        let possible = (0..particles).map(|p| ImaginedTrajectory {
            observations: (0..=sequences.horizon).map(|t| at(t, p, 0).to_vec()).collect(),
            value: returns(0)[p],
            disagreement: imagined.disagreement[0],
        });
        expected.chain(possible).collect()
    }
}
