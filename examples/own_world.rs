//! A world of one's own, from nothing to a report: a puck slides past a post to a goal.
//!
//! `cargo run --example own_world` compares PETS (with the reward known, and learned), Dreamer, SAC and the oracle on it
//! and writes `runs/quick/report.md`; `cargo run --example own_world -- train --task puck --method sac`, and every other
//! command of `handful`, works with it too.

use std::process::ExitCode;

use handful::env::arm::{Pose, Primitive};
use handful::env::scene::{Body, Camera};
use handful::prelude::*;
use handful::rng;

const POST_RADIUS: f32 = 0.25;
const TOLERANCE: f32 = 0.1;

/// All that the future depends on: position (m), velocity (m/s), goal (m), time steps since the reset.
#[derive(Clone, Default)]
pub struct PuckState {
    position: [f32; 2],
    velocity: [f32; 2],
    goal: [f32; 2],
    elapsed: usize,
}

/// The environment. An action is a force in the plane.
pub struct Puck {
    spec: Spec,
    state: PuckState,
}

impl Puck {
    pub fn new() -> Self {
        let observation = vec![
            Feature::new("puck x"),
            Feature::new("puck y"),
            Feature::new("puck vx"),
            Feature::new("puck vy"),
            Feature::new("goal x").constant(),
            Feature::new("goal y").constant(),
            Feature::new("way x").difference("goal x", "puck x"),
            Feature::new("way y").difference("goal y", "puck y"),
        ];
        Self { spec: Spec::new("puck", observation, 2, 50, 0.1).stages(["there"]), state: PuckState::default() }
    }

    fn observe(&self) -> Vec<f32> {
        let PuckState { position: [x, y], velocity: [vx, vy], goal: [gx, gy], .. } = self.state;
        vec![x, y, vx, vy, gx, gy, gx - x, gy - y]
    }
}

fn norm(x: f32, y: f32) -> f32 {
    (x * x + y * y).sqrt()
}

impl Env for Puck {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        let mut rng = rng::stream(seed, "puck");
        let [y, goal_y] = [0; 2].map(|_| rng::uniform(&mut rng, -0.5, 0.5) as f32);
        self.state = PuckState { position: [-0.8, y], goal: [0.8, goal_y], ..PuckState::default() };
        self.observe()
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        self.spec.check_action(action)?;
        let PuckState { position, velocity, elapsed, .. } = &mut self.state;
        for i in 0..2 {
            velocity[i] = 0.9 * velocity[i] + 0.2 * action[i].clamp(-1.0, 1.0);
            position[i] = (position[i] + 0.1 * velocity[i]).clamp(-1.0, 1.0);
        }
        // The post in the middle pushes the puck out and takes the velocity towards it.
        let distance = norm(position[0], position[1]).max(1e-6);
        if distance < POST_RADIUS {
            let normal = position.map(|x| x / distance);
            let inwards = (velocity[0] * normal[0] + velocity[1] * normal[1]).min(0.0);
            for i in 0..2 {
                position[i] = POST_RADIUS * normal[i];
                velocity[i] -= inwards * normal[i];
            }
        }
        *elapsed += 1;
        let (truncated, obs) = (*elapsed >= self.spec.horizon, self.observe());
        let (reward, success) = (self.reward(&[], action, &obs), norm(obs[6], obs[7]) < TOLERANCE);
        Ok(Step::new(obs, reward).truncated(truncated).success(success).stage(usize::from(success)))
    }

    fn hand(&self) -> Option<[f64; 3]> {
        self.position_of(&self.observe())
    }

    fn scene(&self) -> Vec<Body> {
        let post = Primitive::capsule(0.8 * f64::from(POST_RADIUS), [0.0; 3], [0.0, 0.0, 0.2]);
        let puck = Primitive::ball(0.05, [0.0; 3]);
        vec![
            Body::solid("post", "#c9a97c", vec![post]),
            Body::solid("hand", "#d8443c", vec![puck]),
            Body::goal(TOLERANCE.into()),
        ]
    }

    fn poses(&self) -> Vec<Pose> {
        let at = |[x, y]: [f32; 2]| Pose::translation(x.into(), y.into(), 0.0);
        vec![at([0.0; 2]), at(self.state.position), at(self.state.goal)]
    }

    fn camera(&self) -> Camera {
        Camera { eye: [0.0, -2.2, 1.8], target: [0.0; 3] }
    }

    fn position_of(&self, obs: &[f32]) -> Option<[f64; 3]> {
        Some([obs[0].into(), obs[1].into(), 0.0])
    }
}

impl KnownReward for Puck {
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        1.0 - (2.0 * norm(next_obs[6], next_obs[7])).tanh()
    }
}

impl Snapshot for Puck {
    type State = PuckState;

    fn snapshot(&self) -> PuckState {
        self.state.clone()
    }

    fn restore(&mut self, state: &PuckState) {
        self.state = state.clone();
    }
}

/// Our tasks and agents, and the puck; a method that differs from a preset is a few lines of TOML.
pub fn registry() -> Registry {
    Registry::standard()
        .env(EnvEntry::new("puck", || Ok(Puck::new())).with_known_reward().with_oracle())
        .preset("pets-learned", "base = \"pets\"\n[pets.ensemble]\nlearn_reward = true\n")
        .quick_study(&["puck"], &["random", "oracle", "pets", "pets-learned", "dreamer", "sac"])
}

fn main() -> ExitCode {
    handful::cli::main(&registry())
}
