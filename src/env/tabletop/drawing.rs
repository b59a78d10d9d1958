//! A table and the arm beside it, as the 3D replay draws them.

use super::Tabletop;
use crate::env::arm::{Pose, Primitive};
use crate::env::scene::Body;

/// The arm, its hand, the table, then what the task draws.
pub(super) fn bodies(tabletop: &Tabletop) -> Vec<Body> {
    let arm = tabletop.state.physics.arm();
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
    let [half, _] = tabletop.state.physics.table();
    let legs = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)]
        .map(|(x, y)| Primitive::cuboid([0.02, 0.02, 0.3875], [(half.x - 0.03) * x, (half.y - 0.03) * y, -0.4125]));
    let table = std::iter::once(Primitive::cuboid(half.into(), [0.0; 3])).chain(legs).collect();
    bodies.push(Body::solid("table", "#c9a97c", table));
    if tabletop.state.is_set_up() {
        bodies.extend(tabletop.task.drawn(&tabletop.state.setup));
    }
    bodies
}

/// The poses of [`bodies`].
pub(super) fn poses(tabletop: &Tabletop) -> Vec<Pose> {
    let state = &tabletop.state;
    let hand = state.physics.kinematics(&state.physics.joint_state().q).grip;
    let [_, table] = state.physics.table();
    let table = Pose::from(table);
    let objects = state.setup.objects.iter().map(|&object| state.physics.object_state(object).pose);
    let goal = state.setup.goal.map(|goal| Pose::translation(goal.x, goal.y, goal.z));
    state.physics.arm_poses().chain([hand, table]).chain(objects).chain(goal).collect()
}
