//! `lift`: grasp the cube and lift it. robosuite's Lift, with its numbers.

use nalgebra::Vector3;

use super::helpers::{
    GRIPPER, action_to_grasp, action_towards, difference_features, grasped, gripper_features, gripper_values,
    log_reaching_reward, object_features, object_values, pose_on_table, reaching_reward, robosuite_object_state,
    vector_at,
};
use super::task::{Setup, TableTask, TaskOutcome, TaskView};
use crate::env::Feature;
use crate::env::arm::Primitive;
use crate::env::physics::{Physics, TABLE_TOP};
use crate::env::scene::Body;
use crate::rng::{Rng, uniform};

/// Height of the cube's centre above the table that counts as lifted, m.
pub(super) const LIFTED: f64 = 0.04;
pub(super) const CUBE: usize = GRIPPER.end;
const HAND_TO_CUBE: usize = CUBE + 12;

/// Grasp the cube and lift its centre to more than 4 cm above the table: robosuite's Lift, with its numbers. An
/// episode is shorter than in its published runs.
#[derive(Clone, Copy, Debug)]
pub struct Lift;

impl TableTask for Lift {
    fn name(&self) -> &str {
        "lift"
    }

    /// robosuite's published runs use 500 (set `horizon`); most of those steps only collect the
    /// success reward, so the default is shorter.
    fn horizon(&self) -> usize {
        200
    }

    fn stages(&self) -> Vec<String> {
        ["reached", "grasped", "lifted"].map(String::from).into()
    }

    fn uses_gripper(&self) -> bool {
        true
    }

    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup {
        let half = [0; 3].map(|_| uniform(rng, 0.020, 0.022));
        let pose = pose_on_table(rng, 0.03, half[2], 0.01);
        Setup { objects: vec![physics.add_box(half, 1000.0, 1.0, &pose)], goal: None }
    }

    fn features(&self) -> Vec<Feature> {
        [gripper_features(), object_features("cube"), difference_features("hand", "cube").collect()].concat()
    }

    fn observe(&self, view: &TaskView) -> Vec<f64> {
        let cube = object_values(view, 0);
        let way: Vec<f64> = (0..3).map(|i| cube[i] - view.hand.translation.vector[i]).collect();
        [gripper_values(view, 0), cube, way].concat()
    }

    fn object_state(&self, view: &TaskView) -> Option<Vec<(String, f64)>> {
        Some(robosuite_object_state(view, 0, "cube", "gripper_to_cube_pos"))
    }

    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        let distance = vector_at(obs, HAND_TO_CUBE).norm();
        let grasped = grasped(obs);
        let success = vector_at(obs, CUBE).z > TABLE_TOP + LIFTED;
        let shaped = if success { 2.25 } else { reaching_reward(distance) + if grasped { 0.25 } else { 0.0 } };
        TaskOutcome {
            shaped: shaped / 2.25,
            success,
            stage: if success {
                3
            } else if grasped {
                2
            } else {
                usize::from(distance < 0.02)
            },
        }
    }

    fn log_shaped(&self, obs: &[f32]) -> f64 {
        let TaskOutcome { shaped, success, .. } = self.outcome(obs);
        let distance = vector_at(obs, HAND_TO_CUBE).norm();
        if success { shaped } else { shaped + (log_reaching_reward(distance) - reaching_reward(distance)) / 2.25 }
    }

    fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> {
        Some(if grasped(obs) {
            // Up, and then hold still.
            let height = TABLE_TOP + 0.12 - vector_at(obs, CUBE).z;
            action_towards(Vector3::z() * height, 1.0)
        } else {
            action_to_grasp(vector_at(obs, HAND_TO_CUBE))
        })
    }

    fn drawn(&self, _setup: &Setup) -> Vec<Body> {
        vec![Body::solid("cube", "#d8443c", vec![Primitive::cuboid([0.021; 3], [0.0; 3])])]
    }
}
