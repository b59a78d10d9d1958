//! A world of one's own, from nothing to a report: a puck, pushed by a force, slides past a post to a goal.
//! `cargo run --example own_world -- study --out runs/puck` compares agents on it; `... -- train --task puck --method sac` trains one.

use handful::env::{arm::Pose, arm::Primitive, scene::Body};
use handful::{prelude::*, rng};

const POST: f32 = 0.25;
const TOLERANCE: f32 = 0.1;

/// All that the future depends on; lengths in metres, seconds. `elapsed` counts time steps.
#[derive(Clone, Default)]
pub struct PuckState {
    position: [f32; 2],
    velocity: [f32; 2],
    goal: [f32; 2],
    elapsed: usize,
}

pub struct Puck {
    spec: Spec,
    state: PuckState,
}

impl Default for Puck {
    fn default() -> Self {
        let dynamic = ["x", "y", "vx", "vy"].map(Feature::new).into_iter();
        let goal = ["goal x", "goal y"].map(|name| Feature::new(name).constant());
        let way = ["x", "y"].map(|axis| Feature::new(format!("way {axis}")).difference(format!("goal {axis}"), axis));
        let spec = Spec::new("puck", dynamic.chain(goal).chain(way), 2, 50, 0.1);
        Self { spec, state: PuckState::default() }
    }
}

impl Puck {
    fn observe(&self) -> Vec<f32> {
        let PuckState { position: [x, y], velocity: [vx, vy], goal: [gx, gy], .. } = self.state;
        vec![x, y, vx, vy, gx, gy, gx - x, gy - y]
    }
}

impl Env for Puck {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        let mut rng = rng::stream(seed, "puck");
        let [y, goal_x, goal_y] = [0; 3].map(|_| rng::uniform(&mut rng, -0.5, 0.5) as f32);
        self.state = PuckState { position: [-0.8, y], goal: [0.5 + 0.4 * goal_x, goal_y], ..PuckState::default() };
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
        let distance = position[0].hypot(position[1]);
        if distance < POST {
            let normal = position.map(|x| x / distance);
            let inwards = (velocity[0] * normal[0] + velocity[1] * normal[1]).min(0.0);
            *position = normal.map(|n| POST * n);
            *velocity = [0, 1].map(|i| velocity[i] - inwards * normal[i]);
        }
        *elapsed += 1;
        let (truncated, obs) = (*elapsed >= self.spec.horizon, self.observe());
        let (reward, success) = (self.reward(&[], action, &obs), obs[6].hypot(obs[7]) < TOLERANCE);
        Ok(Step::new(obs, reward).truncated(truncated).success(success))
    }

    fn hand(&self) -> Option<[f64; 3]> {
        let [x, y] = self.state.position.map(f64::from);
        Some([x, y, 0.0])
    }

    fn scene(&self) -> Vec<Body> {
        let ball = |name, colour, radius| Body::solid(name, colour, vec![Primitive::ball(radius, [0.0; 3])]);
        vec![ball("post", "#c9a97c", POST.into()), ball("hand", "#d8443c", 0.05), Body::goal(TOLERANCE.into())]
    }

    fn poses(&self) -> Vec<Pose> {
        let PuckState { position, goal, .. } = self.state;
        [[0.0; 2], position, goal].map(|[x, y]| Pose::translation(x.into(), y.into(), 0.0)).into()
    }
}

/// Needed by the method `pets`; `pets-learned` works without it. Without [`Snapshot`], there is no oracle.
impl KnownReward for Puck {
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        1.0 - (2.0 * next_obs[6].hypot(next_obs[7])).tanh()
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

/// Our tasks and agents, and the puck. A method that differs from a preset is a few lines of TOML.
pub fn registry() -> Registry {
    Registry::standard()
        .env(EnvEntry::new("puck", || Ok(Puck::default())).with_known_reward().with_oracle())
        .preset("pets-learned", "base = \"pets\"\n[pets.ensemble]\nlearn_reward = true\n")
        .quick_study(&["puck"], &["random", "oracle", "pets", "pets-learned", "dreamer", "sac"], None)
}

fn main() -> std::process::ExitCode {
    handful::cli::main(&registry())
}
