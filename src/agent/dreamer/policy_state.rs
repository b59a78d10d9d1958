//! What Dreamer remembers of an environment from one time step to the next.

use super::DreamerConfig;
use super::planner::LatentObjective;
use super::update::Networks;
use crate::agent::decision::Held;
use crate::model::{Latent, WorldModel};
use crate::nn::tensor;
use crate::plan::RecedingHorizon;
use crate::rng::{self, Rng};

/// The latent state of one environment, the last action taken there, which may be held, and the plan that is followed, if there is
/// a planner.
pub(super) struct PolicyState {
    pub latent: Latent,
    pub action: Vec<f32>,
    /// The action that is held.
    pub held: Held,
    action_repeat: usize,
    control: Option<RecedingHorizon>,
    pub rng: Rng,
}

impl PolicyState {
    /// The state of a slot, which depends on nothing but the slot's index.
    pub fn of_slot(world: &WorldModel, config: &DreamerConfig, action_size: usize, index: usize) -> Self {
        Self::new(world, config, action_size, rng::stream(index as u64, "dreamer seat"))
    }

    pub fn new(world: &WorldModel, config: &DreamerConfig, actions: usize, rng: Rng) -> Self {
        let control = config
            .planner
            .as_ref()
            .map(|planner| RecedingHorizon::new(planner.build(actions), actions, &config.control));
        Self {
            latent: world.initial(1),
            action: vec![0.0; actions],
            held: Held::default(),
            action_repeat: config.action_repeat,
            control,
            rng,
        }
    }

    /// To the state at the start of an episode.
    pub fn reset(&mut self, world: &WorldModel) {
        self.latent = world.initial(1);
        self.action.fill(0.0);
        self.held.reset();
        if let Some(control) = &mut self.control {
            control.reset();
        }
    }

    /// Updates the latent state by an observation.
    pub fn observe(&mut self, world: &WorldModel, obs: &[f32]) {
        let before = tensor(world.device(), self.action.clone(), (1, 1, self.action.len()));
        self.latent = world.observe(&self.latent, &before, obs, &mut self.rng);
    }

    /// The next action: a new decision when the last one has been held for long enough. It is the planner's if there is one, else
    /// the policy's mean plus `noise` times its standard deviation; without noise, the mean.
    pub fn act(&mut self, networks: &Networks, obs: &[f32], noise: impl FnOnce() -> Option<Vec<f32>>) -> Vec<f32> {
        if self.held.is_due() {
            let action = self.decide(networks, obs, noise().as_deref());
            self.held.begin(action, self.action_repeat);
        }
        self.held.advance()
    }

    fn decide(&mut self, networks: &Networks, obs: &[f32], noise: Option<&[f32]>) -> Vec<f32> {
        let Networks { world, behaviour, .. } = networks;
        self.observe(world, obs);
        let action = match &mut self.control {
            Some(control) => {
                let rng = rng::fork(&mut self.rng);
                let mut objective = LatentObjective { world, critic: behaviour, latent: &self.latent, rng };
                control.act(&mut objective, &mut |_| {}, &mut self.rng)
            }
            None => behaviour.act(&self.latent.features(), noise),
        };
        self.action = action.iter().map(|a| a.clamp(-1.0, 1.0)).collect();
        self.action.clone()
    }
}
