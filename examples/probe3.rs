use handful::env::{*, tabletop::*};
use handful::rng;
fn main() {
    for (task, horizon) in [(Task::Reach, 100), (Task::Push, 150), (Task::Lift, 500), (Task::Stack, 300)] {
        let t0 = std::time::Instant::now();
        let mut env = task.make_with(TableOptions{horizon: Some(horizon), ..Default::default()}).unwrap();
        let (mut wins, mut ret, mut first, mut steps) = (0, vec![], vec![], 0);
        let mut by45=0;
        for seed in 0..100 {
            env.reset(seed);
            let mut r = 0.0; let mut at = None; let mut last = false;
            for i in 0..horizon {
                let a = env.scripted().unwrap();
                let s = env.step(&a).unwrap();
                steps += 1;
                r += s.reward;
                if s.success && at.is_none() { at = Some(i+1); }
                last = s.success;
            }
            if last { wins += 1 } else { println!("fail {seed} at {at:?}"); }
            if at.is_some_and(|x| x<=45) {by45+=1}
            ret.push(r); first.push(at.unwrap_or(999));
        }
        first.sort();
        ret.sort_by(f32::total_cmp);
        println!("{task} final {wins} by45 {by45} return {:.1}..{:.1}..{:.1} steps {} {} {}  {:.0} steps/s", ret[0], ret[50], ret[99], first[0], first[50], first[95], steps as f64/t0.elapsed().as_secs_f64());
    }
    // random
    let mut env = Task::Lift.make_with(TableOptions{horizon: Some(500), action: ActionKind::Pose, ..Default::default()}).unwrap();
    let mut r = rng::stream(1, "x");
    let t0 = std::time::Instant::now();
    let mut n = 0;
    for ep in 0..4 { env.reset(ep); let mut ret=0.0; for _ in 0..500 { let a: Vec<f32> = (0..7).map(|_| rng::uniform(&mut r,-1.0,1.0) as f32).collect(); let s = env.step(&a).unwrap(); n+=1; ret+=s.reward; assert!(s.observation.iter().all(|x| x.is_finite())); } println!("random ret {ret}"); }
    println!("random lift {:.0} steps/s", n as f64/t0.elapsed().as_secs_f64());
    let t0 = std::time::Instant::now();
    for s in 0..100 { env.reset(s); }
    println!("reset {:?}", t0.elapsed()/100);
}
