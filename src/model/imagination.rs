//! Letting a model run ahead: many action sequences, several possible futures for each.
//!
//! All candidates meet the same noise (the same noise, the same order of members), so that what differs between them
//! is due to their actions. A candidate's futures depend on nothing but the seed, neither on the other candidates
//! nor on the number of threads.

use rand::seq::SliceRandom;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Dynamics;
use super::dynamics::Scratch;
use crate::env::KnownReward;
use crate::nn::frozen::PANEL;
use crate::rng::{self, Rng};

/// Rows that one thread puts through a network at a time: few enough for its cache.
const ROWS: usize = 12 * PANEL;

/// How uncertainty is carried from step to step (Chua et al. 2018, section 5).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Propagation {
    /// A particle stays with one member to the end: disagreement adds up along the way.
    #[default]
    TsInf,
    /// Particles change members at every step.
    Ts1,
    /// Each member follows its own mean, without chance: what is left is disagreement. For worlds without dice, where
    /// a planner would bet on lucky noise.
    TsInfMean,
    /// One future: the average of the members' means, without chance.
    Expectation,
    /// Particles are drawn from the mixture of all members, and drawn anew at every step from a Gaussian fitted to them.
    MomentMatching,
}

/// Where rewards come from.
#[derive(Clone, Copy)]
pub enum Reward<'a> {
    /// From a function of observations that is known, as is the end of the task.
    Known(&'a (dyn KnownReward + Sync)),
    /// From the model, which has learned them. It knows of no end.
    Learned,
}

/// What an observed state is worth.
pub type Value<'a> = dyn Fn(&[f32]) -> f32 + Sync + 'a;

/// Runs a model ahead.
#[derive(Clone, Copy)]
pub struct Imagination<'a> {
    /// The model.
    pub dynamics: &'a Dynamics,
    /// Where rewards come from.
    pub reward: Reward<'a>,
    /// How uncertainty is carried on.
    pub propagation: Propagation,
    /// ImaginedReturns of each candidate, a multiple of the members. (Where members follow their means there is one for each of
    /// them, and one in all where only the mean of means is followed.)
    pub particles: usize,
    /// What the state at the horizon's end is worth beyond it, if anything is known of that.
    pub value: Option<&'a Value<'a>>,
}

/// What may become of candidates.
#[derive(Clone, Debug, PartialEq)]
pub struct ImaginedReturns {
    /// ImaginedReturns of each candidate.
    pub particles: usize,
    /// Sums of rewards (and value at the end), `[candidates, particles]`.
    pub returns: Vec<f32>,
    /// How far the members disagree about each candidate's way, added up over its steps: the root mean square, over all
    /// predicted numbers, of the deviation between members, in units of the typical change in a step.
    pub disagreement: Vec<f32>,
}

impl Imagination<'_> {
    /// ImaginedReturns drawn for each candidate.
    pub fn particles(&self) -> usize {
        match self.propagation {
            Propagation::Expectation => 1,
            Propagation::TsInfMean => self.dynamics.members(),
            _ => self.particles,
        }
    }

    /// What may become of `actions` (`[candidates, horizon, action]`), starting from `obs`: one observation, or one for
    /// each candidate.
    ///
    /// # Panics
    /// If the sizes do not fit together, the particles cannot be shared out over the members, or the model has not
    /// learned the rewards that are asked of it.
    pub fn imagined_returns(&self, obs: &[f32], actions: &[f32], horizon: usize, rng: &mut Rng) -> ImaginedReturns {
        let width = horizon * self.dynamics.action_size();
        let (count, particles) = (actions.len() / width, self.particles());
        assert_eq!(count * width, actions.len(), "whole sequences");
        let noise = CommonRandomNumbers::draw(self, horizon, rng);
        let mut returns = vec![0.0; count * particles];
        let mut disagreement = vec![0.0; count];
        let share = self.share(count);
        let parts = returns.par_chunks_mut(share * particles).zip(disagreement.par_chunks_mut(share));
        let parts = parts.zip(actions.par_chunks(share * width)).enumerate();
        parts.for_each(|(part, ((returns, disagreement), actions))| {
            let obs = self.starts(obs, part * share, returns.len() / particles);
            self.run(&obs, actions, horizon, &noise, returns, disagreement, &mut |_, _| {});
        });
        ImaginedReturns { particles, returns, disagreement }
    }

    /// The ways themselves: for each step from 0 to `horizon` the observations of all futures,
    /// `[horizon + 1][particles, candidates, observation]`, beside what [`Imagination::futures`] answers.
    ///
    /// # Panics
    /// As [`Imagination::futures`].
    pub fn trajectories(
        &self,
        obs: &[f32],
        actions: &[f32],
        horizon: usize,
        rng: &mut Rng,
    ) -> (Vec<Vec<f32>>, ImaginedReturns) {
        let count = actions.len() / (horizon * self.dynamics.action_size());
        let particles = self.particles();
        let noise = CommonRandomNumbers::draw(self, horizon, rng);
        let (mut returns, mut disagreement) = (vec![0.0; count * particles], vec![0.0; count]);
        let mut paths = Vec::with_capacity(horizon + 1);
        let obs = self.starts(obs, 0, count);
        self.run(&obs, actions, horizon, &noise, &mut returns, &mut disagreement, &mut |_, states: &[f32]| {
            paths.push(states.to_vec());
        });
        (paths, ImaginedReturns { particles, returns, disagreement })
    }

    /// Candidates that one thread takes on at a time.
    fn share(&self, count: usize) -> usize {
        let rows = match self.propagation {
            Propagation::TsInf | Propagation::Ts1 | Propagation::TsInfMean => {
                count * self.particles() / self.dynamics.members()
            }
            Propagation::Expectation | Propagation::MomentMatching => count * self.particles(),
        };
        let parts = rows.div_ceil(ROWS).next_multiple_of(rayon::current_num_threads());
        count.div_ceil(parts).max(1)
    }

    /// The first observation of each of `count` candidates.
    fn starts(&self, obs: &[f32], first: usize, count: usize) -> Vec<f32> {
        let width = self.dynamics.observation_size();
        if obs.len() == width { obs.repeat(count) } else { obs[first * width..][..count * width].to_vec() }
    }

    /// One thread's share. `visit` sees the states `[particles, candidates, observation]` at each step.
    #[allow(clippy::too_many_arguments)] // what comes in, and where the answers go
    fn run(
        &self,
        obs: &[f32],
        actions: &[f32],
        horizon: usize,
        noise: &CommonRandomNumbers,
        returns: &mut [f32],
        disagreement: &mut [f32],
        visit: &mut impl FnMut(usize, &[f32]),
    ) {
        let particles = self.particles();
        let candidates = disagreement.len();
        let width = self.dynamics.action_size();
        let mut states = obs.repeat(particles);
        let mut next = states.clone();
        let mut now = vec![0.0; particles * candidates * width];
        let mut rewards = vec![0.0; particles * candidates];
        let mut alive = vec![true; particles * candidates];
        let mut scratch = Scratch::default();
        visit(0, &states);
        for t in 0..horizon {
            for (row, now) in now.chunks_exact_mut(width).enumerate() {
                now.copy_from_slice(&actions[(row % candidates * horizon + t) * width..][..width]);
            }
            match self.propagation {
                Propagation::TsInf | Propagation::Ts1 | Propagation::TsInfMean => {
                    self.sample(t == 0, &states, &now, &mut next, &mut rewards, noise.at(t), &mut scratch);
                    self.add_spread_between_members(&next, noise.at(t), disagreement);
                }
                Propagation::Expectation | Propagation::MomentMatching => {
                    self.mix(&states, &now, &mut next, &mut rewards, noise.at(t), disagreement, &mut scratch);
                }
            }
            if let Reward::Known(known) = self.reward {
                known.rewards(&states, &now, &next, &mut rewards);
            }
            for (row, (reward, alive)) in rewards.iter().zip(&mut alive).enumerate() {
                if *alive {
                    returns[row % candidates * particles + row / candidates] += reward;
                    if let Reward::Known(known) = self.reward {
                        *alive = !known.terminated(
                            &next[row * self.dynamics.observation_size()..][..self.dynamics.observation_size()],
                        );
                    }
                }
            }
            std::mem::swap(&mut states, &mut next);
            visit(t + 1, &states);
        }
        if let Some(value) = self.value {
            for (row, state) in states.chunks_exact(self.dynamics.observation_size()).enumerate() {
                if alive[row] {
                    returns[row % candidates * particles + row / candidates] += value(state);
                }
            }
        }
    }

    /// Trajectory sampling: every particle asks the member that it is with. As long as they are all `together`, one asks
    /// for all of them.
    #[allow(clippy::too_many_arguments)]
    fn sample(
        &self,
        together: bool,
        states: &[f32],
        actions: &[f32],
        next: &mut [f32],
        rewards: &mut [f32],
        noise: StepNoise,
        scratch: &mut Scratch,
    ) {
        let (width, outputs) = (self.dynamics.observation_size(), self.dynamics.outputs());
        let predicted = &self.dynamics.layout.predicted;
        let rewarded = self.dynamics.predicts_reward().then_some(predicted.len());
        let particles = noise.order.len();
        let candidates = rewards.len() / particles;
        for (member, particles_of_member) in noise.order.chunks_exact(particles / self.dynamics.members()).enumerate() {
            let asking = if together { &particles_of_member[..1] } else { particles_of_member };
            let rows = asking.iter().flat_map(|p| p * candidates..(p + 1) * candidates);
            let head = self.dynamics.ask(member, rows, states, actions, scratch);
            for (&p, head) in particles_of_member.iter().zip(head.chunks_exact(candidates * 2 * outputs).cycle()) {
                let noise = &noise.noise[p * outputs..][..outputs];
                let rows = p * candidates * width..(p + 1) * candidates * width;
                let rows = states[rows.clone()].chunks_exact(width).zip(next[rows].chunks_exact_mut(width));
                let rewards = &mut rewards[p * candidates..][..candidates];
                for ((head, (state, next)), reward) in head.chunks_exact(2 * outputs).zip(rows).zip(rewards) {
                    let (change, deviation) = head.split_at(outputs);
                    let drawn = change.iter().zip(deviation).zip(noise).map(|((c, d), n)| c + d * n);
                    next.copy_from_slice(state);
                    predicted.iter().zip(drawn).for_each(|(i, drawn)| next[*i] += drawn);
                    self.dynamics.layout.complete(next);
                    if let Some(i) = rewarded {
                        *reward = change[i] + deviation[i] * noise[i];
                    }
                }
            }
        }
    }

    /// The mixture of all members: its mean, or particles from a Gaussian with its mean and variance.
    #[allow(clippy::too_many_arguments)]
    fn mix(
        &self,
        states: &[f32],
        actions: &[f32],
        next: &mut [f32],
        rewards: &mut [f32],
        noise: StepNoise,
        disagreement: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (width, outputs) = (self.dynamics.observation_size(), self.dynamics.outputs());
        let members = self.dynamics.members();
        let rows = rewards.len();
        let (candidates, particles) = (disagreement.len(), rows / disagreement.len());
        let share = 1.0 / members as f32;
        // Sums over members, of means, of their squares, and of variances.
        let [mut means, mut squares, mut variances] = [0; 3].map(|_| vec![0.0; rows * outputs]);
        for member in 0..members {
            let head = self.dynamics.ask(member, 0..rows, states, actions, scratch);
            for (row, head) in head.chunks_exact(2 * outputs).enumerate() {
                let (change, deviation) = head.split_at(outputs);
                for i in 0..outputs {
                    means[row * outputs + i] += share * change[i];
                    squares[row * outputs + i] += share * change[i] * change[i];
                    variances[row * outputs + i] += share * deviation[i] * deviation[i];
                }
            }
        }
        let predicted = &self.dynamics.layout.predicted;
        for row in 0..rows {
            let between = |j: usize| (squares[j] - means[j] * means[j]).max(0.0);
            let drawn = |j: usize| {
                let chance = match self.propagation {
                    Propagation::Expectation => 0.0,
                    _ => (variances[j] + between(j)).sqrt() * noise.noise[row / candidates * outputs + j % outputs],
                };
                means[j] + chance
            };
            let next = &mut next[row * width..][..width];
            next.copy_from_slice(&states[row * width..][..width]);
            let mut spread = 0.0;
            for (j, (i, typical)) in (row * outputs..).zip(self.dynamics.typical_changes()) {
                next[i] += drawn(j);
                spread += between(j) / (typical * typical);
            }
            self.dynamics.layout.complete(next);
            if outputs > predicted.len() {
                rewards[row] = drawn(row * outputs + predicted.len());
            }
            disagreement[row % candidates] += (spread / predicted.len() as f32).sqrt() / particles as f32;
        }
        if self.propagation == Propagation::MomentMatching {
            // A Gaussian for each number of each candidate, and new particles from it.
            let noise = &noise.noise[particles * outputs..];
            for c in 0..candidates {
                for (j, &i) in predicted.iter().enumerate() {
                    let at = |p: usize| (p * candidates + c) * width + i;
                    let mean = (0..particles).map(|p| next[at(p)]).sum::<f32>() / particles as f32;
                    let variance = (0..particles).map(|p| (next[at(p)] - mean).powi(2)).sum::<f32>() / particles as f32;
                    (0..particles).for_each(|p| next[at(p)] = mean + variance.sqrt() * noise[p * outputs + j]);
                }
            }
            next.chunks_exact_mut(width).for_each(|next| self.dynamics.layout.complete(next));
        }
    }

    /// Adds how far the members' particles have come apart.
    fn add_spread_between_members(&self, states: &[f32], noise: StepNoise, disagreement: &mut [f32]) {
        let width = self.dynamics.observation_size();
        let (members, candidates) = (self.dynamics.members(), disagreement.len());
        let particles_of_member = noise.order.len() / members;
        let mut means = vec![0.0; members * width];
        for (c, disagreement) in disagreement.iter_mut().enumerate() {
            means.fill(0.0);
            for (place, p) in noise.order.iter().enumerate() {
                let state = &states[(p * candidates + c) * width..][..width];
                let mean = &mut means[place / particles_of_member * width..][..width];
                mean.iter_mut().zip(state).for_each(|(m, x)| *m += x / particles_of_member as f32);
            }
            let spread: f32 = self
                .dynamics
                .typical_changes()
                .map(|(i, typical)| {
                    let centre = (0..members).map(|m| means[m * width + i]).sum::<f32>() / members as f32;
                    let squares = (0..members).map(|m| (means[m * width + i] - centre).powi(2)).sum::<f32>();
                    squares / members as f32 / (typical * typical)
                })
                .sum();
            *disagreement += (spread / self.dynamics.layout.predicted.len() as f32).sqrt();
        }
    }
}

/// What chance decides, the same for all candidates.
struct CommonRandomNumbers {
    particles: usize,
    /// Standard normal numbers, `[horizon, draws, outputs]`, and how many there are in a step.
    noise: Vec<f32>,
    noise_per_step: usize,
    /// For each step the particles in the order of the members that they are with.
    order: Vec<usize>,
}

/// [`CommonRandomNumbers`] in one step.
#[derive(Clone, Copy)]
struct StepNoise<'a> {
    noise: &'a [f32],
    order: &'a [usize],
}

impl CommonRandomNumbers {
    fn draw(imagination: &Imagination, horizon: usize, rng: &mut Rng) -> Self {
        let Imagination { dynamics, reward, propagation, .. } = *imagination;
        let particles = imagination.particles();
        assert!(!matches!(reward, Reward::Learned) || dynamics.predicts_reward(), "a model that has learned rewards");
        let draws = match propagation {
            Propagation::TsInf | Propagation::Ts1 => {
                assert!(particles.is_multiple_of(dynamics.members()), "as many particles with each member");
                particles
            }
            Propagation::TsInfMean => particles,
            Propagation::Expectation => 0,
            // New particles are drawn from the fitted Gaussian with noise of their own.
            Propagation::MomentMatching => 2 * particles,
        };
        let noise_per_step = draws * dynamics.outputs();
        let noise = if propagation == Propagation::TsInfMean {
            vec![0.0; horizon * noise_per_step]
        } else {
            (0..horizon * noise_per_step).map(|_| rng::normal(rng) as f32).collect()
        };
        let mut order = Vec::with_capacity(horizon * particles);
        for _ in 0..horizon {
            let start = order.len();
            order.extend(0..particles);
            if propagation == Propagation::Ts1 {
                order[start..].shuffle(rng);
            }
        }
        Self { particles, noise, noise_per_step, order }
    }

    fn at(&self, t: usize) -> StepNoise<'_> {
        StepNoise {
            noise: &self.noise[t * self.noise_per_step..][..self.noise_per_step],
            order: &self.order[t * self.particles..][..self.particles],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{FeatureMap, Normaliser};
    use crate::nn::Activation;
    use crate::nn::frozen::FrozenMlp;

    /// Two members of one number and one action: the number drifts by `drift`, up with the first member, down with the
    /// second, plus the action, with a deviation of `deviation`.
    fn disputed(drift: f32, deviation: f32) -> Dynamics {
        let layer = |drift: f32| {
            // Inputs: number, action; outputs: mean, raw log-variance.
            (vec![0.0, 0.0, 1.0, 0.0], vec![drift, 2.0 * deviation.ln()])
        };
        let members = [layer(drift), layer(-drift)];
        let members = members.iter().map(|(weight, bias)| {
            let network = FrozenMlp::new(std::iter::once((&weight[..], &bias[..])), Activation::Silu);
            (network, [&[5.0][..], &[-40.0]])
        });
        let identity = Normaliser::identity;
        let layout = FeatureMap {
            width: 1,
            inputs: vec![0],
            near: vec![],
            predicted: vec![0],
            differences: vec![],
            cubes: vec![],
        };
        Dynamics::new(members, layout, 1, identity(2), identity(1), vec![1.0])
    }

    struct Position;

    impl KnownReward for Position {
        fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
            next_obs[0]
        }

        fn terminated(&self, next_obs: &[f32]) -> bool {
            next_obs[0] > 4.5
        }
    }

    fn imagine(dynamics: &Dynamics, propagation: Propagation, particles: usize) -> Imagination<'_> {
        Imagination { dynamics, reward: Reward::Known(&Position), propagation, particles, value: None }
    }

    fn spread(states: &[f32]) -> (f32, f32) {
        let n = states.len() as f32;
        let mean = states.iter().sum::<f32>() / n;
        (mean, (states.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / n).sqrt())
    }

    /// Disagreement adds up along the way where particles stay with their member, and averages out where they change it.
    #[test]
    fn propagation_decides_what_becomes_of_disagreement() {
        let dynamics = disputed(1.0, 1e-3);
        let run = |propagation, particles| {
            let mut rng = rng::stream(0, "propagation");
            let (paths, futures) =
                imagine(&dynamics, propagation, particles).trajectories(&[0.0], &[0.0; 16], 16, &mut rng);
            (spread(&paths[16]), futures.disagreement[0])
        };
        let ((mean, deviation), apart) = run(Propagation::TsInf, 400);
        assert!(mean.abs() < 0.01 && (deviation - 16.0).abs() < 0.01, "{mean} {deviation}");
        assert!((apart - 136.0).abs() < 0.1, "1 + 2 + ... + 16: {apart}");
        for propagation in [Propagation::Ts1, Propagation::MomentMatching] {
            let ((mean, deviation), _) = run(propagation, 400);
            assert!(mean.abs() < 2.5 && (deviation - 4.0).abs() < 0.8, "{propagation:?}: {mean} {deviation}");
        }
        let ((mean, deviation), apart) = run(Propagation::Expectation, 400);
        assert!(mean.abs() < 1e-5 && deviation == 0.0 && (apart - 16.0).abs() < 1e-3, "{mean} {deviation} {apart}");
    }

    #[test]
    fn chance_grows_with_the_root_of_time() {
        let dynamics = disputed(0.0, 0.5);
        for propagation in [Propagation::TsInf, Propagation::Ts1, Propagation::MomentMatching] {
            let mut rng = rng::stream(1, "chance");
            let (paths, _) = imagine(&dynamics, propagation, 1000).trajectories(&[0.0], &[0.0; 9], 9, &mut rng);
            let (_, deviation) = spread(&paths[9]);
            assert!((deviation - 1.5).abs() < 0.15, "{propagation:?}: {deviation}");
        }
    }

    /// 1 + 2 + 3 + 4, and at 5 the end: its own reward still counts, nothing after it.
    #[test]
    fn nothing_is_earned_after_the_end() {
        let dynamics = disputed(0.0, 1e-8);
        let four = |_: &[f32]| 100.0;
        let mut imagination = imagine(&dynamics, Propagation::TsInf, 2);
        imagination.value = Some(&four);
        let futures =
            imagination.imagined_returns(&[0.0], &[vec![1.0; 8], vec![0.5; 8]].concat(), 8, &mut rng::stream(2, "end"));
        let near = |found: f32, expected: f32| assert!((found - expected).abs() < 1e-3, "{found}, expected {expected}");
        near(futures.returns[0], 15.0);
        near(futures.returns[2], 18.0 + 100.0);
    }

    /// The same bits from one thread and from several, and for a candidate alone and among others.
    #[test]
    fn futures_depend_on_the_seed_alone() {
        let dynamics = disputed(0.3, 0.2);
        let actions: Vec<f32> = (0..300).map(|i| (i as f32 * 0.7).sin()).collect();
        for propagation in [
            Propagation::TsInf,
            Propagation::Ts1,
            Propagation::TsInfMean,
            Propagation::Expectation,
            Propagation::MomentMatching,
        ] {
            let run = |threads: usize, actions: &[f32]| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
                let imagination = imagine(&dynamics, propagation, 4);
                pool.install(|| imagination.imagined_returns(&[0.1], actions, 5, &mut rng::stream(3, "threads")))
            };
            let one = run(1, &actions);
            assert_eq!(one, run(3, &actions), "{propagation:?}");
            let first = run(1, &actions[..5]);
            assert_eq!(first.returns[..], one.returns[..first.returns.len()], "{propagation:?}");
        }
    }
}
