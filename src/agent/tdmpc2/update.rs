//! One update of TD-MPC2: the model on slices of experience, then the policy on the latent states of the same rollouts, then
//! the target network.

use dfdx::prelude::*;

use super::planning::two_of;
use super::{Networks, RunningScale, TdMpc2, TdMpc2Config};
use crate::agent::Losses;
use crate::model::implicit::step_weights;
use crate::nn::{Grad, TapeOps, Tensor3, ops, polyak, values};
use crate::replay::SequenceBatch;
use crate::rng::{self, Rng};

impl TdMpc2 {
    /// One update on freshly drawn slices of `horizon` steps; `None` while no episode is that long. Returns the means of
    /// `consistency_loss`, `reward_loss`, `value_loss` and `policy_loss`; `policy_entropy`, in nats; `target`, the mean value target, `q`, the mean value of the
    /// policy's actions, and `value_scale`, all three in multiples of [`TdMpc2Config::reward_unit`](super::TdMpc2Config::reward_unit);
    /// `targets_beyond_bins`, the share of targets that no bin holds (more than a few: raise `bin_limit`); `ends_not_modelled`, without
    /// [`terminates`](crate::model::ImplicitConfig::terminates), the terminations per slice (more than 0: set it); `latent_drift`
    /// ([`drift`](crate::model::ImplicitLoss::drift)); and the norms of the gradients before clipping.
    pub fn learn(&mut self) -> Option<Losses> {
        let Self { config, networks, scale, discount, replay, rng, .. } = self;
        let batch = replay.sample_within_episodes(config.batch, config.horizon + 1, rng)?;
        let mut losses = Losses::new();

        // The model.
        let (encoded, targets) = networks.value_targets(&batch, *discount, config.n_step, rng);
        let mut tape = OwnedTape::default();
        let loss = networks.model.loss(&mut tape, &batch, &encoded, &targets);
        let weighted = loss.weighted(&config.model);
        losses.insert("consistency_loss", ops::mean(&loss.consistency));
        losses.insert("reward_loss", ops::mean(&loss.reward));
        losses.insert("value_loss", ops::mean(&loss.value));
        losses.insert("latent_drift", loss.drift(&encoded));
        losses.insert("target", targets.iter().sum::<f32>() / targets.len() as f32);
        let beyond = targets.iter().filter(|target| !networks.model.bins().contains(**target)).count();
        losses.insert("targets_beyond_bins", beyond as f32 / targets.len() as f32);
        if !config.model.terminates {
            let ends = batch.terminal.iter().filter(|end| **end).count();
            losses.insert("ends_not_modelled", ends as f32 / batch.sequences as f32);
        }
        let mut gradients = ops::total(tape, &weighted).backward();
        losses.insert("model_gradient", self.model_optimiser.step(&mut networks.model, &mut gradients));
        networks.model.select_inputs(config.learning_rate, config.lasso);

        // The policy, on latent states that are data to it.
        let latents = NoneTape.stack(&loss.latents);
        let mut tape = OwnedTape::default();
        let policy = networks.policy_loss(&mut tape, &latents, batch.sequences, config, scale, rng);
        losses.insert("policy_loss", ops::mean(&policy.climb) + ops::mean(&policy.entropy));
        losses.insert("policy_entropy", policy.nats);
        losses.insert("q", policy.q);
        losses.insert("value_scale", scale.scale());
        let mut gradients = ops::total(tape, &[(1.0, policy.climb), (1.0, policy.entropy)]).backward();
        losses.insert("policy_gradient", self.policy_optimiser.step(&mut networks.policy, &mut gradients));

        // The target network.
        polyak(&mut networks.target, networks.model.critics(), config.target_rate);

        // The probe, for replays: no gradient flows into the model.
        let mut tape = OwnedTape::default();
        let obs = &batch.obs[..batch.obs.len() / batch.length];
        let error = networks.probe.loss(&mut tape, &networks.model, &loss.latents[0], obs);
        losses.insert("probe_loss", ops::mean(&error));
        self.probe_optimiser.step(&mut networks.probe, &mut ops::total(tape, &[(1.0, error)]).backward());
        self.frozen = None;
        Some(losses)
    }
}

/// The policy's loss, step after step of the rollout.
pub(super) struct PolicyLoss {
    /// Minus the values of its actions, scaled: `[1, rows, 1]`.
    pub climb: Tensor3,
    /// Minus the weighted entropy bonus: `[1, rows, 1]`.
    pub entropy: Tensor3,
    /// The mean entropy, in nats.
    pub nats: f32,
    /// The mean value.
    pub q: f32,
}

impl Networks {
    /// The latent states of all but the first observation, `[1, H x sequences, latent]`, and the value targets,
    ///
    /// ```text
    /// y_t = r_t + discount (1 - terminal_t) min(Q'_i, Q'_j)(z_t+1, a),   a ~ p(z_t+1),  z_t+1 = h(o_t+1)
    /// ```
    ///
    /// or what `n_step` rewards make of it, with two of the target critics, drawn anew each time. No gradient flows into them (stop-gradient).
    #[doc(alias = "Bellman")]
    pub(super) fn value_targets(
        &self,
        batch: &SequenceBatch,
        discount: f32,
        n_step: usize,
        rng: &mut Rng,
    ) -> (Tensor3, Vec<f32>) {
        let Self { model, policy, target, .. } = self;
        let obs_size = batch.obs.len() / (batch.length * batch.sequences);
        let encoded = model.encode(&batch.obs[batch.sequences * obs_size..]);
        let actions = policy.sample(&encoded, rng);
        let pair = target.subset(model.device(), &two_of(model.config().critics, rng));
        let q = model.values(&pair, &encoded, &actions);
        (encoded, bootstrapped(batch, &q, discount, n_step))
    }

    /// The policy's loss on latent states `z` (`[1, (H + 1) x sequences, latent]`, step after step):
    ///
    /// ```text
    /// L = 1/(H+1) sum_t decay^t [ -(Q_i + Q_j)(z_t, a_t) / (2 S) - entropy x bonus ],   a_t ~ p(z_t)
    /// ```
    ///
    /// with two of the critics; S is the running scale of the values at the first step, which takes them in first. Gradients
    /// flow through the critics to the action, but not into the critics.
    pub(super) fn policy_loss(
        &self,
        tape: &mut OwnedTape<f32, Cpu>,
        z: &Tensor3,
        sequences: usize,
        config: &TdMpc2Config,
        scale: &mut RunningScale,
        rng: &mut Rng,
    ) -> PolicyLoss {
        let noise = rng::normals(z.shape().1 * self.actions, rng);
        let pair = two_of(self.model.config().critics, rng);
        self.climb(tape, z, &noise, pair, sequences, config, scale)
    }

    /// [`Networks::policy_loss`] with everything drawn: standard normal `noise`, `[rows, actions]`, and the two critics.
    #[expect(clippy::too_many_arguments, reason = "what is drawn, beside what it is drawn for")]
    pub(super) fn climb(
        &self,
        tape: &mut OwnedTape<f32, Cpu>,
        z: &Tensor3,
        noise: &[f32],
        pair: [usize; 2],
        sequences: usize,
        config: &TdMpc2Config,
        scale: &mut RunningScale,
    ) -> PolicyLoss {
        let Self { model, policy, .. } = self;
        let rows = z.shape().1;
        let (action, bonus) = policy.sample_on(tape, z, noise, config.entropy_bonus);
        let pair = model.critics().subset(model.device(), &pair);
        let input = tape.record(&action, |action| {
            let (action, tape) = action.split_tape();
            ops::join(z.clone().put_tape(tape), action)
        });
        let logits = pair.on(tape, &input, Grad::Input);
        let of_pair = model.bins().decode_on(tape, &logits);
        let q = tape.mean_of_members(&of_pair);
        scale.update(&values(&q)[..sequences]);
        let weights = step_weights(model.config().decay, rows / sequences, sequences);
        let times = |factor: f32| weights.iter().map(|weight| -factor * weight).collect::<Vec<f32>>();
        PolicyLoss {
            climb: tape.scale_rows(&q, &times(1.0 / scale.scale())),
            entropy: tape.scale_rows(&bonus, &times(config.entropy)),
            nats: ops::mean(&bonus) / self.actions as f32,
            q: ops::mean(&q),
        }
    }
}

/// Value targets `[H x sequences]` from the values `[2, H x sequences]` of two critics: the rewards of up to `n_step` steps,
/// fewer at the end of the slices, and the value of the state that they lead to.
pub(super) fn bootstrapped(batch: &SequenceBatch, q: &[f32], discount: f32, n_step: usize) -> Vec<f32> {
    let (one, other) = q.split_at(q.len() / 2);
    // A time step of the batch holds the reward for arriving there.
    let (rewards, terminal) = (&batch.rewards[batch.sequences..], &batch.terminal[batch.sequences..]);
    let target = |first: usize| {
        let steps = (first..one.len()).step_by(batch.sequences).take(n_step);
        let last = steps.clone().next_back().expect("the first itself");
        let value = if terminal[last] { 0.0 } else { one[last].min(other[last]) };
        steps.rev().fold(value, |value, i| rewards[i] + discount * value)
    };
    (0..one.len()).map(target).collect()
}
