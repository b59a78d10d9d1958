//! The actor's gradient through the learned dynamics, as in DreamerV1, V2 and the first DreamerV3 for continuous actions: rewards
//! and values are differentiated with respect to the actions that led to them, where REINFORCE weighs log-densities.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::actor_critic::{ActorCritic, ImaginedRollout};
use crate::model::{Latent, WorldModel};
use crate::nn::{Grad, TapeOps, Tensor3, ops};
use crate::rng::{self, Rng};

impl ActorCritic {
    /// The actor's loss on a rollout that [`ActorCritic::imagine`] drew from `start` with this generator, drawn again on `tape`:
    ///
    /// `-1/H sum_t w_t (R_t / S + eta H[pi(. | s_t)] - kappa |mu_t|^2)`
    ///
    /// with the return scale S, the entropy coefficient eta and the `mean_penalty` kappa, as terms for [`ops::total`]. Weights and
    /// continuations are under a stop-gradient, and so are the states that the policy reads. Gradients flow into the world model's
    /// parameters, too: only those of the policy are meant to be used.
    pub(super) fn dynamics_loss<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        world: &WorldModel,
        start: &Latent,
        rollout: &ImaginedRollout,
        scale: f32,
        rng: &mut Rng,
    ) -> Vec<(f32, Tensor3)> {
        let (rows, horizon) = (start.rows(), rollout.actions.len());
        let mut latent = start.clone();
        let mut features = vec![latent.features()];
        let mut losses = Vec::with_capacity(horizon + 2);
        for t in 0..horizon {
            let noise = rng::normals(rows * self.actions, rng);
            let head = self.policy.on(tape, &features[t], Grad::Params);
            let action = tape.record(&head, |head| {
                ops::map_rows(head, self.actions, |row, head, action, jacobian| {
                    self.reparametrised(head, &noise[row * self.actions..], action, jacobian);
                })
            });
            let weights = &rollout.weights[t];
            let regularisers = tape.rowwise(&head, |row, head, slope| self.regularisers(head, weights[row], slope));
            losses.push((1.0 / horizon as f32, regularisers));
            latent = world.imagine_on(tape, &latent, &action, rng);
            features.push(tape.join(&latent.deter, &latent.stoch));
        }
        let all = tape.stack(&features[1..]);
        let slopes = slopes_of_returns(&rollout.weights, &rollout.continuations, self.config.lambda);
        let logits = [world.reward_logits(tape, &all), self.critic.on(tape, &all, Grad::Input)];
        for (slopes, logits) in slopes.iter().zip(&logits) {
            let predicted = world.bins().decode_on(tape, logits);
            losses.push((-1.0 / scale, tape.scale_rows(&predicted, &slopes.concat())));
        }
        losses
    }

    /// The action in one state for this noise, `mean + std noise`, as a function of the policy's head. Beyond [-1, 1] it is
    /// divided by its magnitude, which counts as a constant, as in the published code.
    fn reparametrised(&self, head: &[f32], noise: &[f32], action: &mut [f32], jacobian: &mut [f32]) {
        for (i, action) in action.iter_mut().enumerate() {
            let normal = self.distribution(head, i);
            let drawn = normal.mean + normal.std * noise[i];
            let shrink = 1.0 / drawn.abs().max(1.0);
            *action = drawn.clamp(-1.0, 1.0);
            let jacobian = &mut jacobian[i * head.len()..][..head.len()];
            let [of_mean, of_std] = normal.derivatives();
            (jacobian[i], jacobian[self.actions + i]) = (of_mean * shrink, of_std * noise[i] * shrink);
        }
    }

    /// The loss of the entropy bonus and of the penalty on the mean in one state, times a weight; its gradient goes into `slope`.
    fn regularisers(&self, head: &[f32], weight: f32, slope: &mut [f32]) -> f32 {
        let bonus = -weight * self.entropy;
        let each = (0..self.actions).map(|i| {
            let normal = self.distribution(head, i);
            [slope[i], slope[self.actions + i]] = normal.slopes(normal.mean, 0.0, bonus);
            let [penalty, of_penalty] = self.mean_penalty(i, &normal, weight);
            slope[i] += of_penalty;
            bonus * normal.entropy() + penalty
        });
        each.sum()
    }
}

/// The derivatives of `sum_t weights_t R_t` with respect to the rewards and to the values that the
/// [lambda-returns](super::lambda_returns) R_t are made of, `[rows]` for each time step from 1 to H.
fn slopes_of_returns(weights: &[Vec<f32>], continuations: &[Vec<f32>], lambda: f32) -> [Vec<Vec<f32>>; 2] {
    let (horizon, rows) = (weights.len(), weights[0].len());
    // How much R_t counts, also as a part of the returns before it.
    let mut of_return = vec![0.0; rows];
    let (mut of_rewards, mut of_values) = (Vec::with_capacity(horizon), Vec::with_capacity(horizon));
    for t in 0..horizon {
        let next = &continuations[t + 1];
        let bootstrapped = if t + 1 == horizon { 1.0 } else { 1.0 - lambda };
        for row in 0..rows {
            // At the start nothing came before: zero.
            of_return[row] = weights[t][row] + continuations[t][row] * lambda * of_return[row];
        }
        of_rewards.push(of_return.clone());
        of_values.push(of_return.iter().zip(next).map(|(slope, c)| slope * c * bootstrapped).collect());
    }
    [of_rewards, of_values]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent::dreamer::{ActorCriticConfig, lambda_returns};
    use crate::env::{Env, Task};
    use crate::model::WorldModelConfig;

    /// Returns are linear in rewards and values, so differences are exact but for rounding.
    #[test]
    fn slopes_of_returns_agree_with_differences() {
        let lists = |seed: u64, count: usize| -> Vec<Vec<f32>> {
            let mut rng = rng::stream(seed, "lists");
            (0..count).map(|_| (0..2).map(|_| rng::normal(&mut rng) as f32).collect()).collect()
        };
        let (rewards, values, weights) = (lists(0, 5), lists(1, 5), lists(2, 4));
        let continuations: Vec<Vec<f32>> =
            lists(3, 5).iter().map(|c| c.iter().map(|c| c.abs().min(1.0)).collect()).collect();
        let total = |rewards: &[Vec<f32>], values: &[Vec<f32>]| -> f32 {
            let returns = lambda_returns(rewards, &continuations, values, 0.9).concat();
            weights.concat().iter().zip(&returns).map(|(weight, r)| weight * r).sum()
        };
        let [of_rewards, of_values] = slopes_of_returns(&weights, &continuations, 0.9);
        for (t, row) in (1..5).flat_map(|t| [(t, 0), (t, 1)]) {
            let moved = |lists: &[Vec<f32>]| {
                let mut lists = lists.to_vec();
                lists[t][row] += 1.0;
                lists
            };
            let before = total(&rewards, &values);
            let by_reward = total(&moved(&rewards), &values) - before;
            let by_value = total(&rewards, &moved(&values)) - before;
            assert!((of_rewards[t - 1][row] - by_reward).abs() < 1e-5, "reward {t}: {by_reward}");
            assert!((of_values[t - 1][row] - by_value).abs() < 1e-5, "value {t}: {by_value}");
        }
    }

    /// Within [-1, 1]; beyond, actions stay at the limit but pass gradients.
    #[test]
    fn actions_and_regularisers_have_the_slopes_of_differences() {
        let env = Task::Pendulum.make();
        let mut rng = rng::stream(0, "actor");
        let world = WorldModel::new(env.spec(), &WorldModelConfig::default(), &mut rng);
        let config = ActorCriticConfig {
            entropy: 0.7,
            mean_penalty: 0.4,
            penalised_components: Some(1),
            ..ActorCriticConfig::default()
        };
        let (actor, _) = ActorCritic::new(&world, 2, &config, &mut rng);
        let (head, noise) = ([0.5, -0.3, 0.2, -1.0], [0.3, -0.7]);
        let action = |head: &[f32], noise: &[f32]| {
            let (mut action, mut jacobian) = ([0.0; 2], [0.0; 8]);
            actor.reparametrised(head, noise, &mut action, &mut jacobian);
            (action, jacobian)
        };
        let (_, jacobian) = action(&head, &noise);
        let mut slope = [0.0; 4];
        actor.regularisers(&head, 0.9, &mut slope);
        for k in 0..4 {
            let at = |by: f32| {
                let mut head = head;
                head[k] += by;
                (action(&head, &noise).0, actor.regularisers(&head, 0.9, &mut [0.0; 4]))
            };
            let ((above, more), (below, less)) = (at(1e-2), at(-1e-2));
            for i in 0..2 {
                let difference = (above[i] - below[i]) / 2e-2;
                assert!((jacobian[4 * i + k] - difference).abs() < 1e-3, "action {i} by {k}: {difference}");
            }
            assert!((slope[k] - (more - less) / 2e-2).abs() < 1e-3, "regularisers by {k}");
        }
        let (limited, jacobian) = action(&head, &[3.0, 0.0]);
        assert!((limited[0] - 1.0).abs() < 1e-6 && jacobian[0] > 0.0);
    }
}
