use handful::prelude::*;
use handful::model::*;
use handful::plan::noise::ColoredNoise;
use handful::rng;
fn main() {
    let task: Task = std::env::args().nth(1).unwrap().parse().unwrap();
    let episodes: usize = std::env::args().nth(2).map_or(60, |s| s.parse().unwrap());
    let mut world = task.make();
    let spec = world.spec().clone();
    let d = spec.observation_size();
    let mut rng = rng::stream(0, "scratch");
    let policy = task.scripted_policy(TableOptions::default()).unwrap();
    let make = |world: &mut World, seeds: std::ops::Range<u64>, rng: &mut rng::Rng| {
        let mut data = ReplayBuffer::new(d, spec.action_size, 1_000_000);
        for e in seeds {
            let mut obs = world.reset(e);
            let noise = ColoredNoise::new(2.0, spec.horizon);
            let n: Vec<Vec<f64>> = (0..spec.action_size).map(|_| noise.sample(rng)).collect();
            let mix = [0.0, 0.3, 1.0][e as usize % 3];
            for t in 0..spec.horizon {
                let p = policy(&obs);
                let action: Vec<f32> = (0..spec.action_size).map(|i| ((1.0 - mix) * p[i] as f64 + (mix + 0.2) * n[i][t]).clamp(-1.0, 1.0) as f32).collect();
                let s = world.step(&action).unwrap();
                data.push(&Transition { obs: obs.clone(), action, reward: s.reward, next_obs: s.observation.clone(), terminated: false, truncated: false });
                obs = s.observation;
            }
        }
        data
    };
    let data = make(&mut world, 0..episodes as u64, &mut rng);
    let tests = make(&mut world, 100000..100030, &mut rng);
    println!("{} rows", data.len());
    let mut agent_config: PetsConfig = toml::from_str(&std::fs::read_to_string(std::env::args().nth(3).unwrap()).unwrap()).unwrap();
    agent_config.warm_up = data.len() + 1;
    let mut agent = Pets::new(&spec, std::sync::Arc::new(task.make()), agent_config, 0).unwrap();
    for r in 0..data.len() {
        let row = data.row(r);
        agent.observe(&Transition { obs: row.obs.to_vec(), action: row.action.to_vec(), reward: row.reward, next_obs: row.next_obs.to_vec(), terminated: false, truncated: false });
    }
    let t = std::time::Instant::now();
    println!("{:?} {:.1}s", agent.fit(), t.elapsed().as_secs_f64());
    let t = std::time::Instant::now();
    let mut judge = Judge::new(|| Ok(task.make())).unwrap();
    let e = judge.evaluate(&mut agent, 12, Starts::Training).unwrap();
    let s = e.summary();
    println!("success {:.2} return {:.1} +- {:.1} ms {:.1} total {:.0}s stages {:?}", s.success, s.return_mean, s.return_std, s.action_ms, t.elapsed().as_secs_f64(), e.episodes.iter().map(|e| e.stage).collect::<Vec<_>>());
}
