use handful::env::{*, tabletop::*};
fn main() {
    for axis in 0..3 { for seed in 0..6 {
        let mut env = Tabletop::new(&Lift, TableOptions{horizon: Some(1000), ..Default::default()});
        env.reset(seed);
        for _ in 0..40 { let a = env.scripted(); env.step(&a).unwrap(); }
        let rel = |env: &Tabletop| { let p = env.physics(); let h = p.kinematics(&p.joint_state().q).grip; let o = p.object_state(env.setup().objects[0]).pose; h.inverse() * o };
        let r0 = rel(&env);
        let mut worst: f64 = 0.0; let mut yaw: f64 = 0.0; let mut maxpen: f64=0.0; let mut nocontact=0;
        for i in 0..100 {
            let mut a = [0.0f32,0.0,0.0,1.0];
            // back and forth at full speed
            a[axis] = if (i/10)%2==0 {1.0} else {-1.0};
            env.step(&a).unwrap();
            let r = rel(&env);
            worst = worst.max((r.translation.vector - r0.translation.vector).norm());
            yaw = yaw.max((r0.rotation.inverse()*r.rotation).angle().to_degrees());
            let p = env.physics().pad_penetrations(env.setup().objects[0]); maxpen = maxpen.max(p[0]).max(p[1]);
            let f = env.physics().pad_forces(env.setup().objects[0]); if f[0]<=0.0||f[1]<=0.0 {nocontact+=1}
        }
        let f = env.physics().pad_forces(env.setup().objects[0]);
        println!("axis {axis} seed {seed} slip {:.2} mm turn {:.2} deg pen {:.2} mm force {:.1?} nocontact {nocontact} fingers {:.2?}", worst*1e3, yaw, maxpen*1e3, f, env.physics().joint_state().fingers.map(|x|x*1e3));
    }}
}
