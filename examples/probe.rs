use handful::env::{arm::*, kinematics::*, osc::*, physics::*};
use nalgebra::{UnitQuaternion, Vector3};
fn main() {
    let arm = ArmDescription::panda();
    let model = KinematicModel::new(&arm);
    for q in [JointVector::zeros(), arm.home, JointVector::from([0.3,-0.4,0.5,-1.8,-0.6,2.0,0.7])] {
        let k = model.at(&q);
        println!("p {:?}", (k.grip.translation.vector - arm.base.translation.vector).as_slice());
        println!("R {:?}", k.grip.rotation.to_rotation_matrix().matrix().transpose().as_slice());
        println!("diag {:?} g {:?}", k.mass.diagonal().as_slice(), k.gravity.as_slice());
    }
    let k = model.at(&arm.home);
    println!("M13 {:.4} M15 {:.4} M17 {:.4} M24 {:.4} M26 {:.4} M35 {:.4} M37 {:.4} M46 {:.4} M57 {:.4}", k.mass[(0,2)],k.mass[(0,4)],k.mass[(0,6)],k.mass[(1,3)],k.mass[(1,5)],k.mass[(2,4)],k.mass[(2,6)],k.mass[(3,5)],k.mass[(4,6)]);

    for axis in 0..3 {
        let mut p = Physics::new(arm.clone());
        let mut osc = OperationalSpaceController::new(&arm, Goal{position: Vector3::zeros(), orientation: UnitQuaternion::identity()}, arm.home);
        let mut start = None; let mut last = None;
        let mut row = vec![];
        for step in 0..17 {
            let s = p.joint_state();
            let k = p.kinematics(&s.q);
            let g = last.clone().unwrap_or(k.grip);
            if start.is_none() { start = Some(g.translation.vector[axis]); }
            let mut d = Vector3::zeros();
            if step < 12 { d[axis] = if axis == 0 {-0.05} else {0.05}; }
            osc.goal = Goal{ position: g.translation.vector + d, orientation: g.rotation };
            for _ in 0..STEPS_PER_CONTROL {
                let s = p.joint_state();
                let k = p.kinematics(&s.q);
                last = Some(k.grip);
                let t = osc.torques(&k, &s.q, &s.qd);
                let f = [0,1].map(|i| (1000.0*(0.02-s.fingers[i])).clamp(-20.0,20.0));
                p.step(&t, f);
            }
            let k = p.kinematics(&p.joint_state().q);
            row.push(((k.grip.translation.vector[axis]-start.unwrap())*10000.0).round()/10.0);
        }
        println!("{axis}: {row:?}");
    }
    // gripper
    for (start, target_dir) in [(0.020833, 1.0), (0.039, -1.0)] {
        let mut p = Physics::new(arm.clone());
        p.set_joints(&arm.home, [start;2]);
        let g = p.kinematics(&arm.home).grip;
        let osc = OperationalSpaceController::new(&arm, Goal{position: g.translation.vector, orientation: g.rotation}, arm.home);
        let mut v: f64 = if target_dir > 0.0 {0.0} else {1.0};
        let mut row = vec![];
        for _ in 0..15 {
            v = (v + 0.2*target_dir).clamp(-1.0,1.0);
            let target = 0.02+0.02*v;
            for _ in 0..STEPS_PER_CONTROL {
                let s = p.joint_state();
                let k = p.kinematics(&s.q);
                let t = osc.torques(&k, &s.q, &s.qd);
                let f = [0,1].map(|i| (1000.0*(target-s.fingers[i])).clamp(-20.0,20.0));
                p.step(&t, f);
            }
            row.push((p.joint_state().fingers[0]*1e4).round()/10.0);
        }
        println!("fingers {row:?}");
    }
    // speed
    let mut p = Physics::new(arm.clone());
    let cube = p.add_box([0.02;3], 1000.0, 1.0, &Pose::translation(0.0,0.0,0.8201));
    let g = p.kinematics(&arm.home).grip;
    let osc = OperationalSpaceController::new(&arm, Goal{position: g.translation.vector, orientation: g.rotation}, arm.home);
    let t0 = std::time::Instant::now();
    let n = 200;
    for _ in 0..n*STEPS_PER_CONTROL {
        let s = p.joint_state();
        let k = p.kinematics(&s.q);
        let t = osc.torques(&k, &s.q, &s.qd);
        p.step(&t, [0.0;2]);
    }
    println!("control steps/s {}", n as f64 / t0.elapsed().as_secs_f64());
    let t0 = std::time::Instant::now();
    for _ in 0..n*STEPS_PER_CONTROL {
        let s = p.joint_state();
        let k = p.kinematics(&s.q);
        let t = osc.torques(&k, &s.q, &s.qd);
        std::hint::black_box(t);
    }
    println!("control only/s {}", n as f64 / t0.elapsed().as_secs_f64());
    println!("cube {:?}", p.object_state(cube).pose.translation);
}
