//! `push`: push the cube across the table to a goal, with closed fingers.
//!
//! Cube and goal uniform in a square of 0.3 m, at least 0.1 m apart; success within 5 cm.

use nalgebra::Vector3;

use super::helpers::{
    action_towards, cube_features, difference_features, log_reaching_reward, named_values, object_values,
    pose_on_table, reaching_reward, robosuite_object_state, vector_at, xyz_features,
};
use super::task::{HAND_VELOCITY, Setup, TableTask, TaskOutcome, TaskView};
use crate::env::Feature;
use crate::env::arm::Primitive;
use crate::env::physics::{Physics, TABLE_TOP};
use crate::env::scene::Body;
use crate::rng::{Rng, uniform};

const HALF: f64 = 0.02;
/// Half width of the square of cubes and goals, m.
const REACH: f64 = 0.15;
/// Distance that counts as there, m.
const TOLERANCE: f64 = 0.05;
/// Friction between cube and table: lower than robosuite's 1, at which a light cube sticks.
const FRICTION: f64 = 0.5;

const CUBE: usize = HAND_VELOCITY.end;
const HAND_TO_CUBE: usize = CUBE + 12;
const GOAL: usize = HAND_TO_CUBE + 3;
const CUBE_TO_GOAL: usize = GOAL + 3;

/// Push the cube to a goal on the table with closed fingers. Cube and goal are uniform in a square of 0.3 m, at least 0.1 m
/// apart; success is the cube within 5 cm of the goal.
#[derive(Clone, Copy, Debug)]
pub struct Push;

impl TableTask for Push {
    fn name(&self) -> &str {
        "push"
    }

    fn horizon(&self) -> usize {
        150
    }

    fn stages(&self) -> Vec<String> {
        ["reached", "pushed"].map(String::from).into()
    }

    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup {
        physics.set_table_friction(FRICTION);
        let pose = pose_on_table(rng, REACH, HALF, 0.0);
        let cube = pose.translation.vector;
        let goal = loop {
            let goal = Vector3::new(uniform(rng, -REACH, REACH), uniform(rng, -REACH, REACH), cube.z);
            if (goal - cube).norm() >= 0.1 {
                break goal;
            }
        };
        Setup { objects: vec![physics.add_box([HALF; 3], 1000.0, FRICTION, &pose)], goal: Some(goal) }
    }

    fn features(&self) -> Vec<Feature> {
        let table = TABLE_TOP as f32;
        cube_features("cube")
            .chain(difference_features("hand", "cube"))
            .chain(xyz_features("goal", [0.0, 0.0, table], 0.1).map(Feature::constant))
            .chain(difference_features("cube", "goal"))
            .collect()
    }

    fn observe(&self, view: &TaskView) -> Vec<f64> {
        let mut values = object_values(view, 0);
        let cube = Vector3::new(values[0], values[1], values[2]);
        let goal = view.setup.goal.expect("push has a goal");
        for part in [cube - view.hand.translation.vector, goal, goal - cube] {
            values.extend(part.iter());
        }
        values
    }

    fn object_state(&self, view: &TaskView) -> Option<Vec<(String, f64)>> {
        let goal = view.setup.goal.expect("push has a goal");
        let cube = view.physics.object_state(view.setup.objects[0]).pose.translation.vector;
        let mut values = robosuite_object_state(view, 0, "cube", "gripper_to_cube_pos");
        values.extend(named_values("goal_pos", goal.iter()));
        values.extend(named_values("cube_to_goal", (goal - cube).iter()));
        Some(values)
    }

    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        let hand_to_cube = vector_at(obs, HAND_TO_CUBE).norm();
        let cube_to_goal = vector_at(obs, CUBE_TO_GOAL).norm();
        let success = cube_to_goal < TOLERANCE;
        let shaped =
            if success { 1.0 } else { 0.25 * reaching_reward(hand_to_cube) + 0.75 * reaching_reward(cube_to_goal) };
        TaskOutcome { shaped, success, stage: if success { 2 } else { usize::from(hand_to_cube < 0.05) } }
    }

    fn log_shaped(&self, obs: &[f32]) -> f64 {
        let hand_to_cube = vector_at(obs, HAND_TO_CUBE).norm();
        let cube_to_goal = vector_at(obs, CUBE_TO_GOAL).norm();
        if cube_to_goal < TOLERANCE {
            // As good as it gets: otherwise plans would go on centring the cube, and now and then knock it out again.
            return 0.0;
        }
        0.25 * log_reaching_reward(hand_to_cube) + 0.75 * log_reaching_reward(cube_to_goal)
    }

    /// Behind the cube as seen from the goal, down, and through it towards the goal.
    fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> {
        let to_cube = vector_at(obs, HAND_TO_CUBE);
        let to_goal = vector_at(obs, CUBE_TO_GOAL).xy();
        if to_goal.norm() < 0.015 {
            return Some(action_towards(Vector3::zeros(), 0.0));
        }
        let ahead = to_goal.normalize();
        let behind = to_cube - Vector3::new(ahead.x, ahead.y, 0.0) * 0.06;
        let height = to_cube.z + 0.002;
        // How far the hand is beside the line of push, and how far behind the cube.
        let back = to_cube.xy().dot(&ahead);
        let aside = (to_cube.xy() - ahead * back).norm();
        let low = height > -0.03;
        Some(if low && back > 0.01 && aside < 0.012 {
            let step = to_cube.xy() - ahead * back + ahead * to_goal.norm().min(0.05);
            action_towards(Vector3::new(step.x, step.y, height), 0.0)
        } else if behind.xy().norm() > 0.012 {
            // Travel above the cube's height.
            let clear = if behind.xy().norm() < 0.03 { height } else { height + 0.07 };
            action_towards(Vector3::new(behind.x, behind.y, clear), 0.0)
        } else {
            action_towards(Vector3::new(behind.x, behind.y, height), 0.0)
        })
    }

    fn drawn(&self, _setup: &Setup) -> Vec<Body> {
        vec![Body::solid("cube", "#3c6fd8", vec![Primitive::cuboid([HALF; 3], [0.0; 3])]), Body::goal(0.02)]
    }
}
