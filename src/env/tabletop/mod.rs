//! Tasks for the arm at the table.
//!
//! [`Tabletop`] is the environment: arm, controller, gripper, observation. A [`TableTask`] is what
//! differs from task to task: what stands on the table, what of it is observed, and what counts as
//! success. A new task is one file like `reach.rs`, and one line in [`super::Task`].

mod lift;
mod push;
mod reach;
mod robosuite;
mod stack;
mod task;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

pub use lift::Lift;
pub use push::Push;
pub use reach::Reach;
pub use stack::Stack;
pub use task::{HAND_POSITION, HAND_VELOCITY, Setup, TableTask, TaskOutcome, TaskView};

use super::arm::{ArmDescription, JointVector, Pose};
use super::kinematics::Kinematics;
use super::osc::{Goal, OperationalSpaceController};
use super::physics::{CONTROL_HZ, JointState, Physics, STEPS_PER_CONTROL, TABLE_HALF, TABLE_TOP, TIMESTEP};
use super::scene::{Body, Camera};
use super::{Env, Feature, KnownReward, Snapshot, Spec, Step, arm::Primitive};
use crate::error::Result;
use crate::rng;

/// How far ahead of the hand a full action puts its goal, m.
const MAX_LEAD: f64 = 0.05;
/// The same for a full rotation of the pose action, rad.
const MAX_TURN: f64 = 0.5;

/// What an episode is rewarded with.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RewardKind {
    /// A number in [0, 1] that grows along the way to success.
    #[default]
    Shaped,
    /// 1 at success, else 0.
    Sparse,
}

/// What an action means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ActionKind {
    /// `[dx, dy, dz, gripper]`; the hand keeps its home orientation. The gripper closes with a
    /// speed proportional to the fourth number, so that a policy can learn it by gradient.
    #[default]
    Hand,
    /// robosuite's `[dx, dy, dz, rx, ry, rz, gripper]`: also a rotation vector, in the world frame;
    /// only the sign of the last number counts.
    Pose,
}

/// What an observation holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ObservationKind {
    /// Hand, gripper, objects, goal, and the vectors between them.
    #[default]
    Compact,
    /// robosuite 1.5's vector: the task's object state, then 50 numbers of the robot. Rewards cannot
    /// be computed from it alone (it does not tell what the pads touch).
    Robosuite,
}

/// Options of every table task.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TableOptions {
    /// Shaped or sparse reward.
    pub reward: RewardKind,
    /// What an action means.
    pub action: ActionKind,
    /// What an observation holds.
    pub observation: ObservationKind,
    /// Control steps in an episode; the task's own number if absent.
    pub horizon: Option<usize>,
}

/// The arm at the table, with a task.
pub struct Tabletop {
    spec: Spec,
    options: TableOptions,
    task: &'static dyn TableTask,
    /// Arm and bare table, ready to be copied for a new episode.
    empty: Physics,
    home_orientation: UnitQuaternion<f64>,
    state: TabletopState,
}

/// All that the future of an episode depends on.
#[derive(Clone)]
pub struct TabletopState {
    physics: Physics,
    setup: Setup,
    controller: OperationalSpaceController,
    /// Kinematics at the start of the last physics step. robosuite sets its goals from these, one
    /// physics step old; so do we.
    measured: Kinematics,
    /// Joint velocities at that moment, rad/s.
    measured_qd: JointVector,
    /// Where the finger servos are told to go, m, for each finger.
    finger_target: f64,
    elapsed: usize,
    compact: Vec<f32>,
}

impl Tabletop {
    /// The Panda at the table with `task`.
    pub fn new(task: &'static dyn TableTask, options: TableOptions) -> Self {
        let arm = ArmDescription::panda();
        let empty = Physics::new(arm.clone());
        let home = empty.kinematics(&arm.home);
        let goal = Goal { position: home.grip.translation.vector, orientation: home.grip.rotation };
        let state = TabletopState {
            controller: OperationalSpaceController::new(&arm, goal, arm.home),
            setup: Setup::default(),
            measured: home,
            measured_qd: JointVector::zeros(),
            finger_target: 0.0,
            elapsed: 0,
            compact: Vec::new(),
            physics: empty.clone(),
        };
        let action_size = match options.action {
            ActionKind::Hand => 4,
            ActionKind::Pose => 7,
        };
        let horizon = options.horizon.unwrap_or(task.horizon());
        let mut tabletop = Self {
            spec: Spec::new(task.name(), [], action_size, horizon, 1.0 / CONTROL_HZ)
                .stages(task.stages().iter().copied()),
            home_orientation: goal.orientation,
            options,
            task,
            empty,
            state,
        };
        tabletop.spec.observation = match options.observation {
            ObservationKind::Compact => {
                let hand = [("hand x", -0.1), ("hand y", 0.0), ("hand z", 0.95)]
                    .map(|(name, centre)| Feature::new(name).around(centre, 0.15));
                let velocity = ["hand vx", "hand vy", "hand vz"].map(|name| Feature::new(name).around(0.0, 0.2));
                hand.into_iter().chain(velocity).chain(task.features()).collect()
            }
            ObservationKind::Robosuite => {
                tabletop.reset(0);
                robosuite::observe(&tabletop).into_iter().map(|(name, _)| Feature::new(name)).collect()
            }
        };
        tabletop
    }

    /// The world under the task.
    pub fn physics(&self) -> &Physics {
        &self.state.physics
    }

    /// What stands on the table.
    pub fn setup(&self) -> &Setup {
        &self.state.setup
    }

    /// The compact observation, whichever kind the agent is given.
    pub fn compact(&self) -> &[f32] {
        &self.state.compact
    }

    fn with_view<T>(&self, see: impl FnOnce(&TaskView) -> T) -> T {
        let state = &self.state;
        let joints = state.physics.joint_state();
        let kinematics = state.physics.kinematics(&joints.q);
        see(&TaskView {
            physics: &state.physics,
            setup: &state.setup,
            joints: &joints,
            hand: kinematics.grip,
            hand_velocity: kinematics.linear * joints.qd,
            finger_target: state.finger_target,
        })
    }

    fn observe(&mut self) -> Vec<f32> {
        self.state.compact = self.with_view(|view| {
            let hand = view.hand.translation.vector;
            let common = hand.iter().chain(&view.hand_velocity).copied();
            common.chain(self.task.observe(view)).map(|x| x as f32).collect()
        });
        match self.options.observation {
            ObservationKind::Compact => self.state.compact.clone(),
            ObservationKind::Robosuite => robosuite::observe(self).into_iter().map(|(_, value)| value as f32).collect(),
        }
    }

    /// Sets the controller's goal and the finger target from an action.
    fn command(&mut self, action: &[f32]) {
        let a: Vec<f64> = action.iter().map(|&a| f64::from(a).clamp(-1.0, 1.0)).collect();
        let hand = &self.state.measured.grip;
        let (orientation, grip) = match self.options.action {
            ActionKind::Hand => (self.home_orientation, a[3]),
            ActionKind::Pose => {
                let turn = UnitQuaternion::from_scaled_axis(Vector3::new(a[3], a[4], a[5]) * MAX_TURN);
                (turn * hand.rotation, if a[6] == 0.0 { 0.0 } else { a[6].signum() })
            }
        };
        self.state.controller.goal =
            Goal { position: hand.translation.vector + Vector3::new(a[0], a[1], a[2]) * MAX_LEAD, orientation };
        if self.task.uses_gripper() {
            let gripper = &self.state.physics.arm().gripper;
            let [closed, open] = gripper.range;
            self.state.finger_target = (self.state.finger_target - grip * gripper.target_step).clamp(closed, open);
        }
    }

    /// One control step of physics towards the present goal.
    fn advance(&mut self) {
        let state = &mut self.state;
        let stiffness = state.physics.arm().gripper.stiffness;
        let max_force = state.physics.arm().gripper.max_force;
        for _ in 0..STEPS_PER_CONTROL {
            let joints = state.physics.joint_state();
            state.measured = state.physics.kinematics(&joints.q);
            state.measured_qd = joints.qd;
            let torques = state.controller.torques(&state.measured, &joints.q, &joints.qd);
            let servo = |position: f64| (stiffness * (state.finger_target - position)).clamp(-max_force, max_force);
            state.physics.step(&torques, joints.fingers.map(servo));
        }
    }

    fn reward_of(&self, outcome: TaskOutcome) -> f32 {
        match self.options.reward {
            RewardKind::Shaped => outcome.shaped as f32,
            RewardKind::Sparse => f32::from(outcome.success),
        }
    }
}

impl Env for Tabletop {
    fn spec(&self) -> &Spec {
        &self.spec
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        let mut rng = rng::stream(seed, "reset");
        let mut physics = self.empty.clone();
        let setup = self.task.place(&mut physics, &mut rng);
        let arm = physics.arm();
        let noise = JointVector::from_fn(|_, _| arm.home_noise * rng::normal(&mut rng));
        let q = arm.home + noise;
        // Half open, with the servos' targets where robosuite has them; or closed for good.
        let (fingers, finger_target) = if self.task.uses_gripper() {
            (arm.gripper.start, 0.5 * arm.gripper.range[1])
        } else {
            (arm.gripper.range[0], arm.gripper.range[0])
        };
        physics.set_joints(&q, [fingers; 2]);
        let state = &mut self.state;
        state.measured = physics.kinematics(&q);
        state.measured_qd = JointVector::zeros();
        state.controller.posture = q;
        state.finger_target = finger_target;
        state.elapsed = 0;
        state.physics = physics;
        state.setup = setup;
        self.observe()
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        self.spec.check_action(action)?;
        self.command(action);
        self.advance();
        self.state.elapsed += 1;
        let observation = self.observe();
        let outcome = self.task.outcome(&self.state.compact);
        let truncated = self.state.elapsed >= self.spec.horizon;
        let step = Step::new(observation, self.reward_of(outcome)).truncated(truncated);
        Ok(step.success(outcome.success).stage(outcome.stage))
    }

    fn hand(&self) -> Option<[f64; 3]> {
        Some(self.state.physics.kinematics(&self.state.physics.joint_state().q).grip.translation.vector.into())
    }

    fn scene(&self) -> Vec<Body> {
        let arm = self.state.physics.arm();
        let (white, dark) = ("#e8ebf0", "#39424e");
        let mut bodies = vec![Body::solid("base", dark, arm.base_shapes.clone())];
        for (i, link) in arm.links.iter().enumerate() {
            bodies.push(Body::solid(format!("link {}", i + 1), white, link.shapes.clone()));
        }
        for side in [1.0, -1.0] {
            let shapes = [&arm.gripper.finger, &arm.gripper.pad].map(|shape| arm.gripper.on_side(shape, side));
            bodies.push(Body::solid("finger", dark, shapes.to_vec()));
        }
        // The point that is controlled: small, but its trail shows the path.
        bodies.push(Body::solid("hand", "#f2a33a", vec![Primitive::ball(0.004, [0.0; 3])]));
        let legs = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)]
            .map(|(x, y)| Primitive::cuboid([0.02, 0.02, 0.3875], [0.37 * x, 0.37 * y, -0.4125]));
        let table = std::iter::once(Primitive::cuboid(TABLE_HALF, [0.0; 3])).chain(legs).collect();
        bodies.push(Body::solid("table", "#c9a97c", table));
        bodies.extend(self.task.drawn(&self.state.setup));
        bodies
    }

    fn poses(&self) -> Vec<Pose> {
        let state = &self.state;
        let hand = state.physics.kinematics(&state.physics.joint_state().q).grip;
        let table = Pose::translation(0.0, 0.0, TABLE_TOP - TABLE_HALF[2]);
        let objects = state.setup.objects.iter().map(|&object| state.physics.object_state(object).pose);
        let goal = state.setup.goal.map(|goal| Pose::translation(goal.x, goal.y, goal.z));
        state.physics.arm_poses().chain([hand, table]).chain(objects).chain(goal).collect()
    }

    fn camera(&self) -> Camera {
        Camera { eye: [0.85, -0.95, 1.4], target: [-0.17, 0.0, 0.99] }
    }

    /// The hand, if observations are compact.
    fn position_of(&self, obs: &[f32]) -> Option<[f64; 3]> {
        let compact = self.options.observation == ObservationKind::Compact;
        compact.then(|| HAND_POSITION.map(|i| f64::from(obs[i])).collect::<Vec<_>>().try_into().expect("three numbers"))
    }
}

impl KnownReward for Tabletop {
    /// # Panics
    /// With [`ObservationKind::Robosuite`]: those observations do not determine the reward.
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        assert_eq!(self.options.observation, ObservationKind::Compact, "the reward needs compact observations");
        self.reward_of(self.task.outcome(next_obs))
    }
}

impl Snapshot for Tabletop {
    type State = TabletopState;

    fn snapshot(&self) -> TabletopState {
        self.state.clone()
    }

    fn restore(&mut self, state: &TabletopState) {
        self.state = state.clone();
    }
}

impl Tabletop {
    /// Acceleration of the arm's joints over the last physics step, rad/s2.
    fn joint_acceleration(&self, joints: &JointState) -> JointVector {
        (joints.qd - self.state.measured_qd) / TIMESTEP
    }
}
