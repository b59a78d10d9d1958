//! Actor and critic of DreamerV3, which learn from rollouts imagined in the world model: the critic by two-hot symexp
//! regression on lambda-returns, the actor by REINFORCE with an entropy bonus.
//!
//! Equation numbers are those of Hafner et al. 2023, arXiv v1. There the actor of continuous actions learned by backpropagation
//! through the world model; REINFORCE for all actions is that of arXiv v2 and of the published code since then.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::config::ActorCriticConfig;
use super::returns::{lambda_returns, replay_lambda_returns};
use crate::agent::Losses;
use crate::model::{Latent, WorldModel};
use crate::nn::{
    BoundedNormal, Grad, Mlp, TapeOps, Tensor3, copy_parameters, ops, parameters_of_fields, polyak, tensor, values,
};
use crate::replay::SequenceBatch;
use crate::rng::{self, Rng};
use crate::settings::must_hold;

/// The actor (a policy over the features of latent states) and the critic (a two-hot distribution of returns).
#[derive(Clone, Debug)]
pub struct ActorCritic {
    pub(super) config: ActorCriticConfig,
    pub(super) actions: usize,
    /// The coefficient of the entropy bonus, eta.
    pub(super) entropy: f32,
    pub(super) policy: Mlp,
    pub(super) critic: Mlp,
}

parameters_of_fields!(ActorCritic: policy, critic);

/// The target network: an exponential moving average of the critic, towards whose predictions the critic is regularised.
#[doc(alias = "target network")]
#[doc(alias = "slow critic")]
pub type TargetCritic = Mlp;

/// Rollouts imagined in the world model, from many latent states at once, with H the horizon. Every list holds an entry for
/// each time step, the start first.
#[doc(alias = "imagination")]
#[doc(alias = "dream")]
#[derive(Clone, Debug)]
pub struct ImaginedRollout {
    /// The features of the latent states, `[1, rows, features]` each, H + 1 of them.
    pub features: Vec<Tensor3>,
    /// The actions drawn from the policy, `[rows, actions]` each, H of them; not clipped to [-1, 1].
    pub actions: Vec<Vec<f32>>,
    /// The predicted continuations times discount, `[rows]` each, H + 1 of them.
    pub continuations: Vec<Vec<f32>>,
    /// The critic's values, `[rows]` each, H + 1 of them.
    pub values: Vec<Vec<f32>>,
    /// [Lambda-returns](lambda_returns), `[rows]` each, H of them.
    pub returns: Vec<Vec<f32>>,
    /// The weight of each time step in the losses: the product of the predicted continuations (times discount) up to and
    /// including it, `[rows]` each, H of them.
    pub weights: Vec<Vec<f32>>,
}

/// The losses of actor and critic on an [`ImaginedRollout`], `[1, rows, 1]` for each of its H time steps.
#[derive(Clone, Debug)]
pub struct ActorCriticLoss {
    /// REINFORCE with entropy bonus.
    pub policy: Vec<Tensor3>,
    /// Two-hot cross-entropy of the lambda-return and of the target network's value.
    pub critic: Vec<Tensor3>,
    /// Means, for the log.
    pub report: Losses,
}

impl ActorCriticLoss {
    /// The losses with their weights, both averaged over time: what [`ops::total`] sums up.
    pub fn weighted(&self) -> Vec<(f32, Tensor3)> {
        let both = self.policy.iter().chain(&self.critic);
        both.map(|loss| (1.0 / self.policy.len() as f32, loss.clone())).collect()
    }
}

impl ActorCritic {
    /// New networks for the features of a world model, and the target network. At first the policy is nearly the same in
    /// all states, and every value is zero.
    ///
    /// # Panics
    /// If a setting lies outside its range.
    pub fn new(world: &WorldModel, actions: usize, config: &ActorCriticConfig, rng: &mut Rng) -> (Self, TargetCritic) {
        must_hold(config, "behaviour");
        let hidden = vec![config.units; config.layers];
        let features = world.config().rssm.features();
        let policy = Mlp::dreamer(world.device(), features, &hidden, Some(2 * actions), rng).scale_output(0.01);
        let critic = Mlp::dreamer(world.device(), features, &hidden, Some(world.bins().count()), rng).scale_output(0.0);
        let behaviour = Self { config: config.clone(), actions, entropy: config.entropy, policy, critic };
        let target = behaviour.target_critic();
        (behaviour, target)
    }

    /// A target network that is equal to the critic.
    pub fn target_critic(&self) -> TargetCritic {
        // A copy with tensors of its own.
        let mut target = self.critic.clone();
        copy_parameters(&mut target, &self.critic);
        target
    }

    /// Moves the target network towards the critic: `target <- (1 - rate) target + rate critic`.
    #[doc(alias = "Polyak averaging")]
    #[doc(alias = "EMA")]
    pub fn update_target(&self, target: &mut TargetCritic) {
        polyak(target, &self.critic, self.config.target_rate);
    }

    pub(super) fn distribution(&self, head: &[f32], i: usize) -> BoundedNormal {
        BoundedNormal::new(head[i], head[self.actions + i], self.config.min_std)
    }

    /// The policy's mean actions for features `[1, rows, features]`: `[rows, actions]`. With standard normal `noise`
    /// (`[rows, actions]`) the actions are `mean + std noise`, which may lie outside [-1, 1].
    pub fn act(&self, features: &Tensor3, noise: Option<&[f32]>) -> Vec<f32> {
        let head = self.policy.forward(features.clone(), Grad::Input);
        let rows = values(&head).chunks_exact(2 * self.actions);
        let normals = rows.flat_map(|head| (0..self.actions).map(|i| self.distribution(head, i)));
        match noise {
            None => normals.map(|normal| normal.mean).collect(),
            Some(noise) => normals.zip(noise).map(|(normal, noise)| normal.mean + normal.std * noise).collect(),
        }
    }

    /// The critic's values of features `[1, rows, features]`: `[rows]`.
    pub fn values(&self, world: &WorldModel, features: &Tensor3) -> Vec<f32> {
        world.bins().decode(&self.critic.forward(features.clone(), Grad::Input))
    }

    /// Imagines a rollout from each row of `start`: actions from the policy, latent states from the prior.
    #[doc(alias = "dream")]
    pub fn imagine(&self, world: &WorldModel, start: &Latent, rng: &mut Rng) -> ImaginedRollout {
        let (rows, horizon) = (start.rows(), self.config.horizon);
        let mut latent = start.clone();
        let mut features = vec![latent.features()];
        let mut actions = Vec::with_capacity(horizon);
        for t in 0..horizon {
            let noise = rng::normals(rows * self.actions, rng);
            let drawn = self.act(&features[t], Some(&noise));
            let clipped: Vec<f32> = drawn.iter().map(|a| a.clamp(-1.0, 1.0)).collect();
            latent = world.imagine(&latent, &tensor(world.device(), clipped, (1, rows, self.actions)), rng);
            features.push(latent.features());
            actions.push(drawn);
        }
        // One product for all time steps is faster than one for each.
        let all = NoneTape.stack(&features);
        let by_time =
            |numbers: Vec<f32>| -> Vec<Vec<f32>> { numbers.chunks_exact(rows).map(<[f32]>::to_vec).collect() };
        let [rewards, continuations, values] =
            [world.rewards(&all), world.continuations(&all), self.values(world, &all)].map(by_time);
        let mut weight = vec![1.0; rows];
        let mut weights = Vec::with_capacity(horizon);
        for continuations in &continuations[..horizon] {
            weight.iter_mut().zip(continuations).for_each(|(weight, c)| *weight *= c);
            weights.push(weight.clone());
        }
        let returns = lambda_returns(&rewards, &continuations, &values, self.config.lambda);
        ImaginedRollout { features, actions, continuations, values, returns, weights }
    }

    /// The losses of actor and critic on an imagined rollout, recorded on `tape`. Advantages are divided by `scale`, the
    /// [return scale](super::ReturnScale) S. The rollout is fixed: features, actions and returns are under a stop-gradient.
    pub fn loss<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        world: &WorldModel,
        target: &TargetCritic,
        rollout: &ImaginedRollout,
        scale: f32,
    ) -> ActorCriticLoss {
        let horizon = rollout.actions.len();
        // One time step below the other.
        let features = NoneTape.stack(&rollout.features[..horizon]);
        let [returns, values, weights] =
            [&rollout.returns, &rollout.values, &rollout.weights].map(|each| each[..horizon].concat());
        let actions = rollout.actions.concat();
        let mean = |numbers: &[f32]| numbers.iter().sum::<f32>() / numbers.len() as f32;
        // (R_t - v_t) / S.
        let mut advantages: Vec<f32> = returns.iter().zip(&values).map(|(r, v)| (r - v) / scale).collect();
        let advantage_mean = mean(&advantages);
        if self.config.center_advantages {
            advantages.iter_mut().for_each(|advantage| *advantage -= advantage_mean);
        }

        let head = self.policy.on(tape, &features, Grad::Params);
        let mut entropies = Vec::with_capacity(weights.len());
        let policy = tape.rowwise(&head, |row, head, slope| {
            let actions = &actions[row * self.actions..][..self.actions];
            let (loss, entropy) = self.reinforce(head, actions, weights[row], advantages[row], slope);
            entropies.push(entropy);
            loss
        });
        let target_values = world.bins().decode(&target.forward(features.clone(), Grad::Input));
        let critic = self.critic_loss(tape, world, &features, Grad::Params, [&returns, &target_values], &weights);
        let beyond = returns.iter().filter(|target| !world.bins().contains(**target)).count();
        let report = Losses::from([
            ("targets_beyond_bins", beyond as f32 / returns.len() as f32),
            ("policy_loss", ops::mean(&policy)),
            ("critic_loss", ops::mean(&critic)),
            ("policy_entropy", mean(&entropies)),
            ("advantage_magnitude", advantages.iter().map(|a| a.abs()).sum::<f32>() / advantages.len() as f32),
            ("imagined_value", mean(&rollout.values[0])),
        ]);
        let rows = weights.len() / horizon;
        let [policy, critic] =
            [policy, critic].map(|losses| (0..horizon).map(|t| tape.rows(&losses, t * rows, rows)).collect());
        ActorCriticLoss { policy, critic, report }
    }

    /// The actor's loss in one state: the objective of eq. 11, by REINFORCE with the critic as baseline (as in arXiv v2):
    ///
    /// `-w_t (sg((R_t - v_t) / S) log pi(a_t | s_t) + eta H[pi(. | s_t)] - kappa |mu_t|^2)`
    ///
    /// with the weight `w_t`, the entropy coefficient eta, and, unlike there, a penalty on the mean (`mean_penalty` kappa). Also the
    /// entropy; the gradient with respect to the policy's head goes into `slope`.
    #[doc(alias = "policy gradient")]
    #[doc(alias = "entropy bonus")]
    fn reinforce(&self, head: &[f32], actions: &[f32], weight: f32, advantage: f32, slope: &mut [f32]) -> (f32, f32) {
        let (mut log_density, mut entropy, mut penalty) = (0.0, 0.0, 0.0);
        for (i, action) in actions.iter().enumerate() {
            let normal = self.distribution(head, i);
            log_density += normal.log_density(*action);
            entropy += normal.entropy();
            let [of_mean, of_std] = normal.slopes(*action, -weight * advantage, -weight * self.entropy);
            let [cost, of_cost] = self.mean_penalty(i, &normal, weight);
            penalty += cost;
            (slope[i], slope[self.actions + i]) = (of_mean + of_cost, of_std);
        }
        (-weight * (log_density * advantage + self.entropy * entropy) + penalty, entropy)
    }

    /// The penalty on the mean of component `i` of an action, times a weight, and its derivative with respect to the raw mean.
    pub(super) fn mean_penalty(&self, i: usize, normal: &BoundedNormal, weight: f32) -> [f32; 2] {
        if self.config.penalised_components.is_some_and(|components| i >= components) {
            return [0.0; 2];
        }
        let weight = weight * self.config.mean_penalty;
        [weight * normal.mean * normal.mean, 2.0 * weight * normal.mean * normal.derivatives()[0]]
    }

    /// The critic's loss: the two-hot cross-entropies of both `targets` (the lambda-returns, and the target network's values
    /// as a regulariser), times a weight for each row.
    fn critic_loss<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        world: &WorldModel,
        features: &Tensor3,
        grad: Grad,
        targets: [&[f32]; 2],
        weights: &[f32],
    ) -> Tensor3 {
        let logits = self.critic.on(tape, features, grad);
        let loss = world.bins().loss(tape, &logits, &targets);
        tape.scale_rows(&loss, weights)
    }

    /// The critic's loss on replayed experience, with its weight. Its gradient flows into the `features` of the replayed
    /// latent states too (`[1, length x sequences, features]`, rows as in `batch`), so that they learn to predict values.
    /// Lambda-returns are bootstrapped with the `imagined_returns` from each of these states.
    pub fn replay_critic_loss<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        world: &WorldModel,
        target: &TargetCritic,
        batch: &SequenceBatch,
        features: &Tensor3,
        imagined_returns: &[f32],
    ) -> (f32, Tensor3) {
        let discount = world.config().discount();
        let (returns, mask) = replay_lambda_returns(batch, imagined_returns, discount, self.config.lambda);
        let features = tape.rows(features, 0, returns.len());
        let target_values = world.bins().decode(&target.forward(features.clone(), Grad::Input));
        let loss = self.critic_loss(tape, world, &features, Grad::Both, [&returns, &target_values], &mask);
        (self.config.replayed, loss)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::{Env, Task};
    use crate::model::WorldModelConfig;

    /// Log-density and entropy are the reference's numbers for this head and these actions; the gradient is checked against
    /// differences.
    #[test]
    fn the_policy_loss_is_the_references() {
        let world = Task::Pendulum.make();
        let mut rng = rng::stream(0, "actor");
        let world = WorldModel::new(world.spec(), &WorldModelConfig::default(), &mut rng);
        let (mut actor, _) = ActorCritic::new(&world, 2, &ActorCriticConfig::default(), &mut rng);
        let (head, actions, weight, advantage) = ([0.5, -0.3, 0.2, -1.0], [0.9, -1.4], 0.941_094, 0.864_437_3);
        let mut slope = [0.0; 4];
        let (loss, entropy) = actor.reinforce(&head, &actions, weight, advantage, &mut slope);
        let expected = -f64::from(weight) * (-2.652_197_05 * f64::from(advantage) + 3e-4 * 2.466_678_86);
        assert!((f64::from(loss) - expected).abs() < 1e-5 && (entropy - 2.466_679).abs() < 1e-5, "{loss} {expected}");

        actor.config.mean_penalty = 0.3;
        for (components, penalised) in [(Some(1), 1), (None, 2)] {
            actor.config.penalised_components = components;
            let means: f32 = head[..penalised].iter().map(|raw| raw.tanh() * raw.tanh()).sum();
            let with_penalty = actor.reinforce(&head, &actions, weight, advantage, &mut slope).0;
            assert!((with_penalty - loss - weight * 0.3 * means).abs() < 1e-5, "{with_penalty} {loss}");
            for (i, slope) in slope.iter().enumerate() {
                let moved = |by: f32| {
                    let mut head = head;
                    head[i] += by;
                    actor.reinforce(&head, &actions, weight, advantage, &mut [0.0; 4]).0
                };
                let difference = (moved(1e-2) - moved(-1e-2)) / 2e-2;
                assert!((slope - difference).abs() < 1e-3, "{i}: {slope}, {difference} by differences");
            }
        }
    }
}
