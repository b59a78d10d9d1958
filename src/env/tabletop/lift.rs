//! `lift`: take the cube from the table. robosuite's Lift, with its numbers.

use super::task::{
    HAND_VELOCITY, Setup, TableTask, TaskOutcome, TaskView, closeness, gripper_features, gripper_values,
    object_features, object_state_of, object_values, on_table, towards, vector, way,
};
use crate::env::Feature;
use crate::env::arm::Primitive;
use crate::env::physics::{Physics, TABLE_TOP};
use crate::env::scene::Body;
use crate::rng::{Rng, uniform};

/// Height of the cube's centre above the table that counts as lifted, m.
pub(super) const LIFTED: f64 = 0.04;
pub(super) const GRIPPER: usize = HAND_VELOCITY.end;
pub(super) const PADS: usize = GRIPPER + 2;
pub(super) const CUBE: usize = GRIPPER + 4;
const HAND_TO_CUBE: usize = CUBE + 12;

/// The task. See the module's page.
pub struct Lift;

impl TableTask for Lift {
    fn name(&self) -> &'static str {
        "lift"
    }

    /// robosuite's published runs use 500 (set `horizon`); most of those steps only collect the
    /// success reward, so the default is shorter.
    fn horizon(&self) -> usize {
        200
    }

    fn stages(&self) -> &'static [&'static str] {
        &["reached", "grasped", "lifted"]
    }

    fn uses_gripper(&self) -> bool {
        true
    }

    fn place(&self, physics: &mut Physics, rng: &mut Rng) -> Setup {
        let half = [0; 3].map(|_| uniform(rng, 0.020, 0.022));
        let pose = on_table(rng, 0.03, half[2], 0.01);
        Setup { objects: vec![physics.add_box(half, 1000.0, 1.0, &pose)], goal: None }
    }

    fn features(&self) -> Vec<Feature> {
        [gripper_features(), object_features("cube"), way("hand", "cube").collect()].concat()
    }

    fn observe(&self, view: &TaskView) -> Vec<f64> {
        let cube = object_values(view, 0);
        let way: Vec<f64> = (0..3).map(|i| cube[i] - view.hand.translation.vector[i]).collect();
        [gripper_values(view, 0), cube, way].concat()
    }

    fn object_state(&self, view: &TaskView) -> Vec<(String, f64)> {
        object_state_of(view, 0, "cube", "gripper_to_cube_pos")
    }

    fn outcome(&self, obs: &[f32]) -> TaskOutcome {
        let distance = vector(obs, HAND_TO_CUBE).norm();
        let grasped = grasped(obs);
        let success = vector(obs, CUBE).z > TABLE_TOP + LIFTED;
        let shaped = if success { 2.25 } else { closeness(distance) + if grasped { 0.25 } else { 0.0 } };
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

    fn scripted(&self, obs: &[f32]) -> [f64; 4] {
        if grasped(obs) {
            // Up, and then hold still.
            let height = TABLE_TOP + 0.12 - vector(obs, CUBE).z;
            return towards(nalgebra::Vector3::z() * height, 1.0);
        }
        descend_and_close(vector(obs, HAND_TO_CUBE))
    }

    fn drawn(&self, _setup: &Setup) -> Vec<Body> {
        vec![Body::solid("cube", "#d8443c", vec![Primitive::cuboid([0.021; 3], [0.0; 3])])]
    }
}

/// Whether both pads touch the object. (Learned models answer with numbers between 0 and 1.)
pub(super) fn grasped(obs: &[f32]) -> bool {
    obs[PADS] > 0.5 && obs[PADS + 1] > 0.5
}

/// The first half of every scripted grasp: over the object, down to it, close.
pub(super) fn descend_and_close(way: nalgebra::Vector3<f64>) -> [f64; 4] {
    let aside = way.xy().norm();
    if aside > 0.02 {
        // Approach a few centimetres above the object, so that the fingers do not knock it over.
        towards(way + nalgebra::Vector3::z() * 0.06, -1.0)
    } else if way.norm() > 0.012 {
        towards(way, -1.0)
    } else {
        towards(way, 1.0)
    }
}
