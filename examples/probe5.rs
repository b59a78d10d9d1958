use handful::env::{*, tabletop::*};
use handful::rng;
fn main() {
    let mut env = Task::Lift.make_with(TableOptions{horizon: Some(500), action: ActionKind::Pose, ..Default::default()}).unwrap();
    let mut r = rng::stream(1, "x");
    let t0 = std::time::Instant::now();
    let mut n = 0;
    for ep in 0..16 { env.reset(ep); for _ in 0..500 { let a: Vec<f32> = (0..7).map(|_| rng::uniform(&mut r,-1.0,1.0) as f32).collect(); env.step(&a).unwrap(); n+=1; } }
    println!("random lift {:.0} steps/s", n as f64/t0.elapsed().as_secs_f64());
}
