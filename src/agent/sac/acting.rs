//! What SAC does in its environment: it explores, acts as well as it can, and records what comes of it.

use super::Sac;
use crate::agent::decision::{Held, Over};
use crate::agent::warm_up::RandomActions;
use crate::agent::{Agent, Losses, Mode, Slot};
use crate::nn::{Grad, SquashedGaussian, tensor, values};
use crate::replay::Transition;
use crate::rng;

impl Agent for Sac {
    fn begin_episode(&mut self) {
        self.replay.cut_off();
        self.forget_episode();
        self.slots.clear(0);
    }

    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        let repeat = self.config.action_repeat;
        match mode {
            Mode::Explore => {
                if self.held.is_due() {
                    let action = self.explore(obs);
                    self.held.begin(action, repeat);
                }
                self.held.advance()
            }
            Mode::Evaluate => {
                let action = self.deterministic_actions(obs).remove(0);
                self.slots.state(0, |_| Held::default()).next(repeat, || action)
            }
        }
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let observations: Vec<&[f32]> = slots.iter().map(|slot| slot.obs).collect();
        let actions = self.deterministic_actions(&observations.concat());
        let held = self.slots.states(slots, |_| Held::default());
        held.into_iter().zip(actions).map(|(held, action)| held.next(self.config.action_repeat, || action)).collect()
    }

    fn observe(&mut self, transition: &Transition) {
        match self.decision.join(transition, self.config.action_repeat) {
            Some(Over::Whole(decision)) => self.replay.push(&decision),
            // It tells nothing about a whole decision.
            Some(Over::Short(_)) => self.replay.cut_off(),
            None => {}
        }
        self.observed += 1;
        if transition.terminated || transition.truncated {
            self.forget_episode();
        }
    }

    fn update(&mut self) -> Option<Losses> {
        if self.observed < self.config.warm_up || self.replay.is_empty() {
            return None;
        }
        // Inside the thread pool: a parallel section entered from outside hands its work over each time.
        rayon::scope(|_| (0..self.config.updates_per_step).map(|_| self.learn()).last())
    }
}

impl Sac {
    /// The deterministic action tanh(mean) for each row of observations.
    pub(super) fn deterministic_actions(&self, observations: &[f32]) -> Vec<Vec<f32>> {
        let head = self.policy.forward(self.observations(observations), Grad::Input);
        let actions = SquashedGaussian::from_head(head).mode();
        values(&actions).chunks(self.action_size).map(<[f32]>::to_vec).collect()
    }

    /// A random action during the warm-up, one of the policy after it.
    fn explore(&mut self, obs: &[f32]) -> Vec<f32> {
        if self.observed < self.config.warm_up {
            return match &mut self.warm_up_noise {
                Some(noise) => noise.next(&mut self.rng),
                None => (0..self.action_size).map(|_| rng::uniform(&mut self.rng, -1.0, 1.0) as f32).collect(),
            };
        }
        let head = self.policy.forward(self.observations(obs), Grad::Input);
        let noise = match &mut self.exploration_noise {
            Some(noise) => tensor(&self.cpu, noise.deviates(&mut self.rng), (1, 1, self.action_size)),
            None => self.noise(1),
        };
        values(&SquashedGaussian::from_head(head).sample(noise).0).to_vec()
    }

    pub(super) fn forget_episode(&mut self) {
        self.held.reset();
        self.decision.reset();
        [&mut self.warm_up_noise, &mut self.exploration_noise].into_iter().flatten().for_each(RandomActions::reset);
    }
}
