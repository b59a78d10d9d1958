use handful::{agent::*, env::*, env::tabletop::*, replay::*};
use std::time::Instant;
#[global_allocator]
static A: mimalloc::MiMalloc = mimalloc::MiMalloc;
fn main() {
    let arg: Vec<String> = std::env::args().collect();
    let task: Task = arg[1].parse().unwrap();
    let seed: u64 = arg[2].parse().unwrap();
    let steps: usize = arg[3].parse().unwrap();
    let cfg: SacConfig = toml::from_str(&arg[4]).unwrap();
    let horizon = arg.get(5).map(|x| x.parse().unwrap());
    let mk = || task.make_with(TableOptions{horizon, ..Default::default()}).unwrap();
    let mut env = mk();
    let mut sac = Sac::new(env.spec(), cfg, seed).unwrap();
    let t = Instant::now();
    let mut obs = env.reset(seed*1000000); let mut ep = 0;
    let mut ev = mk();
    for step in 1..=steps {
        let a = sac.act(&obs, Mode::Explore);
        let s = env.step(&a).unwrap();
        sac.observe(&Transition{obs: obs.clone(), action: a, reward: s.reward, next_obs: s.observation.clone(), terminated: s.terminated, truncated: s.truncated});
        let l = sac.update();
        obs = s.observation.clone();
        if s.done() { ep += 1; obs = env.reset(seed*1000000+ep); }
        if step % (steps/20) == 0 {
            let (mut wins, mut ret, mut stages) = (0, 0.0, [0usize;6]);
            for e in 0..30 { let mut o = ev.reset(90000000+e); let mut top=0; loop { let a = sac.act(&o, Mode::Evaluate); let s = ev.step(&a).unwrap(); ret += s.reward; top=top.max(s.stage); o = s.observation.clone(); if s.done() { if s.success {wins+=1}; break} } for k in 0..=top {stages[k]+=1} }
            let l = l.unwrap_or_default();
            println!("{task} {seed} step {step} success {wins}/30 stages {stages:?} ret {:.1} entropy {:.2} temp {:.4} q {:.2} closs {:.4} {:.1?}", ret/30.0, l.get("entropy").unwrap_or(&0.0), l.get("temperature").unwrap_or(&0.0), l.get("q").unwrap_or(&0.0), l.get("critic_loss").unwrap_or(&0.0), t.elapsed());
        }
    }
}
