use super::*;
use crate::agent::{Agent, Mode};
use crate::env::Feature;

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
