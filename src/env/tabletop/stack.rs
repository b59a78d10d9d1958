//! `stack`: put the red cube on the green one. robosuite's Stack, with its numbers.

use nalgebra::Vector3;

use super::helpers::{
    GRIPPER, action_to_grasp, action_towards, cube_features, difference_features, grasped, gripper_features,
    gripper_values, log_reaching_reward, named_values, object_values, pose_on_table, reaching_reward,
    robosuite_object_state, vector_at,
};
use super::lift::{CUBE, LIFTED};
use super::task::{Setup, TableTask, TaskOutcome, TaskView};
use crate::env::Feature;
use crate::env::arm::Primitive;
use crate::env::physics::{Physics, TABLE_TOP};
use crate::env::scene::Body;
use crate::rng::Rng;

/// Half edges of the cube to be stacked, and of the one that carries it, m.
const HALF: [f64; 2] = [0.020, 0.025];
const REACH: f64 = 0.08;

const BASE: usize = CUBE + 12;
const HAND_TO_CUBE: usize = BASE + 12;
const CUBE_TO_BASE: usize = HAND_TO_CUBE + 3;
const TOUCHING: usize = CUBE_TO_BASE + 3;

/// Put the red cube on the green one: robosuite's Stack, with its numbers. An episode is shorter than in its
/// published runs.
#[derive(Clone, Copy, Debug)]
pub struct Stack;

impl TableTask for Stack {
    fn name(&self) -> &str {
        "stack"
    }

    fn horizon(&self) -> usize {
        300
    }

    fn stages(&self) -> Vec<String> {
        ["reached", "grasped", "lifted", "stacked"].map(String::from).into()
    }

    fn uses_gripper(&self) -> bool {
        true
    }

    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup {
        let apart = (HALF[0] + HALF[1]) * std::f64::consts::SQRT_2;
        let base = pose_on_table(rng, REACH, HALF[1], 0.01);
        let cube = loop {
            let cube = pose_on_table(rng, REACH, HALF[0], 0.01);
            if (cube.translation.vector - base.translation.vector).xy().norm() > apart {
                break cube;
            }
        };
        let objects =
            vec![physics.add_box([HALF[0]; 3], 1000.0, 1.0, &cube), physics.add_box([HALF[1]; 3], 1000.0, 1.0, &base)];
        Setup { objects, goal: None }
    }

    fn features(&self) -> Vec<Feature> {
        gripper_features()
            .into_iter()
            .chain(cube_features("cube"))
            .chain(cube_features("base"))
            .chain(difference_features("hand", "cube"))
            .chain(difference_features("cube", "base"))
            .chain([Feature::new("cube touches base").flag()])
            .collect()
    }

    fn observe(&self, view: &TaskView) -> Vec<f64> {
        let (cube, base) = (object_values(view, 0), object_values(view, 1));
        let hand = view.hand.translation.vector;
        let to_cube: Vec<f64> = (0..3).map(|i| cube[i] - hand[i]).collect();
        let to_base: Vec<f64> = (0..3).map(|i| base[i] - cube[i]).collect();
        let touching = view.physics.touching(view.setup.objects[0], view.setup.objects[1]);
        [gripper_values(view, 0), cube, base, to_cube, to_base, vec![f64::from(touching)]].concat()
    }

    fn object_state(&self, view: &TaskView) -> Option<Vec<(String, f64)>> {
        let [cube, base] = [0, 1].map(|i| view.physics.object_state(view.setup.objects[i]).pose.translation.vector);
        let a = robosuite_object_state(view, 0, "cubeA", "gripper_to_cubeA");
        let b = robosuite_object_state(view, 1, "cubeB", "gripper_to_cubeB");
        // robosuite lists both poses first, then the vectors between things.
        Some([&a[..7], &b[..7], &named_values("cubeA_to_cubeB", (base - cube).iter()), &a[7..], &b[7..]].concat())
    }

    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        let distance = vector_at(obs, HAND_TO_CUBE).norm();
        let grasped = grasped(obs);
        let lifted = vector_at(obs, CUBE).z > TABLE_TOP + LIFTED;
        let stacked = !grasped && lifted && obs[TOUCHING] > 0.5;
        let reach = 0.25 * reaching_reward(distance) + if grasped { 0.25 } else { 0.0 };
        // robosuite leaves the factor 10 out of this distance; the term is nearly flat.
        let align = 0.5 * (1.0 - vector_at(obs, CUBE_TO_BASE).xy().norm().tanh());
        let lift = if lifted { 1.0 + align } else { 0.0 };
        let stack = if stacked { 2.0 } else { 0.0 };
        TaskOutcome {
            shaped: reach.max(lift).max(stack) / 2.0,
            success: stacked,
            stage: if stacked {
                4
            } else if lifted && grasped {
                3
            } else if grasped {
                2
            } else {
                usize::from(distance < 0.02)
            },
        }
    }

    /// With the distance between the cube and its place on the base, where robosuite's term is nearly flat.
    fn log_shaped(&self, obs: &[f32]) -> f64 {
        let TaskOutcome { success, .. } = self.outcome(obs);
        let grasped = if grasped(obs) { 0.25 } else { 0.0 };
        let lifted = vector_at(obs, CUBE).z > TABLE_TOP + LIFTED;
        let to_place = vector_at(obs, CUBE_TO_BASE) + Vector3::z() * (HALF[0] + HALF[1]);
        if success {
            1.0
        } else if lifted {
            (1.5 + 0.25 * log_reaching_reward(to_place.norm())) / 2.0
        } else {
            (0.25 * log_reaching_reward(vector_at(obs, HAND_TO_CUBE).norm()) + grasped) / 2.0
        }
    }

    fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> {
        let to_base = vector_at(obs, CUBE_TO_BASE);
        let on_top = HALF[0] + HALF[1];
        let over = to_base.xy().norm() < 0.01;
        if over && (to_base.z + on_top).abs() < 0.004 {
            // There: let go, and draw back once the fingers are open.
            let open = obs[GRIPPER.start] > 0.03;
            return Some(action_towards(Vector3::z() * if open { 0.05 } else { 0.0 }, -1.0));
        }
        if grasped(obs) {
            let height = to_base.z + on_top;
            // Lift clear of the base, carry across, lower.
            return Some(if over {
                action_towards(Vector3::new(to_base.x, to_base.y, height.max(-0.03)), 1.0)
            } else if height < -0.03 || to_base.xy().norm() < 0.03 {
                action_towards(Vector3::new(to_base.x, to_base.y, height + 0.05), 1.0)
            } else {
                action_towards(Vector3::z() * (height + 0.05), 1.0)
            });
        }
        Some(action_to_grasp(vector_at(obs, HAND_TO_CUBE)))
    }

    fn drawn(&self, _setup: &Setup) -> Vec<Body> {
        vec![
            Body::solid("cube", "#d8443c", vec![Primitive::cuboid([HALF[0]; 3], [0.0; 3])]),
            Body::solid("base", "#3f9d5a", vec![Primitive::cuboid([HALF[1]; 3], [0.0; 3])]),
        ]
    }
}
