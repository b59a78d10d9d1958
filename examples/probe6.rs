use handful::env::{*, tabletop::*};
fn main() {
    for (axis, seed) in [(2usize,0),(2,1),(0,0),(0,1),(1,0)] {
        let mut env = Tabletop::new(&Lift, TableOptions{horizon: Some(1000), ..Default::default()});
        env.reset(seed);
        for _ in 0..60 { let a = env.scripted(); env.step(&a).unwrap(); }
        let rel = |env: &Tabletop| { let p = env.physics(); let h = p.kinematics(&p.joint_state().q).grip; let o = p.object_state(env.setup().objects[0]).pose; h.inverse() * o };
        let r0 = rel(&env);
        println!("axis {axis} seed {seed}");
        for i in 0..100 {
            let mut a = [0.0f32,0.0,0.0,1.0];
            if axis<3 { {let target = 0.92; let _ = target; a[axis] = if (i/10)%2==0 {1.0} else {-1.0}; if axis == 2 && env.compact()[2] < 0.9 { a[2] = 1.0 } } }
            env.step(&a).unwrap();
            if i%20==19 {
            let r = rel(&env);
            let p = env.physics();
            println!("{i} slip {:.2?} hand z {:.3} cube z {:.3} f {:.1?} table {:.1} turn {:.2} fing {:.2?}", ((r.translation.vector - r0.translation.vector)*1e3).as_slice(), env.compact()[2], env.compact()[12], p.pad_forces(env.setup().objects[0]), p.table_force(env.setup().objects[0]), (r0.rotation.inverse()*r.rotation).angle().to_degrees(), p.joint_state().fingers.map(|x|x*1e3));
            }
        }
    }
}
