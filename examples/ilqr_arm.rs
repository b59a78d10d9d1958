//! Two planners for the task `reach`: iLQR, which plans once in the differentiable arm and leaves the rest to its feedback gains, and
//! the oracle, which plans again and again by trial in copies of the world. Both act in the world, on 100 development starts, beside
//! the task's hand-written policy, straight to the goal, which is also iLQR's first guess but for its speed.
//!
//! `cargo run --example ilqr_arm` (two minutes on one core) prints the table and writes `data/ilqr_arm.csv`.

use std::error::Error;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use handful::diff::arm::STATE;
use handful::diff::{FreeArm, Ilqr, IlqrConfig, ReachTask};
use handful::env::tabletop::{Reach, Tabletop, TabletopState};
use handful::nalgebra::{SVector, Vector3};
use handful::prelude::*;
use handful::study::smoothness;
use serde::Serialize;

const GOALS: usize = 100;
/// Control steps in an episode: 3 s.
const STEPS: usize = 60;
/// Control steps in a plan of iLQR; its last action and gains go on holding the hand.
const PLANNED: usize = 40;
/// Seconds in a control step.
const DT: f64 = 0.05;

/// The world, with a count of the steps that all its copies have made.
struct Counted {
    world: Tabletop,
    steps: Arc<AtomicUsize>,
}

impl Env for Counted {
    fn spec(&self) -> &Spec {
        self.world.spec()
    }
    fn reset(&mut self, seed: u64) -> Vec<f32> {
        self.world.reset(seed)
    }
    fn step(&mut self, action: &[f32]) -> Result<Step> {
        self.steps.fetch_add(1, Ordering::Relaxed);
        self.world.step(action)
    }
}

impl Snapshot for Counted {
    type State = TabletopState;
    fn snapshot(&self) -> TabletopState {
        self.world.snapshot()
    }
    fn restore(&mut self, state: &TabletopState) {
        self.world.restore(state);
    }
}

/// One episode.
#[derive(Default)]
struct Episode {
    /// Whether the hand is within 2 cm of the goal at the end.
    success: bool,
    /// Control steps until it was there for the first time.
    arrival: usize,
    /// Plans made, control steps simulated for them, and milliseconds.
    plans: usize,
    simulated: usize,
    milliseconds: f64,
    /// Positions of the hand, m.
    path: Vec<[f64; 3]>,
}

/// A row of the table `data/ilqr_arm.csv`.
#[derive(Serialize)]
struct Row {
    planner: &'static str,
    start: usize,
    success: bool,
    /// Until the hand was there for the first time.
    seconds: f64,
    plans: usize,
    simulated: usize,
    milliseconds: f64,
    sparc: f64,
    ldlj: f64,
}

impl Episode {
    fn row(self, planner: &'static str, start: usize) -> Row {
        let Self { success, arrival, plans, simulated, milliseconds, path } = self;
        let (sparc, ldlj) = smoothness::of_path(&path, DT).unwrap_or((f64::NAN, f64::NAN));
        Row { planner, start, success, seconds: DT * arrival as f64, plans, simulated, milliseconds, sparc, ldlj }
    }

    /// Acts from a start on; `policy` names an action for the world as it is.
    fn run(start: usize, mut policy: impl FnMut(usize, &Tabletop, &mut Self) -> Vec<f32>) -> Result<Self> {
        let mut world = Tabletop::new(Reach, TableOptions::default())?;
        world.reset(EvalSeeds::Development.seed(start)?);
        let mut episode = Self { arrival: STEPS, ..Self::default() };
        for t in 0..STEPS {
            episode.path.push(world.hand().expect("an arm has a hand"));
            let action = policy(t, &world, &mut episode);
            episode.success = world.step(&action)?.success;
            if episode.success {
                episode.arrival = episode.arrival.min(t + 1);
            }
        }
        Ok(episode)
    }
}

/// Plans at the first step; afterwards u = u* + K (x - x*).
fn ilqr(start: usize) -> Result<Episode> {
    let ilqr = Ilqr::new(IlqrConfig { iterations: 20, tolerance: 1e-3, ..IlqrConfig::default() });
    let mut planned = None;
    Episode::run(start, |t, world, episode| {
        let joints = world.physics().joint_state();
        let (task, plan) = planned.get_or_insert_with(|| {
            let task = ReachTask {
                arm: FreeArm::new(world.physics().arm(), &joints.q),
                goal: world.setup().goal.expect("reach has a goal"),
            };
            let clock = Instant::now();
            let state = task.arm.at_rest(&joints.q);
            let plan = ilqr.solve(&task, &state, &task.guess(&state, PLANNED));
            episode.milliseconds = 1e3 * clock.elapsed().as_secs_f64();
            // The guess is simulated as well.
            (episode.plans, episode.simulated) = (1, plan.steps + PLANNED);
            (task, plan)
        });
        let state: SVector<f64, STATE> = task.arm.state(&joints.q, &joints.qd);
        let t = t.min(PLANNED - 1);
        let action: Vector3<f64> = plan.actions[t] + plan.gains[t] * (state - plan.states[t]);
        action.iter().map(|a| a.clamp(-1.0, 1.0) as f32).chain([0.0]).collect()
    })
}

fn scripted(start: usize) -> Result<Episode> {
    Episode::run(start, |_, world, _| world.scripted_action(world.compact()).expect("reach has a script"))
}

fn oracle(start: usize) -> Result<Episode> {
    let config = OracleConfig::preset_for("oracle", "reach")?;
    let steps = Arc::new(AtomicUsize::new(0));
    let make = || Ok(Counted { world: Tabletop::new(Reach, TableOptions::default())?, steps: steps.clone() });
    let mut oracle = Oracle::new(make, config, start as u64)?;
    Episode::run(start, |_, world, episode| {
        let (clock, before) = (Instant::now(), steps.load(Ordering::Relaxed));
        let action = oracle.plan(0, &world.snapshot()).expect("the world goes on after its time limit");
        let simulated = steps.load(Ordering::Relaxed) - before;
        if simulated > 0 {
            episode.plans += 1;
            episode.simulated += simulated;
            episode.milliseconds += 1e3 * clock.elapsed().as_secs_f64();
        }
        action
    })
}

fn main() -> Result<(), Box<dyn Error>> {
    rayon::ThreadPoolBuilder::new().num_threads(1).build_global()?;
    println!(
        "| planner | reached | first there, s | plans | steps simulated | ms a plan | ms an episode | SPARC | LDLJ |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- | --- | --- |");
    let mut table = csv::Writer::from_path("data/ilqr_arm.csv")?;
    for planner in ["scripted", "iLQR", "oracle"] {
        let run = match planner {
            "scripted" => scripted,
            "iLQR" => ilqr,
            _ => oracle,
        };
        let rows = (0..GOALS).map(|start| Ok(run(start)?.row(planner, start))).collect::<Result<Vec<_>>>()?;
        rows.iter().try_for_each(|row| table.serialize(row))?;
        let reached = rows.iter().filter(|row| row.success).count();
        let mean = |of: &dyn Fn(&Row) -> f64| rows.iter().map(of).sum::<f64>() / GOALS as f64;
        println!(
            "| {planner} | {reached} of {GOALS} | {:.2} | {:.0} | {:.0} | {:.0} | {:.0} | {:.2} | {:.2} |",
            mean(&|row| row.seconds),
            mean(&|row| row.plans as f64),
            mean(&|row| row.simulated as f64),
            mean(&|row| row.milliseconds / row.plans.max(1) as f64),
            mean(&|row| row.milliseconds),
            mean(&|row| row.sparc),
            mean(&|row| row.ldlj)
        );
        assert!(planner != "iLQR" || reached == GOALS, "iLQR brings the arm to every goal, not to {reached}");
    }
    Ok(table.flush()?)
}
