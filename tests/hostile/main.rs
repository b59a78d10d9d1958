//! What is read from files may be damaged, absurd, or made to do damage: it is used, or refused in one or two lines, and never ends
//! in a panic, a hang or an abort. `PROPTEST_CASES=10000 cargo test --test hostile` tries more than usual.

use std::sync::mpsc;
use std::time::Duration;

use handful::error::Error;
use proptest::prelude::ProptestConfig;
use proptest::test_runner::{RngAlgorithm, TestCaseError, TestRng, TestRunner};

mod checkpoint;
mod config;
mod studies;
mod tables;

/// What a case may take, on a machine that does other things as well.
const TIME_LIMIT: Duration = Duration::from_secs(60);

/// Runs as many cases as the environment variable `PROPTEST_CASES` says, always the same ones.
fn runner(default_cases: u32) -> TestRunner {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(default_cases);
    let config = ProptestConfig { cases, failure_persistence: None, max_shrink_iters: 50, ..ProptestConfig::default() };
    TestRunner::new_with_rng(config, TestRng::deterministic_rng(RngAlgorithm::ChaCha))
}

/// Does it on a thread of its own, so that a panic and a hang can be told.
fn timed<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, TestCaseError> {
    let (send, receive) = mpsc::channel();
    std::thread::spawn(move || {
        let _ = send.send(work());
    });
    receive.recv_timeout(TIME_LIMIT).map_err(|problem| match problem {
        mpsc::RecvTimeoutError::Timeout => TestCaseError::fail("a hang"),
        mpsc::RecvTimeoutError::Disconnected => TestCaseError::fail("a panic"),
    })
}

/// Whether what is said can be read at a glance.
fn brief(problem: &Error) -> bool {
    let said = problem.to_string();
    said.lines().count() <= 2 && said.len() < 1500
}
