//! How good the model of PETS is, and how far the predictions of its plans come true.

use rayon::prelude::*;

use super::controller::Controller;
use super::objective::PlanningModel;
use super::{DynReward, Pets};
use crate::agent::decision::in_decisions;
use crate::agent::{Diagnostics, ValueEstimate};
use crate::model::Imagination;
use crate::model::open_loop::{OpenLoop, Propagated, WithActionRepeat, open_loop};
use crate::model::uncertainty::Risk;
use crate::replay::Episode;
use crate::rng;

/// Episodes whose plans are made once more.
const REPLANNED: usize = 4;

impl Diagnostics for Pets {
    fn updates(&self) -> u64 {
        self.ensemble.updates()
    }

    fn open_loop(&self, episodes: &[Episode]) -> Vec<OpenLoop> {
        let Some(dynamics) = &self.dynamics else { return Vec::new() };
        let model = Propagated { dynamics, propagation: self.config.propagation };
        let model = WithActionRepeat { model, action_repeat: self.config.action_repeat };
        open_loop(&model, &self.spec, episodes, &mut rng::stream(0, "open loop"))
    }

    /// What the plans of the first four episodes predict for their horizon, and what followed; the plans are made once more, as
    /// they were if these are the first episodes of an evaluation. Rewards are those that it plans with, undiscounted; a terminal
    /// value is left out.
    fn value_estimates(&self, episodes: &[Episode]) -> Vec<ValueEstimate> {
        let Self { config, dynamics: Some(dynamics), reward, controllers, .. } = self else { return Vec::new() };
        let model = PlanningModel::new(config, dynamics, reward.as_deref());
        let controllers: Vec<Controller> = (0..REPLANNED).map(|i| controllers.of_slot(i)).collect();
        let each = controllers.into_par_iter().zip(episodes);
        each.flat_map_iter(|(controller, episode)| predictions(controller, &model, episode)).collect()
    }
}

/// The prediction of each plan in an episode whose horizon ends before the time limit, and what followed.
fn predictions(mut controller: Controller, model: &PlanningModel, episode: &Episode) -> Vec<ValueEstimate> {
    let episode = &in_decisions(episode, model.config.action_repeat);
    let mut estimates = Vec::new();
    for (t, obs) in episode.observations.iter().take(episode.actions.len()).enumerate() {
        controller.decide(model, obs, 0.0, &mut |_| {});
        let plan = controller.last_plan();
        let horizon = plan.len() / episode.actions[t].len();
        let end = (t + horizon).min(episode.actions.len());
        if horizon == 0 || (end < t + horizon && !episode.terminated) {
            // An action that was planned before, or a plan beyond the time limit.
            continue;
        }
        let imagination = Imagination { value: None, ..model.imagination() };
        let imagined = imagination.imagined_returns(obs, plan, horizon, &mut rng::stream(t as u64, "pets predictions"));
        let realised = (t..end).map(|t| reward_at(model.reward, episode, t)).sum();
        estimates.push(ValueEstimate { expected: Risk::Neutral.of(&imagined.returns), realised });
    }
    estimates
}

/// The reward of a recorded decision, as plans count it.
fn reward_at(known: Option<&DynReward>, episode: &Episode, t: usize) -> f32 {
    let received = episode.rewards[t];
    known.map_or(received, |known| {
        known.reward(&episode.observations[t], &episode.actions[t], &episode.observations[t + 1])
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::agent::{Agent, Mode, PetsConfig};
    use crate::env::{Env, KnownReward, Task};
    use crate::model::EnsembleConfig;
    use crate::plan::{IcemConfig, PlannerConfig};
    use crate::replay::Transition;

    /// A plan's prediction is compared with the rewards of as many recorded decisions as it has. Plans that reach beyond the
    /// episode are left out.
    #[test]
    fn predictions_are_compared_with_what_followed() {
        for action_repeat in [1, 3] {
            compare_predictions(action_repeat);
        }
    }

    fn compare_predictions(action_repeat: usize) {
        const HORIZON: usize = 6;
        const STEPS: usize = 81;
        let icem = IcemConfig { horizon: HORIZON, population: 8, elites: 3, iterations: 1, ..IcemConfig::default() };
        let ensemble =
            EnsembleConfig { members: 2, elites: 2, hidden: vec![8], first_steps: 20, ..EnsembleConfig::default() };
        let config = PetsConfig {
            ensemble,
            planner: PlannerConfig::Icem(icem),
            action_repeat,
            particles: 2,
            warm_up: 60,
            ..PetsConfig::default()
        };
        let mut env = Task::Pendulum.make();
        let mut agent =
            Pets::new(env.spec(), Some(Arc::new(Task::Pendulum.make())), config, 0).expect("usable settings");
        let mut episode = Episode { observations: vec![env.reset(0)], ..Episode::default() };
        assert!(agent.value_estimates(std::slice::from_ref(&episode)).is_empty(), "there is no model yet");
        for t in 0..STEPS {
            let obs = episode.observations[t].clone();
            let action = agent.act(&obs, Mode::Explore);
            let step = env.step(&action).expect("an action");
            let next_obs = step.observation.clone();
            let transition = Transition {
                obs,
                action: action.clone(),
                reward: step.reward,
                next_obs,
                terminated: false,
                truncated: false,
            };
            agent.observe(&transition);
            agent.update();
            episode.observations.push(step.observation);
            episode.actions.push(action);
            episode.rewards.push(step.reward);
        }
        let estimates = agent.value_estimates(std::slice::from_ref(&episode));
        assert_eq!(estimates.len(), STEPS / action_repeat - HORIZON + 1);
        // The known reward of a decision: as if it were one time step.
        let of_decision = |i: usize| {
            let (before, after) = (i * action_repeat, (i + 1) * action_repeat);
            env.reward(&episode.observations[before], &episode.actions[before], &episode.observations[after])
        };
        for (t, estimate) in estimates.iter().enumerate() {
            let received: f32 = (t..t + HORIZON).map(of_decision).sum();
            assert!((estimate.realised - received).abs() < 1e-3, "{t}: {} and {received}", estimate.realised);
            // Six rewards of the pendulum lie between -100 and 0; a model of 20 decisions may predict speeds beyond the limit.
            let least = if action_repeat == 1 { -120.0 } else { -300.0 };
            assert!((least..=1.0).contains(&estimate.expected), "{t}: {}", estimate.expected);
        }
    }
}
