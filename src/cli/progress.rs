//! Progress on the terminal: a bar for each run that is under way; where there is no terminal, a line for each
//! evaluation.

use std::fmt::Write;
use std::path::PathBuf;
use std::sync::Mutex;
use std::time::Duration;

use super::output::note;
use crate::error::Error;
use crate::study::config::RunConfig;
use crate::study::run::Event;
use crate::study::runner::StudyObserver;
use indicatif::{MultiProgress, ProgressBar, ProgressState, ProgressStyle};

/// Shows how the runs of a study go.
pub(super) struct Progress {
    bars: MultiProgress,
    runs: Vec<Mutex<Shown>>,
    on_terminal: bool,
}

/// What is shown of a run.
struct Shown {
    name: String,
    bar: Option<ProgressBar>,
    last_return: Option<f64>,
    success: Option<f64>,
    tested: Option<String>,
}

impl Progress {
    /// For these runs.
    pub(super) fn new(runs: &[(RunConfig, PathBuf)]) -> Self {
        let shown = |config: &RunConfig| Shown {
            name: format!("{} {} seed {}", config.task, config.method, config.seed),
            bar: None,
            last_return: None,
            success: None,
            tested: None,
        };
        Self {
            bars: MultiProgress::new(),
            runs: runs.iter().map(|(config, _)| Mutex::new(shown(config))).collect(),
            on_terminal: console::user_attended_stderr(),
        }
    }

    /// Takes the bars away.
    pub(super) fn finish(&self) {
        let _ = self.bars.clear();
    }
}

impl Shown {
    fn message(&self) -> String {
        let show = |value: Option<f64>, name: &str, digits: usize| {
            value.map_or(String::new(), |v| format!("{name} {v:.digits$}  "))
        };
        let success = self.success.map_or(String::new(), |s| format!("success {:.0} %  ", 100.0 * s));
        show(self.last_return, "return", 1) + &success + self.tested.as_deref().unwrap_or_default()
    }
}

impl StudyObserver for Progress {
    fn started(&self, run: usize, config: &RunConfig, done: usize) {
        let mut shown = self.runs[run].lock().expect("no panic holds it");
        let bar = if config.learns() {
            // indicatif's own speed has no decimals to leave out.
            let speed = |state: &ProgressState, out: &mut dyn Write| {
                let _ = write!(out, "{:.0}/s", state.per_sec());
            };
            let style =
                ProgressStyle::with_template("{prefix:24} [{bar:24}] {pos}/{len} steps  {speed}  {eta} left  {msg}");
            let style = style.expect("our template").progress_chars("=> ").with_key("speed", speed);
            ProgressBar::new(config.steps as u64).with_style(style)
        } else {
            ProgressBar::new_spinner()
                .with_style(ProgressStyle::with_template("{prefix:24} {spinner} {msg}").expect("our template"))
                .with_message("testing")
        };
        let bar = self.bars.add(bar);
        bar.set_prefix(shown.name.clone());
        bar.set_position(done as u64);
        bar.reset_eta();
        bar.enable_steady_tick(Duration::from_millis(250));
        if !self.on_terminal {
            let resumed = if done > 0 { format!(", going on after {done} steps") } else { String::new() };
            note(format_args!("{}: started{resumed}", shown.name));
        }
        shown.bar = Some(bar);
    }

    fn happened(&self, run: usize, config: &RunConfig, done: usize, event: &Event) {
        let mut shown = self.runs[run].lock().expect("no panic holds it");
        let name = shown.name.clone();
        let line = match event {
            Event::Stepped => None,
            Event::EpisodeEnded(row) => {
                shown.last_return = Some(row.total);
                None
            }
            Event::Evaluated(row) => {
                shown.success = Some(row.summary.success);
                let (percent, total) = (100.0 * row.summary.success, row.summary.return_mean);
                Some(format!("{name}: {done}/{} steps, return {total:.1}, success {percent:.0} %", config.steps))
            }
            Event::Testing(episodes) => {
                let tested = format!("tested {episodes} of {}", config.test_episodes);
                let line = format!("{name}: {tested}");
                shown.tested = Some(tested);
                Some(line)
            }
            Event::Tested(test) => {
                let summary = test.summary();
                let percent = 100.0 * summary.success;
                Some(format!("{name}: tested in {} episodes, success {percent:.0} %", summary.episodes))
            }
        };
        if let Some(bar) = &shown.bar {
            bar.set_position(done as u64);
            if !matches!(event, Event::Stepped) {
                bar.set_message(shown.message());
            }
            if let Event::Tested(_) = event {
                bar.finish_and_clear();
                if self.on_terminal {
                    let _ = self.bars.println(line.clone().unwrap_or_default());
                }
            }
        }
        if let (false, Some(line)) = (self.on_terminal, line) {
            note(line);
        }
    }

    fn failed(&self, run: usize, problem: &Error) {
        let shown = self.runs[run].lock().expect("no panic holds it");
        if let Some(bar) = &shown.bar {
            bar.finish_and_clear();
        }
        self.bars.suspend(|| note(format_args!("{} failed: {problem}", shown.name)));
    }
}
