//! Tasks for a robot arm at a table, in the manner of robosuite.
//!
//! [`Tabletop`] is the environment: arm, controller, gripper, observation. A [`TableTask`] is what differs from task to
//! task: what stands on the table, what of it is observed, and what counts as success. A task of your own is an
//! `impl TableTask`, and everything that takes one of ours takes it too: planners on the true dynamics, known rewards,
//! the scripted policy, the 3D replay. [`helpers`] has what ours are made of.
//!
//! ```
//! use handful::env::physics::Physics;
//! use handful::env::scene::Body;
//! use handful::env::tabletop::helpers::{action_towards, difference_features, vector_at, xyz_features};
//! use handful::env::tabletop::{Setup, TableTask, TaskOutcome, TaskView, Tabletop};
//! use handful::nalgebra::Vector3;
//! use handful::prelude::*;
//! use handful::rng::Rng;
//!
//! /// Bring the hand 10 cm above the middle of the table.
//! struct Hover;
//!
//! impl TableTask for Hover {
//!     fn name(&self) -> &str { "hover" }
//!     fn horizon(&self) -> usize { 50 }
//!     fn place(&self, _physics: &mut Physics, _rng: &mut Rng) -> Setup {
//!         Setup { objects: vec![], goal: Some(Vector3::new(0.0, 0.0, 0.9)) }
//!     }
//!     fn features(&self) -> Vec<Feature> {
//!         let goal = xyz_features("goal", [0.0, 0.0, 0.9], 0.15).map(Feature::constant);
//!         goal.chain(difference_features("hand", "goal")).collect()
//!     }
//!     fn observe(&self, view: &TaskView) -> Vec<f64> {
//!         let goal = view.setup.goal.expect("hover has one");
//!         goal.iter().chain(&(goal - view.hand.translation.vector)).copied().collect()
//!     }
//!     fn outcome(&self, obs: &[f32]) -> TaskOutcome {
//!         let distance = vector_at(obs, 9).norm();
//!         TaskOutcome { shaped: (1.0 - distance).max(0.0), success: distance < 0.02, stage: 0 }
//!     }
//!     fn scripted(&self, obs: &[f32]) -> Option<[f64; 4]> { Some(action_towards(vector_at(obs, 9), 0.0)) }
//!     fn drawn(&self, _setup: &Setup) -> Vec<Body> { vec![Body::goal(0.02)] }
//! }
//!
//! let mut env = Tabletop::new(Hover, TableOptions::default())?;
//! let mut obs = env.reset(0);
//! let last = loop {
//!     let step = env.step(&env.scripted_action(&obs).expect("hover has a script"))?;
//!     if step.done() { break step; }
//!     obs = step.observation;
//! };
//! assert!(last.success);
//! # Ok::<(), Error>(())
//! ```

mod build;
mod door;
mod drawing;
pub mod helpers;
mod lift;
mod options;
mod push;
mod reach;
mod robosuite;
mod stack;
mod task;

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};

pub use door::Door;
pub use lift::Lift;
pub use options::{ActionKind, ObservationKind, RewardKind, TableOptions};
pub use push::Push;
pub use reach::Reach;
pub use stack::Stack;
pub use task::{HAND_POSITION, HAND_VELOCITY, Setup, TableTask, TaskOutcome, TaskView};

use super::arm::{JointVector, Pose};
use super::kinematics::Kinematics;
use super::osc::{Goal, OperationalSpaceController};
use super::physics::{JointState, Physics, STEPS_PER_CONTROL, TIMESTEP};
use super::scene::{Body, Camera};
use super::{Env, KnownReward, Snapshot, Spec, Step};
use crate::error::{Error, Result};
use crate::rng;

/// How far ahead of the hand a full action puts its goal, m.
pub(crate) const MAX_LEAD: f64 = 0.05;
/// The same for a full rotation of the pose action, rad.
const MAX_TURN: f64 = 0.5;

/// The arm at the table, with a task.
pub struct Tabletop {
    spec: Spec,
    options: TableOptions,
    task: Arc<dyn TableTask>,
    /// Whether the task has a hand-written policy.
    scripted: bool,
    /// Arm and bare table, ready to be copied for a new episode.
    empty: Physics,
    home_orientation: UnitQuaternion<f64>,
    state: TabletopState,
}

/// Everything that the rest of an episode depends on.
#[derive(Clone, Debug)]
pub struct TabletopState {
    physics: Physics,
    setup: Setup,
    controller: OperationalSpaceController,
    /// Kinematics at the start of the last physics step. The controller's target is set from these, one physics step old;
    /// robosuite's from the present ones.
    measured: Kinematics,
    /// Joint velocities at that time, rad/s.
    measured_qd: JointVector,
    /// Where the finger servos are told to go, m, for each finger.
    finger_target: f64,
    elapsed: usize,
    compact: Vec<f32>,
}

impl TabletopState {
    /// Whether the task has put its objects on the table: not before the first reset.
    fn is_set_up(&self) -> bool {
        !self.compact.is_empty()
    }
}

impl Tabletop {
    /// The simulation under the task.
    pub fn physics(&self) -> &Physics {
        &self.state.physics
    }

    /// The objects and the goal of this episode.
    pub fn setup(&self) -> &Setup {
        &self.state.setup
    }

    /// The action of the task's hand-written policy for an observation. None if the task has no such policy, or if
    /// observations are not compact.
    pub fn scripted_action(&self, obs: &[f32]) -> Option<Vec<f32>> {
        self.observes_compact().then(|| self.task.scripted(obs))?.map(|hand| self.options.action_of_hand(hand))
    }

    /// The task's hand-written policy, from observations to actions, apart from the environment. None if
    /// [`Tabletop::scripted_action`] has nothing to say; an observation without a scripted action is answered with zeros.
    pub fn scripted_policy(&self) -> Option<impl Fn(&[f32]) -> Vec<f32> + Send + Sync + use<>> {
        let (task, options) = (self.task.clone(), self.options);
        let policy = move |obs: &[f32]| options.action_of_hand(task.scripted(obs).unwrap_or_default());
        (self.scripted && self.observes_compact()).then_some(policy)
    }

    fn observes_compact(&self) -> bool {
        self.options.observation == ObservationKind::Compact
    }

    /// The compact observation at this time step, whichever kind the agent is given.
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

    fn compact_observation(&self) -> Vec<f32> {
        self.with_view(|view| {
            let hand = view.hand.translation.vector;
            let common = hand.iter().chain(&view.hand_velocity).copied();
            common.chain(self.task.observe(view)).map(|x| x as f32).collect()
        })
    }

    fn observe(&mut self) -> Vec<f32> {
        self.state.compact = self.compact_observation();
        match self.options.observation {
            ObservationKind::Compact => self.state.compact.clone(),
            ObservationKind::Robosuite => {
                let values = robosuite::observe(self).expect("checked when it was made");
                values.into_iter().map(|(_, value)| value as f32).collect()
            }
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

    fn reward_of(&self, outcome: TaskOutcome, obs: &[f32]) -> f32 {
        match self.options.reward {
            RewardKind::Shaped => outcome.shaped as f32,
            RewardKind::Log => self.task.log_shaped(obs) as f32,
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
        if !self.state.is_set_up() {
            return Err(Error::action(&self.spec.name, "a step before the first reset; reset first"));
        }
        self.command(action);
        self.advance();
        self.state.elapsed += 1;
        let observation = self.observe();
        let outcome = self.task.outcome(&self.state.compact);
        let truncated = self.state.elapsed >= self.spec.horizon;
        let step = Step::new(observation, self.reward_of(outcome, &self.state.compact)).truncated(truncated);
        Ok(step.success(outcome.success).stage(outcome.stage))
    }

    fn hand(&self) -> Option<[f64; 3]> {
        Some(self.state.physics.kinematics(&self.state.physics.joint_state().q).grip.translation.vector.into())
    }

    fn scene(&self) -> Vec<Body> {
        drawing::bodies(self)
    }

    fn poses(&self) -> Vec<Pose> {
        drawing::poses(self)
    }

    fn camera(&self) -> Camera {
        self.task.camera()
    }

    /// The hand, if observations are compact.
    fn position_of(&self, obs: &[f32]) -> Option<[f64; 3]> {
        self.observes_compact()
            .then(|| HAND_POSITION.map(|i| f64::from(obs[i])).collect::<Vec<_>>().try_into().expect("three numbers"))
    }
}

impl KnownReward for Tabletop {
    /// With compact observations; [`ObservationKind::Robosuite`] does not determine the reward.
    fn is_known(&self) -> bool {
        self.observes_compact()
    }

    /// # Panics
    /// If the reward is not known ([`KnownReward::is_known`]).
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        assert!(self.is_known(), "the reward needs compact observations");
        self.reward_of(self.task.outcome(next_obs), next_obs)
    }
}

impl std::fmt::Debug for Tabletop {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { spec, options, state, .. } = self;
        f.debug_struct("Tabletop")
            .field("spec", spec)
            .field("options", options)
            .field("state", state)
            .finish_non_exhaustive()
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
