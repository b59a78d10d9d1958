//! Gradients of imagined returns with respect to actions, by dfdx's tape through the networks.
//!
//! Each member follows its own mean, without chance. A known reward is differentiated by central differences: it
//! is a cheap function of a few numbers. Cubes are seen upright at the start; their axes keep those names to the end, and are not
//! straightened on the way.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::{Dynamics, FeatureMap, Reward};
use crate::env::KnownReward;
use crate::nn::{Activation, Grad, Mlp, Tensor3, device, ops, tensor, values};

/// Step of the differences of a known reward.
const STEP: f32 = 1e-3;

/// The networks of a [`Dynamics`], on dfdx.
///
/// What stands around the networks is linear, and so are two more layers: one reads and normalises observation and
/// action; one adds the predicted changes to the observation, completes it, and hands out the reward if that was learned.
pub struct Differentiable {
    cpu: Cpu,
    entry: Fixed,
    /// What is read through a tanh: into it, and out of it.
    near: Option<[Fixed; 2]>,
    networks: Mlp,
    gated: bool,
    exit: Fixed,
    layout: FeatureMap,
    members: usize,
    observation: usize,
    actions: usize,
    outputs: usize,
}

/// A layer that does not learn: weight and bias, for each member the same.
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
    /// The same networks, to be differentiated.
    pub fn new(dynamics: &Dynamics) -> Self {
        let cpu = device();
        let Dynamics { layout, inputs, targets, .. } = dynamics;
        let (width, actions, outputs) = (layout.width, dynamics.action_size(), dynamics.outputs());
        let members = dynamics.members();

        // What is read of the observation as it is, what through a tanh, and the action: columns of the networks' input.
        let (plain, near) = (layout.inputs.len(), layout.near.len());
        let read = layout.inputs.iter().copied().zip(0..).chain((width..width + actions).zip(plain + near..));
        let mut entry = vec![vec![0.0; inputs.mean.len()]; width + actions];
        read.for_each(|(row, column)| entry[row][column] = 1.0 / inputs.scale[column]);
        let shift: Vec<f32> = inputs.mean.iter().zip(&inputs.scale).map(|(mean, scale)| -mean / scale).collect();
        let mut approach = vec![vec![0.0; near]; width + actions];
        let mut close = vec![vec![0.0; inputs.mean.len()]; near];
        for (j, (i, factor)) in layout.near.iter().enumerate() {
            approach[*i][j] = *factor;
            close[j][plain + j] = 1.0 / inputs.scale[plain + j];
        }

        // From observation and normalised changes to the next observation, and the reward behind it.
        let rewarded = dynamics.predicts_reward().then_some(width);
        let columns = width + usize::from(rewarded.is_some());
        let mut exit = vec![vec![0.0; columns]; width + outputs];
        let mut bias = vec![0.0; columns];
        (0..width).for_each(|i| exit[i][i] = 1.0);
        for (j, i) in layout.predicted.iter().copied().chain(rewarded).enumerate() {
            exit[width + j][i] = targets.scale[j];
            bias[i] = targets.mean[j];
        }
        for &[i, a, b] in &layout.differences {
            exit.iter_mut().for_each(|row| row[i] = row[a] - row[b]);
            bias[i] = bias[a] - bias[b];
        }
        Self {
            entry: Fixed::new(&cpu, members, &entry, &shift),
            near: (near > 0).then(|| {
                let unshifted = vec![0.0; inputs.mean.len()];
                [Fixed::new(&cpu, members, &approach, &vec![0.0; near]), Fixed::new(&cpu, members, &close, &unshifted)]
            }),
            networks: dynamics.networks(&cpu),
            gated: dynamics.gated(),
            exit: Fixed::new(&cpu, members, &exit, &bias),
            layout: layout.clone(),
            members,
            observation: width,
            actions,
            outputs,
            cpu,
        }
    }

    /// What the networks read of observations and actions side by side.
    fn read<T: Tape<f32, Cpu>>(&self, input: Tensor3<T>) -> Tensor3<T> {
        let Some([approach, close]) = &self.near else { return self.entry.forward(input) };
        let (input, tape) = input.split_tape();
        let (plain, tape) = self.entry.forward(input.clone().put_tape(tape)).split_tape();
        close.forward(approach.forward(input.put_tape(tape)).tanh()) + plain
    }

    /// The returns of `actions` (`[candidates, horizon, action]`) from `obs`, and their gradients. A return is the mean
    /// over the members' returns less `disagreement_penalty` times their standard deviation.
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
        // Each step's actions once for each member, so that each member's share of the gradient arrives by itself.
        let step_actions: Vec<Tensor3> = (0..horizon)
            .map(|t| {
                let of_step = actions.chunks_exact(horizon * width).flat_map(|row| &row[t * width..][..width]);
                let of_step: Vec<f32> = of_step.copied().collect();
                tensor(&self.cpu, of_step.repeat(members), (members, candidates, width))
            })
            .collect();
        let mut obs = obs.to_vec();
        self.layout.canonicalize(&mut obs, None);
        let start = tensor(&self.cpu, obs.repeat(members * candidates), (members, candidates, self.observation));
        let (mut state, mut tape) = start.leaky_traced().split_tape();
        let mut rewards: Vec<Tensor3> = Vec::with_capacity(horizon);
        for action in &step_actions {
            let input = ops::join(state.clone().put_tape(tape), action.clone());
            let head = self.networks.forward(self.read(input), Grad::Input);
            let head = if self.gated { ops::gated(head) } else { head };
            let changes = head.slice((.., .., ..self.outputs));
            let (changes, so_far) = changes.split_tape();
            let (after, so_far) = self.exit.forward(ops::join(state.clone().put_tape(so_far), changes)).split_tape();
            let (next, so_far) = after.clone().put_tape(so_far).slice((.., .., ..self.observation)).split_tape();
            let reward_of_step = match reward {
                Reward::Learned => after.put_tape(so_far).slice((.., .., self.observation..)),
                Reward::Known(known) => known_reward(known, &state, action, next.clone().put_tape(so_far)),
            };
            let (reward_of_step, so_far) = reward_of_step.split_tape();
            let next = next.put_tape(so_far);
            rewards.push(reward_of_step);
            (state, tape) = next.split_tape();
        }
        let mut rewards = rewards.into_iter();
        let first = rewards.next().expect("at least one step").put_tape(tape);
        let total = rewards.fold(first, |total, reward| total + reward);
        let (returns, weights) = weigh(values(&total), members, disagreement_penalty);
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

/// Mean less `disagreement_penalty` deviations over the members (`returns` is `[members, candidates]`), and how it changes with each
/// member's return.
fn weigh(returns: &[f32], members: usize, disagreement_penalty: f32) -> (Vec<f32>, Vec<f32>) {
    let candidates = returns.len() / members;
    let n = members as f32;
    let mut scores = vec![0.0; candidates];
    let mut weights = vec![0.0; returns.len()];
    for c in 0..candidates {
        let own = || (0..members).map(|m| returns[m * candidates + c]);
        let mean = own().sum::<f32>() / n;
        let deviation = (own().map(|r| (r - mean).powi(2)).sum::<f32>() / n).sqrt();
        scores[c] = mean - disagreement_penalty * deviation;
        for (m, r) in own().enumerate() {
            weights[m * candidates + c] = (1.0 - disagreement_penalty * (r - mean) / deviation.max(1e-6)) / n;
        }
    }
    (scores, weights)
}

/// The known reward of steps, `[members, candidates, 1]`.
fn known_reward<T: Tape<f32, Cpu>>(
    known: &(dyn KnownReward + Sync),
    obs: &Tensor3,
    action: &Tensor3,
    next: Tensor3<T>,
) -> Tensor3<T> {
    let (next, mut tape) = next.split_tape();
    let &(members, candidates, width) = obs.shape();
    let act = action.shape().2;
    let rows =
        || values(obs).chunks_exact(width).zip(values(action).chunks_exact(act)).zip(values(&next).chunks_exact(width));
    let rewards = rows().map(|((obs, action), next)| known.reward(obs, action, next)).collect();
    // How the reward changes with each number that it is computed from, side by side.
    let slopes: Vec<f32> = if T::OWNS_TAPE {
        rows().flat_map(|((obs, action), next)| slopes_of(known, [obs, action, next])).collect()
    } else {
        Vec::new()
    };
    let rewarded = obs.device().tensor_from_vec(rewards, (members, candidates, 1));
    if T::OWNS_TAPE {
        let parts = [obs.clone(), action.clone(), next];
        let rewarded = rewarded.clone();
        tape.add_backward_op(move |gradients| {
            let d = ops::take(gradients, &rewarded)?;
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
    rewarded.put_tape(tape)
}

fn slopes_of(known: &(dyn KnownReward + Sync), parts: [&[f32]; 3]) -> Vec<f32> {
    let mut parts = parts.map(<[f32]>::to_vec);
    let mut slopes = Vec::with_capacity(parts.iter().map(Vec::len).sum());
    for part in 0..3 {
        for i in 0..parts[part].len() {
            let here = parts[part][i];
            let mut at = |x: f32| {
                parts[part][i] = x;
                known.reward(&parts[0], &parts[1], &parts[2])
            };
            let difference = at(here + STEP) - at(here - STEP);
            at(here);
            slopes.push(difference / (2.0 * STEP));
        }
    }
    slopes
}
