//! The example of an agent of one's own: it learns, and what is resumed ends as if it had never stopped.

#[path = "../../examples/own_agent.rs"]
#[allow(dead_code)] // its `main`
mod own_agent;

use std::path::Path;

use handful::prelude::*;
use handful::study::run::Event;
use own_agent::{Ars, ArsConfig};

use super::mistakes::line;

const STEPS: usize = 4000;

/// Trains in a folder, to the end or for some steps.
fn train(folder: &Path, steps: usize) -> f64 {
    let registry = own_agent::registry().env(EnvEntry::new("line", || Ok(line(20))));
    let mut config = registry.config("line", "ars", 0, Some(STEPS), None).expect("a preset");
    (config.evaluate_every, config.test_episodes) = (STEPS, 20);
    let mut run = registry.open_run(&config, folder).expect("a run");
    while run.steps_done() < steps {
        run.step().expect("a healthy run");
    }
    if steps < STEPS {
        run.save().expect("a writable folder");
        return f64::NAN;
    }
    loop {
        if let Event::Tested(test) = run.step().expect("a healthy run") {
            return test.summary().return_mean;
        }
    }
}

#[test]
fn augmented_random_search_learns_and_is_resumed() {
    let mut evaluator = Evaluator::new(|| Ok(line(20))).expect("a sound spec");
    let mut resting = Ars::new(line(20).spec(), ArsConfig::default(), 0).expect("usable settings");
    let resting = evaluator.evaluate(&mut resting, 20, EvalSeeds::Test).expect("valid actions").summary().return_mean;
    let [whole, resumed] = [tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("a folder")];
    let learned = train(whole.path(), STEPS);
    println!("return {resting:.1} at rest, {learned:.1} learned");
    assert!(learned > 0.5 * resting, "{learned} {resting}");
    train(resumed.path(), 1500);
    assert_eq!(train(resumed.path(), STEPS), learned);
    let [whole, resumed] =
        [&whole, &resumed].map(|folder| std::fs::read(folder.path().join("weights.safetensors")).expect("weights"));
    assert!(whole == resumed);
}

#[test]
fn its_settings_are_checked() {
    let refused =
        |config: ArsConfig| Ars::new(line(20).spec(), config, 0).map(|_| ()).expect_err("not usable").to_string();
    let problem = refused(ArsConfig { best: 9, ..ArsConfig::default() });
    assert!(problem.contains("ars.best is 9; it must lie in 1..=8"), "{problem}");
    let problem = refused(ArsConfig { noise: 0.0, ..ArsConfig::default() });
    assert!(problem.contains("ars.noise is 0"), "{problem}");
}
