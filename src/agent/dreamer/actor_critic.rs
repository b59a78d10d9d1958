//! Actor and critic, which live in imagination: from every state that experience has led to, a dream; the critic learns what
//! dreams are worth, the actor to have better ones.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use super::returns::{lambda_returns, replayed_returns};
use crate::agent::Losses;
use crate::error::{Error, Result};
use crate::model::{Latent, WorldModel};
use crate::nn::ops::{self, record};
use crate::nn::{BoundedNormal, Grad, Mlp, Tensor3, copy_parameters, parameters_of_fields, polyak, tensor, values};
use crate::replay::SequenceBatch;
use crate::rng::{self, Rng};

/// Settings of an [`ActorCritic`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ActorCriticConfig {
    /// Width of the hidden layers of both.
    pub units: usize,
    /// Hidden layers of both.
    pub layers: usize,
    /// Steps of a dream.
    pub horizon: usize,
    /// How far returns trust in rewards before they trust in values: 0 for one step, 1 for the whole dream.
    pub lambda: f32,
    /// What a nat of the policy's entropy is worth, in units of the returns' scale.
    pub entropy: f32,
    /// The smallest deviation of the policy.
    pub min_std: f32,
    /// How fast the slow critic follows, per update.
    pub slow_rate: f32,
    /// Weight of the critic's loss on what was experienced.
    pub replayed: f32,
}

impl Default for ActorCriticConfig {
    fn default() -> Self {
        Self {
            units: 64,
            layers: 3,
            horizon: 15,
            lambda: 0.95,
            entropy: 3e-4,
            min_std: 0.1,
            slow_rate: 0.02,
            replayed: 0.3,
        }
    }
}

impl ActorCriticConfig {
    /// # Errors
    /// If a setting cannot be used.
    pub(crate) fn check(&self) -> Result<()> {
        if self.units == 0 || self.layers == 0 || self.horizon == 0 {
            return Err(Error::BadSetting("dreamer: `units`, `layers` and `horizon` must be at least 1".into()));
        }
        if !(0.0..=1.0).contains(&self.lambda) || !(0.0..1.0).contains(&self.min_std) || self.min_std <= 0.0 {
            return Err(Error::BadSetting("dreamer: `lambda` must lie in [0, 1], `min_std` between 0 and 1".into()));
        }
        Ok(())
    }
}

/// The networks of both.
#[derive(Clone, Debug)]
pub struct ActorCritic {
    config: ActorCriticConfig,
    actions: usize,
    policy: Mlp,
    critic: Mlp,
}

parameters_of_fields!(ActorCritic: policy, critic);

/// A slow copy of the critic, which steadies it.
pub type SlowCritic = Mlp;

/// Futures that were imagined, from many states at once. Lists hold an entry for each moment, the start first.
pub struct Dream {
    /// What was believed, `[1, rows, features]` each.
    pub features: Vec<Tensor3>,
    /// What was done at each moment but the last, `[rows, actions]` each.
    pub actions: Vec<Vec<f32>>,
    /// What the critic said.
    pub values: Vec<Vec<f32>>,
    /// Lambda returns, for each moment but the last.
    pub returns: Vec<Vec<f32>>,
    /// How much each moment counts: the chance, discounted, that the episode lasts till there.
    pub weights: Vec<Vec<f32>>,
}

impl ActorCritic {
    /// New networks for a world model's features. At first the policy does the same everywhere, and all is worth nothing.
    pub fn new(world: &WorldModel, actions: usize, config: &ActorCriticConfig, rng: &mut Rng) -> (Self, SlowCritic) {
        let hidden = vec![config.units; config.layers];
        let features = world.config().rssm.features();
        let policy = Mlp::dreamer(world.device(), features, &hidden, Some(2 * actions), rng).scale_output(0.01);
        let critic = Mlp::dreamer(world.device(), features, &hidden, Some(world.bins().count()), rng).scale_output(0.0);
        // A copy with tensors of its own.
        let mut slow = critic.clone();
        copy_parameters(&mut slow, &critic);
        (Self { config: config.clone(), actions, policy, critic }, slow)
    }

    /// Lets the slow critic follow.
    pub fn update_target(&self, slow: &mut SlowCritic) {
        polyak(slow, &self.critic, self.config.slow_rate);
    }

    fn distribution(&self, head: &[f32], i: usize) -> BoundedNormal {
        BoundedNormal::new(head[i], head[self.actions + i], self.config.min_std)
    }

    /// The policy's mean actions, `[rows, actions]`; or those that lie `noise` (of the same form) deviations away from
    /// them, which may lie beyond [-1, 1].
    pub fn act(&self, features: &Tensor3, noise: Option<&[f32]>) -> Vec<f32> {
        let head = self.policy.forward(features.clone(), Grad::Input);
        let rows = values(&head).chunks_exact(2 * self.actions);
        let drawn = rows.flat_map(|head| (0..self.actions).map(|i| self.distribution(head, i)));
        match noise {
            None => drawn.map(|normal| normal.mean).collect(),
            Some(noise) => drawn.zip(noise).map(|(normal, noise)| normal.mean + normal.std * noise).collect(),
        }
    }

    /// What the critic says of features.
    pub fn values(&self, world: &WorldModel, features: &Tensor3) -> Vec<f32> {
        world.bins().read(&self.critic.forward(features.clone(), Grad::Input))
    }

    /// Dreams from each row of `start`.
    pub fn dream(&self, world: &WorldModel, start: &Latent, rng: &mut Rng) -> Dream {
        let mut latent = start.clone();
        let mut features = vec![latent.features()];
        let mut actions = Vec::with_capacity(self.config.horizon);
        let rows = start.deter.shape().1;
        for t in 0..self.config.horizon {
            let noise: Vec<f32> = (0..rows * self.actions).map(|_| rng::normal(rng) as f32).collect();
            let drawn = self.act(&features[t], Some(&noise));
            let seen: Vec<f32> = drawn.iter().map(|a| a.clamp(-1.0, 1.0)).collect();
            latent = world.imagine(&latent, &tensor(world.device(), seen, (1, rows, self.actions)), rng);
            features.push(latent.features());
            actions.push(drawn);
        }
        let rewards: Vec<_> = features.iter().map(|features| world.rewards(features)).collect();
        let continues: Vec<_> = features.iter().map(|features| world.continues(features)).collect();
        let values: Vec<_> = features.iter().map(|features| self.values(world, features)).collect();
        let mut lasting = vec![1.0; values[0].len()];
        let mut weights = Vec::with_capacity(self.config.horizon);
        for continues in &continues[..self.config.horizon] {
            lasting.iter_mut().zip(continues).for_each(|(weight, c)| *weight *= c);
            weights.push(lasting.clone());
        }
        let returns = lambda_returns(&rewards, &continues, &values, self.config.lambda);
        Dream { features, actions, values, returns, weights }
    }

    /// The losses of actor and critic on a dream, recorded on `tape`. Advantages are divided by `scale`. The dream itself
    /// is fixed: no gradient flows into the world.
    pub fn losses<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        world: &WorldModel,
        slow: &SlowCritic,
        dream: &Dream,
        scale: f32,
    ) -> (Vec<(f32, Tensor3)>, Losses) {
        let share = 1.0 / self.config.horizon as f32;
        let mut parts = Vec::with_capacity(2 * self.config.horizon);
        let (mut entropy, mut advantage) = (0.0, 0.0);
        let [mut of_policy, mut of_critic] = [0.0; 2];
        let mean = |numbers: &[f32]| numbers.iter().sum::<f32>() / numbers.len() as f32;
        for (t, actions) in dream.actions.iter().enumerate() {
            let (features, weights) = (&dream.features[t], &dream.weights[t]);
            let advantages: Vec<f32> =
                dream.returns[t].iter().zip(&dream.values[t]).map(|(r, v)| (r - v) / scale).collect();
            advantage += share * advantages.iter().map(|a| a.abs()).sum::<f32>() / advantages.len() as f32;
            let policy = record(tape, features, |features| {
                let head = self.policy.forward(features, Grad::Params);
                ops::rowwise(head, |row, head, slope| {
                    let actions = &actions[row * self.actions..][..self.actions];
                    let (loss, nats) = self.policy_loss(head, actions, weights[row], advantages[row], slope);
                    entropy += share * nats / weights.len() as f32;
                    loss
                })
            });
            let steady = world.bins().read(&slow.forward(features.clone(), Grad::Input));
            let critic = record(tape, features, |features| {
                let logits = self.critic.forward(features, Grad::Params);
                ops::scale_rows(world.bins().loss(logits, &[&dream.returns[t], &steady]), weights)
            });
            of_policy += share * ops::mean(&policy);
            of_critic += share * ops::mean(&critic);
            parts.extend([(share, policy), (share, critic)]);
        }
        let report = Losses::from([
            ("policy_loss", of_policy),
            ("critic_loss", of_critic),
            ("policy_entropy", entropy),
            ("advantage", advantage),
            ("imagined_value", mean(&dream.values[0])),
        ]);
        (parts, report)
    }

    /// REINFORCE with a baseline and a bonus for entropy, for one state: the loss, and the policy's entropy there; the
    /// loss's gradient goes into `slope`.
    fn policy_loss(&self, head: &[f32], actions: &[f32], weight: f32, advantage: f32, slope: &mut [f32]) -> (f32, f32) {
        let (mut density, mut entropy) = (0.0, 0.0);
        for (i, action) in actions.iter().enumerate() {
            let normal = self.distribution(head, i);
            density += normal.log_density(*action);
            entropy += normal.entropy();
            let [of_mean, of_std] = normal.slopes(*action, -weight * advantage, -weight * self.config.entropy);
            (slope[i], slope[self.actions + i]) = (of_mean, of_std);
        }
        (-weight * (density * advantage + self.config.entropy * entropy), entropy)
    }

    /// The critic's loss on what was experienced, whose gradient flows into the beliefs too: they learn to tell what
    /// matters. `features` are what is believed at each moment of the batch, `beyond` what dreams from there are worth.
    pub fn replayed_loss<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        world: &WorldModel,
        slow: &SlowCritic,
        batch: &SequenceBatch,
        features: &Tensor3,
        beyond: &[f32],
    ) -> (f32, Tensor3) {
        let (returns, counts) = replayed_returns(batch, beyond, world.config().discount(), self.config.lambda);
        let known = record(tape, features, |features| ops::rows(features, 0, returns.len()));
        let steady = world.bins().read(&slow.forward(known.clone(), Grad::Input));
        let loss = record(tape, &known, |known| {
            let logits = self.critic.forward(known, Grad::Both);
            ops::scale_rows(world.bins().loss(logits, &[&returns, &steady]), &counts)
        });
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
        let (actor, _) = ActorCritic::new(&world, 2, &ActorCriticConfig::default(), &mut rng);
        let (head, actions, weight, advantage) = ([0.5, -0.3, 0.2, -1.0], [0.9, -1.4], 0.941_094, 0.864_437_3);
        let mut slope = [0.0; 4];
        let (loss, entropy) = actor.policy_loss(&head, &actions, weight, advantage, &mut slope);
        let expected = -f64::from(weight) * (-2.652_197_05 * f64::from(advantage) + 3e-4 * 2.466_678_86);
        assert!((f64::from(loss) - expected).abs() < 1e-5 && (entropy - 2.466_679).abs() < 1e-5, "{loss} {expected}");
        for (i, slope) in slope.iter().enumerate() {
            let moved = |by: f32| {
                let mut head = head;
                head[i] += by;
                actor.policy_loss(&head, &actions, weight, advantage, &mut [0.0; 4]).0
            };
            let difference = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            assert!((slope - difference).abs() < 1e-3, "{i}: {slope}, {difference} by differences");
        }
    }
}
