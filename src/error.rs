//! What can go wrong, said so that a person can mend it.
//!
//! ```
//! use handful::prelude::*;
//!
//! let problem = Registry::standard().config("raech", "sac", 0, None, None).unwrap_err();
//! assert!(matches!(problem, Error::UnknownName { .. }));
//! assert!(problem.to_string().starts_with("unknown task `raech` (did you mean `reach`?)"));
//! ```

use std::path::{Path, PathBuf};

/// The crate's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What another library said.
pub type Cause = Box<dyn std::error::Error + Send + Sync>;

/// An error that says what was wrong, where, and what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A name that is not one of the known ones.
    #[error("unknown {what} `{name}`{}; known: {}", hint(.closest), .known.join(", "))]
    UnknownName {
        /// The kind of thing that was named.
        what: &'static str,
        /// The name that was given.
        name: String,
        /// The known name most like it, if one is near.
        closest: Option<String>,
        /// All known names.
        known: Vec<String>,
    },
    /// An action that an environment cannot take.
    #[error("{env}: {problem}")]
    Action {
        /// The environment.
        env: String,
        /// What is wrong with the action.
        problem: String,
    },
    /// An environment that breaks the contract of [`crate::env::Env`].
    #[error("{env} breaks the contract of an environment: {rule}")]
    Contract {
        /// The environment.
        env: String,
        /// The rule that was broken, and where it is known, at which step of which episode.
        rule: String,
    },
    /// An environment that failed, for instance because a simulator or a device behind it did.
    #[error("{env}: {problem}")]
    Environment {
        /// The environment.
        env: String,
        /// What went wrong.
        problem: String,
        /// What caused it.
        source: Option<Cause>,
    },
    /// A run of a study that failed, while the others went on.
    #[error("{}: {source}", .folder.display())]
    Run {
        /// The run's folder.
        folder: PathBuf,
        /// Why.
        source: Box<Error>,
    },
    /// A setting with an unusable value, or settings that do not fit together.
    #[error("{0}")]
    Config(String),
    /// A method that needs something which the task does not have: a scripted policy, snapshots, a known reward.
    #[error("{0}")]
    Unsupported(String),
    /// A configuration file or preset that cannot be read.
    #[error("{}: {problem}", .path.display())]
    ConfigFile {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
        /// What the parser said.
        source: Box<toml::de::Error>,
    },
    /// Weights or a checkpoint that are damaged, or of another run.
    #[error("{}: {problem}", .path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and what to do.
        problem: String,
        /// What caused it, if another library found it.
        source: Option<Cause>,
    },
    /// A table or a figure that cannot be read or made.
    #[error("{}: {problem}", .path.display())]
    Data {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
        /// What caused it, if another library found it.
        source: Option<Cause>,
    },
    /// The operating system said no.
    #[error("cannot {doing} {}: {source}", .path.display())]
    Io {
        /// What was being done: "read", "write", "create".
        doing: &'static str,
        /// To which file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Training that ended in NaN: what was saved before is still there.
    #[error(
        "{what} is NaN at step {step}: training has diverged; train again with a smaller learning rate, in another folder"
    )]
    Diverged {
        /// The loss, or the array of weights.
        what: String,
        /// Environment steps so far.
        step: usize,
    },
    /// Ctrl-C: the run was saved and can be resumed.
    #[error("interrupted; the same command resumes it")]
    Interrupted,
}

fn hint(closest: &Option<String>) -> String {
    closest.as_ref().map_or(String::new(), |name| format!(" (did you mean `{name}`?)"))
}

impl Error {
    /// An unknown name, with the closest of the `known` ones.
    pub fn unknown<'a>(what: &'static str, name: &str, known: impl IntoIterator<Item = &'a str>) -> Self {
        let known: Vec<String> = known.into_iter().map(String::from).collect();
        // No name of ours is that long, and the distance would take its length in time.
        let closest = if name.len() > MAX_NAME { None } else { closest(name, &known) };
        Self::UnknownName { what, name: shortened(name, MAX_NAME), closest, known }
    }

    /// An action that does not fit.
    pub fn action(env: &str, problem: impl Into<String>) -> Self {
        Self::Action { env: env.into(), problem: problem.into() }
    }

    /// An environment that failed, for the cause that another library tells.
    pub fn environment(env: &str, cause: impl Into<Cause>) -> Self {
        let cause = cause.into();
        Self::Environment { env: env.into(), problem: cause.to_string(), source: Some(cause) }
    }

    /// A checkpoint that cannot be used.
    pub fn checkpoint(path: &Path, problem: impl Into<String>, source: Option<Cause>) -> Self {
        Self::Checkpoint { path: path.into(), problem: problem.into(), source }
    }

    /// For `map_err`: a table or figure that cannot be read or made, for the cause that another library tells.
    pub fn data<C: Into<Cause>>(path: &Path) -> impl FnOnce(C) -> Self {
        let path = path.to_path_buf();
        move |cause| {
            let cause = cause.into();
            Self::Data { path, problem: cause.to_string(), source: Some(cause) }
        }
    }

    /// For `map_err`: a failed read, write or the like of `path`.
    pub fn io(doing: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self::Io { doing, path, source }
    }
}

/// Characters of a name that a message repeats.
const MAX_NAME: usize = 60;

/// Text from outside as part of a message: on one line, and no longer than `limit` characters.
pub(crate) fn shortened(text: &str, limit: usize) -> String {
    let line = |text: &str| text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    match text.char_indices().nth(limit) {
        None => line(text),
        Some((end, _)) => line(&text[..end]) + "...",
    }
}

/// The known name most like `name`, if it is near enough to be a slip.
fn closest(name: &str, known: &[String]) -> Option<String> {
    known
        .iter()
        .map(|candidate| (strsim::damerau_levenshtein(&name.to_lowercase(), candidate), candidate))
        .min()
        .filter(|(distance, candidate)| *distance <= candidate.len().max(name.len()) / 2)
        .map(|(_, candidate)| candidate.clone())
}
