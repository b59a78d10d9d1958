//! Gradients of imagined returns with respect to actions: backpropagation through time through the networks.
//!
//! Each member follows its own mean without noise, as with [`super::Propagation::TsInfMean`]. Rewards, known or learned, are
//! differentiated by central differences. Cubes are brought into
//! canonical orientation at the start only; their axes are not orthonormalized on the way.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::ensemble::LearnedReward;
use super::imagination::NO_REWARD;
use super::{Dynamics, FeatureMap, Reward};
use crate::nn::{Activation, Grad, Mlp, Tensor3, device, ops, tensor, values};

/// Step of the central differences of a reward.
const STEP: f32 = 1e-3;

/// The networks of a [`Dynamics`] as a differentiable simulator.
///
/// Everything around the networks is linear (but for the tanh features), so it is two more layers without trainable
/// weights: one selects and normalises features and action; one adds the predicted changes to the observation and recomputes
/// the differences.
#[doc(alias = "backpropagation through time")]
#[doc(alias = "BPTT")]
#[derive(Clone, Debug)]
pub struct Differentiable {
    cpu: Cpu,
    entry: Fixed,
    /// The tanh features: the layers before and after the tanh.
    near: Option<[Fixed; 2]>,
    networks: Mlp,
    gated: bool,
    exit: Fixed,
    features: FeatureMap,
    members: usize,
    observation: usize,
    actions: usize,
    outputs: usize,
    reward: Option<LearnedReward>,
}

/// A linear layer with fixed weights, the same for each member.
#[derive(Clone, Debug)]
struct Fixed {
    weight: Tensor3,
    bias: Tensor3,
}

impl Fixed {
    fn new(cpu: &Cpu, members: usize, weight: &[Vec<f32>], bias: &[f32]) -> Self {
        let (rows, columns) = (weight.len(), bias.len());
        Self {
            weight: tensor(cpu, weight.concat().repeat(members), (members, rows, columns)),
            bias: tensor(cpu, bias.repeat(members), (members, 1, columns)),
        }
    }

    fn forward<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>) -> Tensor3<T> {
        ops::dense(x, &self.weight, &self.bias, Activation::Identity, Grad::Input)
    }
}

impl Differentiable {
    /// The differentiable form of `dynamics`.
    pub fn new(dynamics: &Dynamics) -> Self {
        let cpu = device();
        let Dynamics { features, inputs, targets, .. } = dynamics;
        let (width, actions, outputs) = (features.width, dynamics.action_size(), dynamics.outputs());
        let members = dynamics.members();

        // Columns of the networks' input: raw features, tanh features, action.
        let (raw, near) = (features.raw.len(), features.near.len());
        let linear = features.raw.iter().copied().zip(0..).chain((width..width + actions).zip(raw + near..));
        let mut entry = vec![vec![0.0; inputs.mean.len()]; width + actions];
        linear.for_each(|(row, column)| entry[row][column] = 1.0 / inputs.scale[column]);
        let shift: Vec<f32> = inputs.mean.iter().zip(&inputs.scale).map(|(mean, scale)| -mean / scale).collect();
        let mut before_tanh = vec![vec![0.0; near]; width + actions];
        let mut after_tanh = vec![vec![0.0; inputs.mean.len()]; near];
        for (j, (i, factor)) in features.near.iter().enumerate() {
            before_tanh[*i][j] = *factor;
            after_tanh[j][raw + j] = 1.0 / inputs.scale[raw + j];
        }

        // From observation and normalised changes to the next observation.
        let mut exit = vec![vec![0.0; width]; width + outputs];
        let mut bias = vec![0.0; width];
        (0..width).for_each(|i| exit[i][i] = 1.0);
        for (j, &i) in features.predicted.iter().enumerate() {
            exit[width + j][i] = targets.scale[j];
            bias[i] = targets.mean[j];
        }
        for &[i, a, b] in &features.differences {
            exit.iter_mut().for_each(|row| row[i] = row[a] - row[b]);
            bias[i] = bias[a] - bias[b];
        }
        Self {
            entry: Fixed::new(&cpu, members, &entry, &shift),
            near: (near > 0).then(|| {
                let unshifted = vec![0.0; inputs.mean.len()];
                [
                    Fixed::new(&cpu, members, &before_tanh, &vec![0.0; near]),
                    Fixed::new(&cpu, members, &after_tanh, &unshifted),
                ]
            }),
            networks: dynamics.networks(&cpu),
            gated: dynamics.gated(),
            exit: Fixed::new(&cpu, members, &exit, &bias),
            features: features.clone(),
            members,
            observation: width,
            actions,
            outputs,
            reward: dynamics.learned_reward().cloned(),
            cpu,
        }
    }

    /// Network inputs of observations and actions side by side.
    fn inputs<T: Tape<f32, Cpu>>(&self, input: Tensor3<T>) -> Tensor3<T> {
        let Some([before_tanh, after_tanh]) = &self.near else { return self.entry.forward(input) };
        let (input, tape) = input.split_tape();
        let (linear, tape) = self.entry.forward(input.clone().put_tape(tape)).split_tape();
        after_tanh.forward(before_tanh.forward(input.put_tape(tape)).tanh()) + linear
    }

    /// Returns of the action sequences `actions` (`[candidates, horizon, action]`) from `obs`, `[candidates]`, and their
    /// gradients with respect to `actions`, of the same shape. A return is the mean over the members' undiscounted returns
    /// minus `disagreement_penalty` times their standard deviation; rewards after a termination count.
    ///
    /// # Panics
    /// If the sizes do not fit together, or `reward` is [`Reward::Learned`] and the model has not learned rewards.
    pub fn gradients(
        &self,
        reward: Reward,
        obs: &[f32],
        actions: &[f32],
        horizon: usize,
        disagreement_penalty: f32,
    ) -> (Vec<f32>, Vec<f32>) {
        let (members, width) = (self.members, self.actions);
        let candidates = actions.len() / (horizon * width);
        // Actions are repeated for each member, so that their gradients arrive member by member.
        let step_actions: Vec<Tensor3> = (0..horizon)
            .map(|t| {
                let of_step = actions.chunks_exact(horizon * width).flat_map(|row| &row[t * width..][..width]);
                let of_step: Vec<f32> = of_step.copied().collect();
                tensor(&self.cpu, of_step.repeat(members), (members, candidates, width))
            })
            .collect();
        let mut obs = obs.to_vec();
        self.features.canonicalize(&mut obs, None);
        let start = tensor(&self.cpu, obs.repeat(members * candidates), (members, candidates, self.observation));
        let (mut state, mut tape) = start.leaky_traced().split_tape();
        let mut rewards: Vec<Tensor3> = Vec::with_capacity(horizon);
        for action in &step_actions {
            let input = ops::join(state.clone().put_tape(tape), action.clone());
            let head = self.networks.forward(self.inputs(input), Grad::Input);
            let head = if self.gated { ops::gated(head) } else { head };
            let changes = head.slice((.., .., ..self.outputs));
            let (changes, recorded) = changes.split_tape();
            let (next, recorded) = self.exit.forward(ops::join(state.clone().put_tape(recorded), changes)).split_tape();
            let next_on_tape = next.clone().put_tape(recorded);
            let reward_of_step = match reward {
                Reward::Known(known) => reward_on(
                    &|_, [obs, action, next], rewards| known.rewards(obs, action, next, rewards),
                    &state,
                    action,
                    next_on_tape,
                ),
                Reward::Learned => {
                    let learned = self.reward.as_ref().expect(NO_REWARD);
                    reward_on(
                        &|member, [obs, action, next], rewards| learned.of_member(member, obs, action, next, rewards),
                        &state,
                        action,
                        next_on_tape,
                    )
                }
            };
            let (reward_of_step, recorded) = reward_of_step.split_tape();
            let next = next.put_tape(recorded);
            rewards.push(reward_of_step);
            (state, tape) = next.split_tape();
        }
        let mut rewards = rewards.into_iter();
        let first = rewards.next().expect("at least one step").put_tape(tape);
        let total = rewards.fold(first, |total, reward| total + reward);
        let (returns, weights) = mean_minus_std(values(&total), members, disagreement_penalty);
        let weights = tensor(&self.cpu, weights, (members, candidates, 1));
        let mut gradients = (total * weights).sum::<Rank0, _>().backward();
        let mut slopes = vec![0.0; actions.len()];
        for (t, action) in step_actions.iter().enumerate() {
            let of_members = gradients.get_or_alloc_mut(action).expect("memory for a gradient");
            for (row, slope) in of_members.chunks_exact(width).enumerate() {
                let at = (row % candidates * horizon + t) * width;
                slopes[at..at + width].iter_mut().zip(slope).for_each(|(sum, slope)| *sum += slope);
            }
        }
        (returns, slopes)
    }
}

/// Mean minus `disagreement_penalty` standard deviations over the members (`returns` is `[members, candidates]`), and the
/// derivatives with respect to each member's return.
fn mean_minus_std(returns: &[f32], members: usize, disagreement_penalty: f32) -> (Vec<f32>, Vec<f32>) {
    let candidates = returns.len() / members;
    let n = members as f32;
    let mut scores = vec![0.0; candidates];
    let mut weights = vec![0.0; returns.len()];
    for c in 0..candidates {
        let own = || (0..members).map(|m| returns[m * candidates + c]);
        let mean = own().sum::<f32>() / n;
        let std = (own().map(|r| (r - mean).powi(2)).sum::<f32>() / n).sqrt();
        scores[c] = mean - disagreement_penalty * std;
        for (m, r) in own().enumerate() {
            weights[m * candidates + c] = (1.0 - disagreement_penalty * (r - mean) / std.max(1e-6)) / n;
        }
    }
    (scores, weights)
}

/// Writes the rewards that a member expects of transitions: rows of observations, actions and next observations.
type RewardOf<'a> = dyn Fn(usize, [&[f32]; 3], &mut [f32]) + 'a;

/// The reward of a time step, `[members, candidates, 1]`.
fn reward_on<T: Tape<f32, Cpu>>(reward: &RewardOf, obs: &Tensor3, action: &Tensor3, next: Tensor3<T>) -> Tensor3<T> {
    let (next, mut tape) = next.split_tape();
    let &(members, candidates, width) = obs.shape();
    let act = action.shape().2;
    let parts = [values(obs), values(action), values(&next)];
    let of_member = |member: usize| {
        let rows = |part: usize, width: usize| &parts[part][member * candidates * width..][..candidates * width];
        [rows(0, width), rows(1, act), rows(2, width)]
    };
    let mut rewards = vec![0.0; members * candidates];
    for (member, rewards) in rewards.chunks_exact_mut(candidates).enumerate() {
        reward(member, of_member(member), rewards);
    }
    let on_tape = obs.device().tensor_from_vec(rewards, (members, candidates, 1));
    if T::OWNS_TAPE {
        // Derivatives of the reward with respect to observation, action and next observation, side by side.
        let slopes: Vec<f32> = (0..members).flat_map(|m| slopes_of(reward, m, of_member(m), candidates)).collect();
        let parts = [obs.clone(), action.clone(), next];
        let on_tape = on_tape.clone();
        tape.add_backward_op(move |gradients| {
            let d = ops::take(gradients, &on_tape)?;
            let whole = 2 * width + act;
            let mut from = 0;
            for part in &parts {
                let size = part.shape().2;
                let sums = gradients.get_or_alloc_mut(part)?.chunks_exact_mut(size);
                for ((sums, slopes), d) in sums.zip(slopes.chunks_exact(whole)).zip(&d) {
                    sums.iter_mut().zip(&slopes[from..from + size]).for_each(|(sum, slope)| *sum += d * slope);
                }
                from += size;
            }
            Ok(())
        });
    }
    on_tape.put_tape(tape)
}

/// Central differences of a member's rewards with respect to the three parts of each transition, `[candidates, numbers]`.
fn slopes_of(reward: &RewardOf, member: usize, parts: [&[f32]; 3], candidates: usize) -> Vec<f32> {
    let widths = parts.map(|part| part.len() / candidates);
    let whole: usize = widths.iter().sum();
    let mut slopes = Vec::with_capacity(candidates * whole);
    let mut rewards = vec![0.0; 2 * whole];
    for candidate in 0..candidates {
        // Each transition 2 x `whole` times, with one number moved up and down.
        let mut moved: [Vec<f32>; 3] =
            std::array::from_fn(|part| parts[part][candidate * widths[part]..][..widths[part]].repeat(2 * whole));
        let mut row = 0;
        for (rows, width) in moved.iter_mut().zip(widths) {
            for i in 0..width {
                rows[row * width + i] += STEP;
                rows[(row + 1) * width + i] -= STEP;
                row += 2;
            }
        }
        reward(member, [&moved[0], &moved[1], &moved[2]], &mut rewards);
        slopes.extend(rewards.chunks_exact(2).map(|pair| (pair[0] - pair[1]) / (2.0 * STEP)));
    }
    slopes
}
