//! `reach`: bring the hand to a point in the air.
//!
//! Goal uniform in a box 0.3 x 0.4 x 0.3 m above the table; success within 2 cm of it.

use nalgebra::Vector3;

use super::helpers::{
    action_towards, difference_features, log_reaching_reward, named_values, reaching_reward, vector_at, xyz_features,
};
use super::task::{HAND_VELOCITY, Setup, TableTask, TaskOutcome, TaskView};
use crate::env::Feature;
use crate::env::physics::Physics;
use crate::env::scene::Body;
use crate::rng::{Rng, uniform};

/// Distance that counts as there, m.
const TOLERANCE: f64 = 0.02;
const GOAL: usize = HAND_VELOCITY.end;
const HAND_TO_GOAL: usize = GOAL + 3;

/// Bring the hand to a goal in the air, uniform in a box of 0.3 x 0.4 x 0.3 m above the table; success is the hand within
/// 2 cm of it.
#[derive(Clone, Copy, Debug)]
pub struct Reach;

impl TableTask for Reach {
    fn name(&self) -> &str {
        "reach"
    }

    fn horizon(&self) -> usize {
        100
    }

    fn stages(&self) -> Vec<String> {
        ["within 5 cm", "reached"].map(String::from).into()
    }

    fn place(&self, _physics: &mut Physics, rng: &mut Rng) -> Setup {
        let goal = Vector3::new(uniform(rng, -0.15, 0.15), uniform(rng, -0.2, 0.2), uniform(rng, 0.85, 1.15));
        Setup { objects: vec![], goal: Some(goal) }
    }

    fn features(&self) -> Vec<Feature> {
        xyz_features("goal", [0.0, 0.0, 1.0], 0.15)
            .map(Feature::constant)
            .chain(difference_features("hand", "goal"))
            .collect()
    }

    fn observe(&self, view: &TaskView) -> Vec<f64> {
        let goal = view.setup.goal.expect("reach has a goal");
        let way = goal - view.hand.translation.vector;
        goal.iter().chain(&way).copied().collect()
    }

    fn object_state(&self, view: &TaskView) -> Option<Vec<(String, f64)>> {
        let goal = view.setup.goal.expect("reach has a goal");
        let way = goal - view.hand.translation.vector;
        Some([named_values("goal_pos", goal.iter()), named_values("gripper_to_goal", way.iter())].concat())
    }

    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        let distance = vector_at(obs, HAND_TO_GOAL).norm();
        TaskOutcome {
            shaped: reaching_reward(distance),
            success: distance < TOLERANCE,
            stage: usize::from(distance < 0.05) + usize::from(distance < TOLERANCE),
        }
    }

    fn log_shaped(&self, obs: &[f32]) -> f64 {
        log_reaching_reward(vector_at(obs, HAND_TO_GOAL).norm())
    }

    fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> {
        Some(action_towards(vector_at(obs, HAND_TO_GOAL), 0.0))
    }

    fn drawn(&self, _setup: &Setup) -> Vec<Body> {
        vec![Body::goal(TOLERANCE)]
    }
}
