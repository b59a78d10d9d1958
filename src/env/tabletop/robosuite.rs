//! robosuite 1.5's observation vector: the task's object state, then the robot's proprioception.

use nalgebra::{UnitQuaternion, Vector3};

use super::Tabletop;
use super::helpers::named_values;

/// Names and values, in robosuite's order. None if the task gives no object state.
pub(super) fn observe(tabletop: &Tabletop) -> Option<Vec<(String, f64)>> {
    tabletop.with_view(|view| {
        let joints = view.joints;
        // robosuite reports the hand body's orientation beside the grip site's: they differ by a
        // quarter turn about z.
        let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
        let hand_body = view.hand.rotation * quarter;
        let [left, right] = joints.fingers;
        let [left_v, right_v] = joints.finger_velocities;
        let mut values = tabletop.task.object_state(view)?;
        for (name, part) in [
            ("joint_pos", joints.q),
            ("joint_pos_cos", joints.q.map(f64::cos)),
            ("joint_pos_sin", joints.q.map(f64::sin)),
            ("joint_vel", joints.qd),
            ("joint_acc", tabletop.joint_acceleration(joints)),
        ] {
            values.extend(named_values(name, part.iter()));
        }
        values.extend(named_values("eef_pos", view.hand.translation.vector.iter()));
        values.extend(named_values("eef_quat", hand_body.coords.iter()));
        values.extend(named_values("eef_quat_site", view.hand.rotation.coords.iter()));
        values.extend(named_values("gripper_qpos", [left, -right].iter()));
        values.extend(named_values("gripper_qvel", [left_v, -right_v].iter()));
        Some(values)
    })
}
