use super::*;
use crate::agent::{Agent, Mode};
use crate::env::Feature;
use crate::replay::Transition;

/// The correlation of an agent's successive actions at one observation, in 40 episodes of 50 steps.
fn correlation(config: SacConfig) -> f64 {
    let spec = Spec::new("still", [Feature::new("x")], 1, 50, 0.1);
    let mut agent = Sac::new(&spec, SacConfig { hidden: vec![8], ..config }, 0).expect("usable settings");
    let mut episode = |_| {
        agent.begin_episode();
        (0..50).map(|_| f64::from(agent.act(&[0.0], Mode::Explore)[0])).collect()
    };
    let episodes: Vec<Vec<f64>> = (0..40).map(&mut episode).collect();
    let mean = episodes.concat().iter().sum::<f64>() / 2000.0;
    let products =
        episodes.iter().flat_map(|actions| actions.windows(2).map(|pair| (pair[0] - mean) * (pair[1] - mean)));
    let variance = episodes.concat().iter().map(|a| (a - mean).powi(2)).sum::<f64>() / 2000.0;
    products.sum::<f64>() / (40.0 * 49.0) / variance
}

/// A random policy hardly moves an arm: its actions cancel. Coloured noise moves it, during the warm-up and after it.
#[test]
fn coloured_actions_persist() {
    let warm_up = |warm_up_noise_beta| SacConfig { warm_up_noise_beta, ..SacConfig::default() };
    let explore = |exploration_noise_beta| SacConfig { warm_up: 0, exploration_noise_beta, ..SacConfig::default() };
    for (what, white, pink) in
        [("warm-up", warm_up(None), warm_up(Some(1.0))), ("exploration", explore(None), explore(Some(1.0)))]
    {
        let [white, pink] = [white, pink].map(correlation);
        assert!(white.abs() < 0.1 && pink > 0.4, "{what}: {white:.2} white, {pink:.2} pink");
    }
}

/// A strong group lasso, and a single update.
#[test]
fn a_group_lasso_leaves_differences_and_actions() {
    let features = [Feature::new("x"), Feature::new("goal").constant(), Feature::new("way").difference("goal", "x")];
    let spec = Spec::new("line", features, 1, 50, 0.1);
    let config = SacConfig { hidden: vec![8], latent_features: true, lasso: 1e3, ..SacConfig::default() };
    let mut agent = Sac::new(&spec, SacConfig { learning_rate: 0.1, ..config }, 0).expect("usable settings");
    agent.replay.push(&Transition {
        obs: vec![0.0, 0.5, 0.5],
        action: vec![0.1],
        reward: 0.0,
        next_obs: vec![0.1, 0.5, 0.4],
        terminated: false,
        truncated: false,
    });
    agent.learn();
    let zero = |network: &Mlp, input: usize| {
        let (weight, bias) = network.layers_of(0).next().expect("a layer");
        weight[input * bias.len()..][..bias.len()].iter().all(|w| *w == 0.0)
    };
    // The inputs: x and way; way, magnified; for the critics, the action.
    assert_eq!([0, 1, 2].map(|input| zero(&agent.policy, input)), [true, false, false]);
    assert_eq!([0, 1, 2, 3].map(|input| zero(&agent.critics, input)), [true, false, false, false]);
    assert!(Sac::new(&spec, SacConfig { lasso: 1.0, ..SacConfig::default() }, 0).is_err(), "it needs latent features");
}
