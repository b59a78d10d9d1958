//! The arm in free space: the dynamics that [`crate::env::tabletop::Tabletop`] has while the hand touches nothing but what it holds.
//!
//! Kinematics and controller are the world's own, written once for any kind of number. The integrator is written again here,
//! because rapier's knows f32 only: semi-implicit Euler with implicit damping, at the world's physics steps, on
//!
//! M(q) q'' = tau - c(q, q') - D q' - friction - (what the motors do not carry of the weight of a load),
//!
//! where c follows from the recursive Newton-Euler algorithm (Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 5) and
//! tau from operational-space control (Khatib 1987), both anew at each physics step. The limits of the joints are left out. rapier's
//! Coriolis term is semi-implicit; while the arm gathers speed, the two differ by as much as a gram in the hand would make.
//!
//! ```
//! use handful::diff::derivatives::linearise;
//! use handful::diff::{FreeArm, ReachTask};
//! use handful::env::arm::ArmDescription;
//! use handful::nalgebra::Vector3;
//!
//! let arm = ArmDescription::panda();
//! let task = ReachTask { arm: FreeArm::new(&arm, &arm.home), goal: Vector3::new(0.1, 0.0, 1.0) };
//! let state = task.arm.at_rest(&arm.home);
//! let step = linearise(&task, &state, &Vector3::new(1.0, 0.0, 0.0));
//! // A full action moves the hand forward, and a larger one would move it further.
//! assert!(step.next[14] > state[14] && step.by_action[(14, 0)] > 0.0);
//! ```

use nalgebra::{RealField, SVector, Vector3, convert};

use super::System;
use crate::env::arm::{ArmDescription, Inertia, JOINTS, JointVector};
use crate::env::kinematics::KinematicModel;
use crate::env::osc::{Goal, OperationalSpaceController};
use crate::env::physics::{STEPS_PER_CONTROL, TIMESTEP, dry_friction};
use crate::env::tabletop::MAX_LEAD;

/// Dimension of a state: joint angles (rad), joint velocities (rad/s), the position of the grip site (m). The last follows from the
/// first, and stands there so that costs need no kinematics.
pub const STATE: usize = 2 * JOINTS + 3;

/// The arm under its controller, with a body in its hand or without.
#[derive(Clone, Debug)]
pub struct FreeArm<S: RealField = f64> {
    model: KinematicModel<S>,
    controller: OperationalSpaceController<S>,
    damping: SVector<S, JOINTS>,
    friction: SVector<S, JOINTS>,
    armature: SVector<S, JOINTS>,
    /// The arm with what its hand holds, of which the controller does not know.
    loaded: Option<KinematicModel<S>>,
}

impl FreeArm {
    /// An empty hand, kept in the orientation that it has at home, and an elbow drawn to `posture`.
    pub fn new(arm: &ArmDescription, posture: &JointVector) -> Self {
        let model = KinematicModel::new(arm);
        let home = model.at(&arm.home).grip;
        let goal = Goal { position: home.translation.vector, orientation: home.rotation };
        let of_links = |number: fn(&crate::env::arm::LinkDescription) -> f64| {
            JointVector::from_iterator(arm.links.iter().map(number))
        };
        Self {
            model,
            controller: OperationalSpaceController::new(arm, goal, *posture),
            damping: of_links(|link| link.damping),
            friction: of_links(|link| link.friction),
            armature: of_links(|link| link.armature),
            loaded: None,
        }
    }

    /// The same arm in numbers of another kind.
    pub fn cast<S: RealField + Copy>(&self) -> FreeArm<S> {
        FreeArm {
            model: self.model.cast(),
            controller: self.controller.cast(),
            damping: self.damping.map(convert),
            friction: self.friction.map(convert),
            armature: self.armature.map(convert),
            loaded: self.loaded.as_ref().map(KinematicModel::cast),
        }
    }
}

impl<S: RealField + Copy> FreeArm<S> {
    /// The same arm with a body in its hand, given in the frame of the grip site.
    #[must_use]
    pub fn holding(self, body: &Inertia<S>) -> Self {
        let mut model = self.model.clone();
        model.hold(body);
        Self { loaded: Some(model), ..self }
    }

    /// The state of the arm at rest at joint angles `q`.
    pub fn at_rest(&self, q: &SVector<S, JOINTS>) -> SVector<S, STATE> {
        self.state(q, &SVector::zeros())
    }

    /// The state of the arm at joint angles `q`, moving at `qd`.
    pub fn state(&self, q: &SVector<S, JOINTS>, qd: &SVector<S, JOINTS>) -> SVector<S, STATE> {
        let hand = self.model.at(q).grip.translation.vector;
        let mut state = SVector::<S, STATE>::zeros();
        state.fixed_rows_mut::<JOINTS>(0).copy_from(q);
        state.fixed_rows_mut::<JOINTS>(JOINTS).copy_from(qd);
        state.fixed_rows_mut::<3>(2 * JOINTS).copy_from(&hand);
        state
    }

    /// The state after a control step. The action is that of [`crate::env::tabletop::ActionKind::Hand`] without the gripper: where
    /// the goal of the hand lies, seen from the hand.
    ///
    /// # Panics
    /// If a number in state or action is not finite.
    pub fn step(&self, state: &SVector<S, STATE>, action: &Vector3<S>) -> SVector<S, STATE> {
        let mut q: SVector<S, JOINTS> = state.fixed_rows::<JOINTS>(0).into();
        let mut qd: SVector<S, JOINTS> = state.fixed_rows::<JOINTS>(JOINTS).into();
        // Seen one physics step ago, as in the world and in robosuite.
        let seen = self.model.at(&(q - qd * convert::<f64, S>(TIMESTEP))).grip;
        let mut controller = self.controller.clone();
        controller.goal.position = seen.translation.vector + action * convert::<f64, S>(MAX_LEAD);
        for _ in 0..STEPS_PER_CONTROL {
            qd += self.acceleration(&controller, &q, &qd) * convert::<f64, S>(TIMESTEP);
            q += qd * convert::<f64, S>(TIMESTEP);
        }
        self.state(&q, &qd)
    }

    /// Joint accelerations, rad/s2, under the controller's torques. The motors carry the weight of the arm, but not of what it
    /// holds.
    fn acceleration(
        &self,
        controller: &OperationalSpaceController<S>,
        q: &SVector<S, JOINTS>,
        qd: &SVector<S, JOINTS>,
    ) -> SVector<S, JOINTS> {
        let at = self.model.at(q);
        let coriolis = at.coriolis(qd);
        let torques = controller.torques_with(&at, q, qd, &coriolis);
        let mut applied = SVector::<S, JOINTS>::from_fn(|i, _| {
            torques[i] - dry_friction(self.friction[i], self.armature[i], qd[i], torques[i])
        });
        let (mut mass, coriolis) = match &self.loaded {
            None => (at.mass, coriolis),
            Some(loaded) => {
                let loaded = loaded.at(q);
                applied -= loaded.gravity - at.gravity;
                (loaded.mass, loaded.coriolis(qd))
            }
        };
        for i in 0..JOINTS {
            mass[(i, i)] += self.damping[i] * convert(TIMESTEP);
        }
        let free = applied - coriolis - self.damping.component_mul(qd);
        mass.cholesky().expect("a mass matrix is positive definite").solve(&free)
    }
}

/// Bring the hand to a goal: the task `reach` as a [`System`].
#[derive(Clone, Debug)]
pub struct ReachTask {
    /// The arm.
    pub arm: FreeArm,
    /// The goal, m, world frame.
    pub goal: Vector3<f64>,
}

impl ReachTask {
    /// Distance between hand and goal, m.
    pub fn distance(&self, state: &SVector<f64, STATE>) -> f64 {
        (state.fixed_rows::<3>(2 * JOINTS) - self.goal).norm()
    }

    /// A first guess of `steps` actions from `start`: straight to the goal, slower from 5 cm on.
    pub fn guess(&self, start: &SVector<f64, STATE>, steps: usize) -> Vec<Vector3<f64>> {
        let mut state = *start;
        let step = |_| {
            let way = (self.goal - state.fixed_rows::<3>(2 * JOINTS)) / MAX_LEAD;
            let action = way / way.norm().max(1.0);
            state = self.arm.step(&state, &action);
            action
        };
        (0..steps).map(step).collect()
    }

    /// In square decimetres.
    fn square<S: RealField + Copy>(&self, state: &SVector<S, STATE>) -> S {
        (state.fixed_rows::<3>(2 * JOINTS) - self.goal.map(convert::<f64, S>)).norm_squared() * convert(100.0)
    }
}

impl System<STATE, 3> for ReachTask {
    const READS: usize = 2 * JOINTS;

    fn step<S: RealField + Copy>(&self, state: &SVector<S, STATE>, action: &Vector3<S>) -> SVector<S, STATE> {
        self.arm.cast().step(state, action)
    }

    fn cost<S: RealField + Copy>(&self, state: &SVector<S, STATE>, action: &Vector3<S>) -> S {
        self.square(state) + action.norm_squared() * convert(0.01)
    }

    fn final_cost<S: RealField + Copy>(&self, state: &SVector<S, STATE>) -> S {
        self.square(state) * convert(10.0)
    }
}
