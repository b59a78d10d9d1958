use handful::{agent::*, env::*, replay::*, rng};
use std::time::Instant;
#[global_allocator]
static A: mimalloc::MiMalloc = mimalloc::MiMalloc;
fn main() { rayon::ThreadPoolBuilder::new().build().unwrap().install(||());real() }
fn real() {
    let arg: Vec<String> = std::env::args().collect();
    if arg.len() < 2 {
        let spec = Spec { name: "b".into(), observation: (0..24).map(|i| Feature::new(format!("{i}"))).collect(), action_size: 4, horizon: 100, dt: 0.05, stages: vec![] };
        let mut sac = Sac::new(&spec, SacConfig{warm_up: 0, ..Default::default()}, 0).unwrap();
        let mut r = rng::stream(0, "x");
        let mut v = |n: usize| -> Vec<f32> { (0..n).map(|_| rng::uniform(&mut r, -1.0, 1.0) as f32).collect() };
        for _ in 0..20000 { sac.observe(&Transition{obs: v(24), action: v(4), reward: 0.5, next_obs: v(24), terminated: false, truncated: false}); }
        for _ in 0..50 { sac.update(); }
        for _ in 0..4 { let t = Instant::now(); for _ in 0..300 { sac.update(); } println!("updates/s {:.1}", 300.0/t.elapsed().as_secs_f64()); }
        let t = Instant::now(); let o = v(24); for _ in 0..1000 { sac.act(&o, Mode::Evaluate); } println!("act {:?}", t.elapsed()/1000);
        return;
    }
    let seed: u64 = arg[1].parse().unwrap();
    let mut env = Task::Pendulum.make();
    let mut sac = Sac::new(env.spec(), SacConfig{ ..Default::default()}, seed).unwrap();
    let t = Instant::now();
    let mut obs = env.reset(seed*1000); let mut ep = 0; let mut ret=0.0;
    for step in 0..10000 {
        let a = sac.act(&obs, Mode::Explore);
        let s = env.step(&a).unwrap();
        ret += s.reward;
        sac.observe(&Transition{obs: obs.clone(), action: a, reward: s.reward, next_obs: s.observation.clone(), terminated: s.terminated, truncated: s.truncated});
        let l = sac.update();
        obs = s.observation.clone();
        if s.done() { ep += 1; obs = env.reset(seed*1000+ep); if ep%5==0 { println!("step {step} ret {ret:.0} {:?} {:.1?}", l, t.elapsed()); } ret=0.0; }
    }
    let mut total = 0.0;
    for e in 0..20 { let mut o = env.reset(900000+e); loop { let a = sac.act(&o, Mode::Evaluate); let s = env.step(&a).unwrap(); total += s.reward; o = s.observation.clone(); if s.done() {break} } }
    println!("seed {seed}: mean of 20: {:.1}, {:.1?}", total/20.0, t.elapsed());
}
