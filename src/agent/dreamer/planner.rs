//! Planning in the latent space of the world model, as PlaNet does (Hafner et al. 2019, Algorithm 2): a planner evaluates
//! action sequences by imagining them, instead of asking the policy.

use super::actor_critic::ActorCritic;
use crate::model::{Latent, WorldModel};
use crate::nn::tensor;
use crate::plan::{ActionSequences, Objective};
use crate::rng::Rng;

/// The imagined return of action sequences from one latent state: predicted rewards, discounted, and the critic's value of
/// the last state. (PlaNet has no critic, and its returns end with the plan.)
#[derive(Debug)]
pub struct LatentObjective<'a> {
    /// The world model that sequences are imagined in.
    pub world: &'a WorldModel,
    /// Its critic values the last state.
    pub critic: &'a ActorCritic,
    /// The latent state to plan from, one row.
    pub latent: &'a Latent,
    /// Draws the stochastic states, each candidate's its own: no common random numbers.
    pub rng: Rng,
}

impl Objective for LatentObjective<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        let (count, width) = (sequences.count(), sequences.actions);
        let mut latent = self.latent.repeated(0, count);
        let mut returns = vec![0.0; count];
        let mut discounts = vec![1.0; count];
        for t in 0..sequences.horizon {
            let actions = (0..count).flat_map(|i| &sequences.row(i)[t * width..][..width]);
            let actions = actions.map(|a| a.clamp(-1.0, 1.0)).collect();
            let actions = tensor(self.world.device(), actions, (1, count, width));
            latent = self.world.imagine(&latent, &actions, &mut self.rng);
            let features = latent.features();
            let (rewards, continuations) = (self.world.rewards(&features), self.world.continuations(&features));
            for i in 0..count {
                returns[i] += discounts[i] * rewards[i];
                discounts[i] *= continuations[i];
            }
        }
        let values = self.critic.values(self.world, &latent.features());
        for i in 0..count {
            returns[i] += discounts[i] * values[i];
        }
        returns
    }
}
