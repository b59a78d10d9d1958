use handful::env::{arm::*, osc::*, physics::*};
use nalgebra::{UnitQuaternion, Vector3};
fn main() {
    let arm = ArmDescription::panda();
    let mut p = Physics::new(arm.clone());
    let mut osc = OperationalSpaceController::new(&arm, Goal{position: Vector3::zeros(), orientation: UnitQuaternion::identity()}, arm.home);
    let r0 = p.kinematics(&arm.home).grip.rotation;
    for step in 0..12 {
        let s = p.joint_state();
        let g = p.kinematics(&s.q).grip;
        osc.goal = Goal{ position: g.translation.vector + Vector3::x()*0.05, orientation: g.rotation };
        for i in 0..STEPS_PER_CONTROL {
            let s = p.joint_state();
            let k = p.kinematics(&s.q);
            let t = osc.torques(&k, &s.q, &s.qd);
            let damp = JointVector::from([0.1,0.1,0.1,0.1,0.1,0.01,0.01]);
            let fr = s.qd.map(|v| 0.1*v.signum());
            let pred = k.mass.cholesky().unwrap().solve(&(t - k.coriolis(&s.qd) - damp.component_mul(&s.qd) - fr));
            let f = [0,1].map(|i| (1000.0*(0.02-s.fingers[i])).clamp(-20.0,20.0));
            p.step(&t, f);
            let s2 = p.joint_state();
            let got = (s2.qd - s.qd)/TIMESTEP;
            if i%8==3 && step%3==0 { println!("{step} pred {:.3?}\n   got {:.3?}\n tau {:.2?} grav {:.2?}", pred.as_slice(), got.as_slice(), t.as_slice(), k.gravity.as_slice()); }
        }
        let k = p.kinematics(&p.joint_state().q);
        println!("pos {:.4?} rot {:.4?}", k.grip.translation.vector.as_slice(), (k.grip.rotation*r0.inverse()).scaled_axis().as_slice());
    }
}
