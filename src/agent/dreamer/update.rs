//! One update of Dreamer: the world model on replayed sequences, actor and critic on rollouts imagined from them, all by one
//! optimiser step.

use dfdx::prelude::*;
use dfdx::tensor::{Cpu, Gradients};
use rayon::prelude::*;

use super::actor_critic::{ActorCritic, ImaginedRollout, TargetCritic};
use super::config::{ActorGradient, PARTS};
use super::{Dreamer, DreamerConfig};
use crate::agent::Losses;
use crate::model::{Latent, WorldModel};
use crate::nn::{Parameters, TapeOps, ops, parameters_of_fields};
use crate::replay::SequenceBatch;
use crate::rng::{self, Rng};

/// All networks. The target network is not trained: it follows the critic.
#[derive(Clone, Debug)]
pub(super) struct Networks {
    pub world: WorldModel,
    pub behaviour: ActorCritic,
    pub target: TargetCritic,
}

parameters_of_fields!(Networks: world, behaviour);

/// A part of an update.
struct Part {
    gradients: Gradients<f32, Cpu>,
    losses: Losses,
    rollout: ImaginedRollout,
    /// What the rollout was drawn from, to draw it again.
    start: Latent,
    rng: Rng,
}

impl Dreamer {
    /// One update of world model, actor and critic on freshly sampled sequences. Returns the mean of every loss.
    ///
    /// # Panics
    /// If the replay buffer does not hold `length` time steps yet.
    pub fn learn(&mut self) -> Losses {
        let DreamerConfig { batch, length, dreams, .. } = self.config;
        let batches: Vec<(SequenceBatch, Rng)> = (0..PARTS)
            .map(|_| (self.replay.sample(batch / PARTS, length, &mut self.rng), rng::fork(&mut self.rng)))
            .collect();
        let networks = &self.networks;
        let starts = dreams.unwrap_or(length);
        let parts: Vec<Part> =
            batches.into_par_iter().map(|(batch, rng)| networks.world_model_update(&batch, starts, rng)).collect();
        // The return scale is that of all parts together.
        let mut returns: Vec<f32> = parts.iter().flat_map(|part| part.rollout.returns.concat()).collect();
        self.scale.update(&mut returns);
        let scale = self.scale.scale();
        let parts: Vec<Part> = parts.into_par_iter().map(|part| networks.actor_critic_update(part, scale)).collect();

        let mut losses = Losses::new();
        let mut gradients = Gradients::leaky();
        for mut part in parts {
            for (name, value) in part.losses {
                *losses.entry(name).or_default() += value / PARTS as f32;
            }
            for (_, parameter) in self.networks.parameters() {
                let own = std::mem::take(&mut **part.gradients.get_or_alloc_mut(parameter).expect("memory"));
                let sum = gradients.get_or_alloc_mut(parameter).expect("memory");
                sum.iter_mut().zip(own).for_each(|(sum, own)| *sum += own / PARTS as f32);
            }
        }
        losses.insert("gradient_norm", self.optimiser.step(&mut self.networks, &mut gradients));
        self.networks.world.select_inputs(self.config.learning_rate);
        losses.insert("return_scale", scale);
        let Networks { behaviour, target, .. } = &mut self.networks;
        behaviour.update_target(target);
        if let Some(target_entropy) = behaviour.config.target_entropy {
            self.temperature.step(target_entropy * behaviour.actions as f32 - losses["policy_entropy"]);
            behaviour.entropy = self.temperature.alpha();
            losses.insert("temperature", behaviour.entropy);
        }
        losses
    }
}

impl Networks {
    /// The world model's loss on a batch, and rollouts imagined from the latent states of the last `starts` time steps of
    /// each sequence. The critic's loss on the replayed sequences belongs here: its gradient flows into the world model.
    fn world_model_update(&self, batch: &SequenceBatch, starts: usize, mut rng: Rng) -> Part {
        let Self { world, behaviour, target } = self;
        let mut tape = OwnedTape::default();
        let loss = world.loss(&mut tape, batch, &mut rng);
        let batch = batch.last(starts);
        let rows = starts * batch.sequences;
        let (start, before) = (loss.latent.last(rows), rng.clone());
        let rollout = behaviour.imagine(world, &start, &mut rng);
        let features = tape.rows(&loss.features, loss.latent.rows() - rows, rows);
        let replay_critic =
            behaviour.replay_critic_loss(&mut tape, world, target, &batch, &features, &rollout.returns[0]);

        let mut losses = Losses::from(loss.means());
        losses.insert("replay_critic_loss", ops::mean(&replay_critic.1));
        losses.extend(loss.probe.as_ref().map(|probe| ("probe_loss", ops::mean(probe))));
        losses.insert("posterior_entropy", loss.posterior_entropy);
        losses.insert("prior_entropy", loss.prior_entropy);
        let mut all = loss.weighted();
        all.push(replay_critic);
        Part { gradients: ops::total(tape, &all).backward(), losses, rollout, start, rng: before }
    }

    /// Adds the gradients of actor and critic on the imagined rollouts, with advantages divided by the return scale.
    fn actor_critic_update(&self, part: Part, scale: f32) -> Part {
        let Part { gradients, mut losses, rollout, start, mut rng } = part;
        let Self { world, behaviour, target } = self;
        // A tape that adds to the gradients that are there already.
        let (_, mut tape) = rollout.features[0].clone().traced(gradients).split_tape();
        let mut loss = behaviour.loss(&mut tape, world, target, &rollout, scale);
        losses.extend(std::mem::take(&mut loss.report));
        let gradients = match behaviour.config.gradient {
            ActorGradient::Reinforce => ops::total(tape, &loss.weighted()).backward(),
            ActorGradient::Dynamics => {
                let of_critic = loss.critic.iter().map(|each| (1.0 / loss.critic.len() as f32, each.clone()));
                let mut gradients = ops::total(tape, &of_critic.collect::<Vec<_>>()).backward();
                let mut tape = OwnedTape::default();
                let terms = behaviour.dynamics_loss(&mut tape, world, &start, &rollout, scale, &mut rng);
                losses.insert("policy_loss", terms.iter().map(|(weight, term)| weight * ops::mean(term)).sum());
                let mut of_actor = ops::total(tape, &terms).backward();
                for (_, parameter) in behaviour.policy.parameters() {
                    let own = ops::take(&mut of_actor, parameter).expect("memory");
                    let sum = gradients.get_or_alloc_mut(parameter).expect("memory");
                    sum.iter_mut().zip(own).for_each(|(sum, own)| *sum += own);
                }
                gradients
            }
        };
        Part { gradients, losses, rollout, start, rng }
    }
}
