use super::*;
use crate::env::{Env, Task};
use crate::model::{RssmConfig, WorldModelConfig};
use crate::nn::{Parameters, values};

fn small() -> DreamerConfig {
    let rssm = RssmConfig { deter: 16, blocks: 2, hidden: 8, stoch: 4, classes: 4, ..RssmConfig::default() };
    DreamerConfig {
        world: WorldModelConfig { rssm, units: 16, layers: 1, ..WorldModelConfig::default() },
        behaviour: ActorCriticConfig { units: 16, layers: 1, horizon: 5, ..ActorCriticConfig::default() },
        learning_warm_up: 0,
        batch: 2,
        length: 4,
        train_ratio: 8.0,
        warm_up: 10,
        ..DreamerConfig::default()
    }
}

/// An agent after so many time steps, without updates.
fn experienced(config: DreamerConfig, steps: usize) -> Dreamer {
    let env = Task::Pendulum.make();
    let mut agent = Dreamer::new(env.spec(), config, 0).expect("usable settings");
    (0..steps).for_each(|step| agent.observe(&transition(step)));
    agent
}

fn transition(step: usize) -> Transition {
    let obs = |step: usize| vec![(step as f32).cos(), (step as f32).sin(), 0.1];
    Transition {
        obs: obs(step),
        action: vec![0.5],
        reward: (step as f32).cos(),
        next_obs: obs(step + 1),
        terminated: false,
        truncated: false,
    }
}

/// At one update a step: without the debt, the first is made when the warm-up ends.
#[test]
fn the_warm_up_owes_updates_if_it_should() {
    for (warm_up_updates, expected) in [(false, [0.0, 1.0, 2.0]), (true, [0.0, 10.0, 11.0])] {
        let mut agent = experienced(DreamerConfig { warm_up_updates, ..small() }, 0);
        let mut found = Vec::new();
        for step in 0..11 {
            agent.observe(&transition(step));
            agent.update();
            if step >= 8 {
                found.push(agent.training_state().get("optimiser.steps", [1, 1, 1]).expect("a count")[0]);
            }
        }
        assert_eq!(found, expected);
    }
}

/// A critic that is off by a constant changes nothing.
#[test]
fn centred_advantages_do_not_depend_on_the_level_of_values() {
    for center_advantages in [false, true] {
        let mut config = small();
        config.behaviour.center_advantages = center_advantages;
        let agent = experienced(config, 10);
        let Networks { world, behaviour, target } = &agent.networks;
        let mut rollout = behaviour.imagine(world, &world.initial(6), &mut rng::stream(0, "rollout"));
        let mut losses = || {
            let loss = behaviour.loss(&mut dfdx::tensor::NoneTape, world, target, &rollout, 1.0);
            rollout.values.iter_mut().flatten().for_each(|value| *value += 3.0);
            loss.policy.iter().flat_map(|policy| values(policy).to_vec()).collect::<Vec<f32>>()
        };
        let (before, after) = (losses(), losses());
        let change = before.iter().zip(&after).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert_eq!(change < 1e-4, center_advantages, "{change}");
    }
}

/// A new policy has 1.3 nats for each number of an action.
#[test]
fn too_much_entropy_lowers_its_bonus_and_too_little_raises_it() {
    for (target_entropy, rises) in [(0.5, false), (1.4, true)] {
        let mut config = small();
        config.behaviour.target_entropy = Some(target_entropy);
        let before = config.behaviour.entropy;
        let mut agent = experienced(config, 50);
        let learned: Vec<f32> = (0..3).map(|_| agent.learn()["temperature"]).collect();
        assert!(learned.iter().all(|after| *after != before && (*after > before) == rises), "{before} {learned:?}");
        assert_eq!(agent.networks.behaviour.entropy, learned[2]);
    }
}

/// How the actor learns is its own affair: the world model learns the same, and so does the critic.
#[test]
fn gradients_through_the_dynamics_stay_in_the_actor() {
    let after = |gradient| {
        let mut config = small();
        config.behaviour.gradient = gradient;
        let mut agent = experienced(config, 50);
        // New heads predict zeros, from which neither gradient follows.
        let mut rng = rng::stream(0, "heads");
        for (_, parameter) in agent.networks.parameters_mut() {
            let moved: Vec<f32> = values(parameter).iter().map(|w| w + 0.1 * rng::normal(&mut rng) as f32).collect();
            parameter.copy_from(&moved);
        }
        let losses = agent.learn();
        assert!(losses["policy_loss"].is_finite());
        let weights = |module: &dyn Parameters| -> Vec<f32> {
            module.parameters().iter().flat_map(|(_, parameter)| values(parameter).to_vec()).collect()
        };
        let Networks { world, behaviour, .. } = &agent.networks;
        [weights(world), weights(&behaviour.critic), weights(&behaviour.policy)]
    };
    let [world, critic, policy] = after(ActorGradient::Reinforce);
    let [same_world, same_critic, other_policy] = after(ActorGradient::Dynamics);
    assert_eq!(world, same_world, "the world model");
    assert_eq!(critic, same_critic, "the critic");
    assert_ne!(policy, other_policy, "the actor");
}
