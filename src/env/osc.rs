//! Operational-space control (OSC): torques that make the hand behave like a critically damped spring in Cartesian space
//! (O. Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation",
//! IEEE Journal on Robotics and Automation 3(1), 1987), with the gains and conventions of robosuite's OSC_POSE.
//!
//! The torques come without the part that carries the arm's weight, since the physics switches
//! gravity off for the arm; that part still counts towards the torque limits, as in robosuite.
//!
//! ```
//! use handful::env::arm::{ArmDescription, JointVector};
//! use handful::env::kinematics::KinematicModel;
//! use handful::env::osc::{Goal, OperationalSpaceController};
//!
//! let arm = ArmDescription::panda();
//! let home = KinematicModel::new(&arm).at(&arm.home);
//! let here = Goal { position: home.grip.translation.vector, orientation: home.grip.rotation };
//! let mut controller = OperationalSpaceController::new(&arm, here, arm.home);
//! // At rest at its goal, the arm needs no torque but for its weight.
//! assert!(controller.torques(&home, &arm.home, &JointVector::zeros()).norm() < 1e-9);
//! controller.goal.position.x += 0.05;
//! assert!(controller.torques(&home, &arm.home, &JointVector::zeros()).norm() > 1.0);
//! ```

use nalgebra::{Matrix3, Matrix6, RealField, SMatrix, SVector, UnitQuaternion, Vector3, Vector6, convert};

use super::arm::{ArmDescription, JOINTS};
use super::kinematics::{Kinematics, cast_rotation};

/// Stiffness of the hand's spring per unit of inertia, 1/s2, for position and for orientation.
const STIFFNESS: f64 = 150.0;
/// Stiffness of the spring that draws the elbow to its reset posture, 1/s2.
const POSTURE_STIFFNESS: f64 = 10.0;

/// The goal of the hand: position (m) and orientation of the grip site, world frame.
#[derive(Clone, Copy, Debug)]
pub struct Goal<S: RealField = f64> {
    /// Position of the grip site.
    pub position: Vector3<S>,
    /// Orientation of the grip site.
    pub orientation: UnitQuaternion<S>,
}

/// The controller: fixed impedance, critically damped, position and orientation decoupled.
#[doc(alias = "OSC")]
#[doc(alias = "OSC_POSE")]
#[doc(alias = "Khatib")]
#[derive(Clone, Debug)]
pub struct OperationalSpaceController<S: RealField = f64> {
    /// The goal of the hand.
    pub goal: Goal<S>,
    /// The joint angles that the null space is drawn to, rad.
    pub posture: SVector<S, JOINTS>,
    max_torque: SVector<S, JOINTS>,
}

impl OperationalSpaceController {
    /// The same controller in numbers of another kind.
    pub fn cast<S: RealField + Copy>(&self) -> OperationalSpaceController<S> {
        let goal =
            Goal { position: self.goal.position.map(convert), orientation: cast_rotation(&self.goal.orientation) };
        OperationalSpaceController {
            goal,
            posture: self.posture.map(convert),
            max_torque: self.max_torque.map(convert),
        }
    }
}

impl<S: RealField + Copy> OperationalSpaceController<S> {
    /// A controller that keeps `goal` and `posture` until they are changed.
    pub fn new(arm: &ArmDescription, goal: Goal<S>, posture: SVector<S, JOINTS>) -> Self {
        let max_torque = SVector::from_iterator(arm.links.iter().map(|link| convert(link.max_torque)));
        Self { goal, posture, max_torque }
    }

    /// Joint torques (N m), beyond those that carry its weight, for the arm at joint angles `q` (rad), moving at `qd` (rad/s), whose
    /// kinematics are `at`. Motors saturate at their largest torque.
    pub fn torques(&self, at: &Kinematics<S>, q: &SVector<S, JOINTS>, qd: &SVector<S, JOINTS>) -> SVector<S, JOINTS> {
        self.torques_with(at, q, qd, &at.coriolis(qd))
    }

    /// The same for Coriolis forces (N m) that are known already.
    pub(crate) fn torques_with(
        &self,
        at: &Kinematics<S>,
        q: &SVector<S, JOINTS>,
        qd: &SVector<S, JOINTS>,
        coriolis: &SVector<S, JOINTS>,
    ) -> SVector<S, JOINTS> {
        let torque = self.operational_space_torque(at, q, qd);
        // A motor that already carries the arm has less to spare in that direction.
        let motor = (torque + coriolis + at.gravity).zip_map(&self.max_torque, |torque, max| torque.clamp(-max, max));
        motor - at.gravity
    }

    /// The operational-space torque (Khatib 1987, Eqs. 28, 51, 52 and 55), before Coriolis forces and gravity:
    ///
    /// tau = Jp' Lp Fp + Jr' Lr Fr + (I - J' L J M^-1) M a0
    ///
    /// with the operational-space inertia L = (J M^-1 J')^-1. Deviation, as in robosuite: position and orientation are
    /// decoupled, each with the inertia (Lp, Lr) that it would have without the other; only the null-space projection, which
    /// keeps the posture's acceleration a0 from moving the hand, has both together.
    fn operational_space_torque(
        &self,
        at: &Kinematics<S>,
        q: &SVector<S, JOINTS>,
        qd: &SVector<S, JOINTS>,
    ) -> SVector<S, JOINTS> {
        let (force, moment) = self.accelerations(at, qd);

        let mut jacobian = SMatrix::<S, 6, JOINTS>::zeros();
        jacobian.fixed_rows_mut::<3>(0).copy_from(&at.linear);
        jacobian.fixed_rows_mut::<3>(3).copy_from(&at.angular);
        let inverse_mass = at.mass.cholesky().expect("a mass matrix is positive definite");
        // The mobility J M^-1 J' is the inverse of the operational-space inertia; what follows solves instead of inverting.
        let mobility: Matrix6<S> = jacobian * inverse_mass.solve(&jacobian.transpose());
        let for_position: Matrix3<S> = mobility.fixed_view::<3, 3>(0, 0).into();
        let for_rotation: Matrix3<S> = mobility.fixed_view::<3, 3>(3, 3).into();

        let task =
            at.linear.transpose() * solve(for_position, force) + at.angular.transpose() * solve(for_rotation, moment);

        let posture = (self.posture - q) * convert::<f64, S>(POSTURE_STIFFNESS)
            - qd * convert::<f64, S>(2.0 * POSTURE_STIFFNESS.sqrt());
        let felt: Vector6<S> = jacobian * posture;
        let null_space = at.mass * posture - jacobian.transpose() * solve(mobility, felt);
        task + null_space
    }

    /// The linear (m/s2) and angular (rad/s2) acceleration that a critically damped spring gives the hand: Fp and Fr above.
    fn accelerations(&self, at: &Kinematics<S>, qd: &SVector<S, JOINTS>) -> (Vector3<S>, Vector3<S>) {
        let [stiffness, damping] = [STIFFNESS, 2.0 * STIFFNESS.sqrt()].map(convert::<f64, S>);
        let position_error = self.goal.position - at.grip.translation.vector;
        let rotation_error = rotation_error(&at.grip.rotation, &self.goal.orientation);
        let force = position_error * stiffness - at.linear * qd * damping;
        let moment = rotation_error * stiffness - at.angular * qd * damping;
        (force, moment)
    }
}

/// Solves `mobility x = b`. The ridge keeps a stretched-out arm, whose mobility is singular, from
/// answering with infinite forces; elsewhere it is far below the arm's own mobility (about 0.03/kg).
fn solve<S: RealField + Copy, const N: usize>(mobility: SMatrix<S, N, N>, b: SVector<S, N>) -> SVector<S, N> {
    let ridge = SMatrix::<S, N, N>::identity() * convert::<f64, S>(1e-6);
    (mobility + ridge).cholesky().expect("a mobility matrix is positive semi-definite").solve(&b)
}

/// The rotation that is missing from `now` to `goal`: sin(angle) times the axis, world frame.
fn rotation_error<S: RealField + Copy>(now: &UnitQuaternion<S>, goal: &UnitQuaternion<S>) -> Vector3<S> {
    let (now, goal) = (now.to_rotation_matrix(), goal.to_rotation_matrix());
    (0..3).map(|axis| now.matrix().column(axis).cross(&goal.matrix().column(axis))).sum::<Vector3<S>>()
        * convert::<f64, S>(0.5)
}
