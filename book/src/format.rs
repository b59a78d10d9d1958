//! Formats each cell with rustfmt, in lines short enough for a page.

use std::io::{self, Write};
use std::process::{Command, Stdio};

use crate::chapter::{Chapter, Part};

/// Maximal width of a line in a cell.
const WIDTH: usize = 80;

/// A cell as rustfmt formats it.
///
/// # Errors
/// If rustfmt cannot be started, or cannot parse the cell.
pub fn formatted(code: &str) -> io::Result<String> {
    let config = format!("max_width={},use_small_heuristics=Max", WIDTH + 4);
    let mut rustfmt = Command::new("rustfmt")
        .args(["--edition", "2024", "--quiet", "--config", &config])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let body = format!("fn cell() {{\n{code}}}\n");
    rustfmt.stdin.take().expect("a pipe").write_all(body.as_bytes())?;
    let output = rustfmt.wait_with_output()?;
    if !output.status.success() {
        return Err(io::Error::other(String::from_utf8_lossy(&output.stderr).into_owned()));
    }
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let lines: Vec<&str> = text.lines().collect();
    let inside = &lines[1..lines.len() - 1];
    Ok(inside.iter().map(|line| format!("{}\n", line.strip_prefix("    ").unwrap_or(line))).collect())
}

/// The first lines of the cells of a chapter that are not formatted.
///
/// # Errors
/// As [`formatted`].
pub fn unformatted(chapter: &Chapter) -> io::Result<Vec<usize>> {
    let mut lines = Vec::new();
    for part in &chapter.parts {
        if let Part::Cell { code, line, .. } = part
            && formatted(code)? != *code
        {
            lines.push(*line);
        }
    }
    Ok(lines)
}

/// The text of a chapter with all cells formatted.
///
/// # Errors
/// As [`formatted`], and if a fence is not closed or names no language.
pub fn rewritten(name: &str, text: &str) -> io::Result<String> {
    let mut lines: Vec<String> = text.lines().map(String::from).collect();
    for part in Chapter::parse(name, text)?.parts.iter().rev() {
        if let Part::Cell { code, line, .. } = part {
            let from = line - 1;
            lines.splice(from..from + code.lines().count(), formatted(code)?.lines().map(String::from));
        }
    }
    Ok(lines.join("\n") + "\n")
}
