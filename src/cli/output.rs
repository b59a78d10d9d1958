//! What the program says. Nothing of a run is lost because nobody listens: a reader that has gone away is no error, and any
//! other failure to write an answer is told like that of a file.

use std::fmt::Display;
use std::io::{ErrorKind, Write};
use std::path::Path;

use crate::error::{Error, Result};

/// Writes an answer, and the end of the line, to standard output. `handful ... | head -1` is not interested in all of it.
///
/// # Errors
/// If it cannot be written, for instance because the disk is full.
pub(super) fn answer(text: impl Display) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(problem) if problem.kind() != ErrorKind::BrokenPipe => {
            Err(Error::io("write to", Path::new("standard output"))(problem))
        }
        _ => Ok(()),
    }
}

/// Writes a line about how things go to standard error, if that can be written at all.
pub(super) fn note(text: impl Display) {
    let _ = writeln!(std::io::stderr(), "{text}");
}
