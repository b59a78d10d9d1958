use handful::prelude::*;
use handful::study::config::RunConfig;
fn main() {
    for seed in 0..5u64 {
        let config = RunConfig::new(Task::Pendulum, "pets", seed, None, std::env::args().nth(1).as_deref().map(std::path::Path::new)).unwrap();
        let mut world = config.world().unwrap();
        let mut agent = config.agent().unwrap();
        let mut returns = vec![];
        for e in 0..2u64 {
            let mut obs = world.reset((seed << 20) + e);
            let mut total = 0.0;
            loop {
                let action = agent.act(&obs, Mode::Explore);
                let s = world.step(&action).unwrap();
                total += s.reward;
                agent.observe(&Transition { obs, action, reward: s.reward, next_obs: s.observation.clone(), terminated: s.terminated, truncated: s.truncated });
                agent.update();
                if s.done() { break; }
                obs = s.observation;
            }
            returns.push(total);
        }
        let mut oracle = RunConfig::new(Task::Pendulum, "oracle", seed, None, None).unwrap().agent().unwrap();
        let mut upper = vec![];
        for e in 1..2u64 {
            let mut obs = world.reset((seed << 20) + e);
            let (mut total, mut first) = (0.0, true);
            loop {
                let action = { let seat = Seat { number: 0, first, obs: &obs, world: &world }; oracle.act_all(&[seat]).remove(0) };
                first = false;
                let s = world.step(&action).unwrap();
                total += s.reward;
                if s.done() { break; }
                obs = s.observation;
            }
            upper.push(total);
        }
        println!("pendulum seed {seed}: random {:.1}, then {:.1} (oracle {:.1})", returns[0], returns[1], upper[0]);
    }
}
