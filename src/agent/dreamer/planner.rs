//! Planning in the latent world, as PlaNet does (Hafner et al. 2019): the same model that the policy was dreamed up in,
//! asked about action sequences instead.

use super::actor_critic::ActorCritic;
use crate::model::{Latent, WorldModel};
use crate::nn::tensor;
use crate::plan::{ActionSequences, Objective};
use crate::rng::Rng;

/// What action sequences are worth from what is believed now: the rewards on the way and the critic's value of the end,
/// both discounted. (PlaNet has no critic, and looks no farther than the plan.)
pub struct LatentObjective<'a> {
    /// The world.
    pub world: &'a WorldModel,
    /// Whose critic values the end.
    pub critic: &'a ActorCritic,
    /// What is believed now, one row.
    pub belief: &'a Latent,
    /// Draws the states; the same for all candidates of a question would be too much of a coincidence.
    pub rng: Rng,
}

impl Objective for LatentObjective<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        let (count, width) = (sequences.count(), sequences.actions);
        let mut latent = self.belief.repeated(0, count);
        let mut returns = vec![0.0; count];
        let mut lasting = vec![1.0; count];
        for t in 0..sequences.horizon {
            let actions = (0..count).flat_map(|i| &sequences.row(i)[t * width..][..width]);
            let actions = actions.map(|a| a.clamp(-1.0, 1.0)).collect();
            let actions = tensor(self.world.device(), actions, (1, count, width));
            latent = self.world.imagine(&latent, &actions, &mut self.rng);
            let features = latent.features();
            let told = self.world.rewards(&features).into_iter().zip(self.world.continues(&features));
            for ((total, lasting), (reward, goes_on)) in returns.iter_mut().zip(&mut lasting).zip(told) {
                *total += *lasting * reward;
                *lasting *= goes_on;
            }
        }
        let end = self.critic.values(self.world, &latent.features());
        returns.iter_mut().zip(lasting.iter().zip(end)).for_each(|(total, (lasting, value))| *total += lasting * value);
        returns
    }
}
