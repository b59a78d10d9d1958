//! The source of a chapter: Markdown in which every fence ` ```rust ` is a cell. Cells share their state, as in a notebook.
//! A fence with anything after `rust` (` ```rust,ignore `) is shown but not run.

use std::io::{self, Error, ErrorKind};
use std::path::Path;

/// A chapter and its parts.
#[derive(Clone, Debug)]
pub struct Chapter {
    /// The file's name without `.md`: `01-hand`.
    pub name: String,
    /// Text and cells, in order.
    pub parts: Vec<Part>,
    lines: usize,
}

/// A part of a chapter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// Markdown.
    Text(String),
    /// Code that runs.
    Cell {
        /// The code, without its fence.
        code: String,
        /// The line on which the code begins, counted from 1.
        line: usize,
        /// Whether it is folded away, as the solutions of exercises are.
        folded: bool,
    },
}

impl Chapter {
    /// All chapters of a folder, in the order of their names. `SUMMARY.md` is not one.
    ///
    /// # Errors
    /// If a file cannot be read, or a fence is not closed.
    pub fn all(folder: &Path) -> io::Result<Vec<Self>> {
        let mut chapters = Vec::new();
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            let name = path.file_stem().and_then(|name| name.to_str()).unwrap_or_default();
            if path.extension().is_some_and(|kind| kind == "md") && name != "SUMMARY" {
                chapters.push(Self::parse(name, &std::fs::read_to_string(&path)?)?);
            }
        }
        chapters.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(chapters)
    }

    /// Splits a chapter into its parts.
    ///
    /// # Errors
    /// If a fence is not closed, or opens without a language.
    pub fn parse(name: &str, text: &str) -> io::Result<Self> {
        let mut parts = Vec::new();
        let mut prose = String::new();
        let mut folded = false;
        let mut lines = text.lines().enumerate();
        while let Some((at, line)) = lines.next() {
            if !line.starts_with("```") {
                folded = (folded || line.starts_with("<details")) && !line.starts_with("</details");
                prose += line;
                prose.push('\n');
                continue;
            }
            let refused = |why: &str| {
                Err(Error::new(ErrorKind::InvalidData, format!("chapters/{name}.md:{}: this fence {why}", at + 1)))
            };
            // Where the opening fence of a cell is lost, its closing fence would hide the text up to the next cell.
            if line == "```" {
                return refused("names no language; is an opening fence missing above it?");
            }
            let mut fence = String::new();
            loop {
                let Some((_, inside)) = lines.next() else { return refused("is not closed") };
                if inside == "```" {
                    break;
                }
                fence += inside;
                fence.push('\n');
            }
            if line == "```rust" {
                parts.push(Part::Text(std::mem::take(&mut prose)));
                parts.push(Part::Cell { code: fence, line: at + 2, folded });
            } else {
                prose += &format!("{line}\n{fence}```\n");
            }
        }
        parts.push(Part::Text(prose));
        parts.retain(|part| !matches!(part, Part::Text(text) if text.trim().is_empty()));
        Ok(Self { name: name.into(), parts, lines: text.lines().count() })
    }

    /// All cells as one program, each on its original lines. A cell may end in an expression, whose value a notebook shows; here
    /// it becomes a statement.
    pub fn program(&self) -> String {
        let mut lines = vec![String::new(); self.lines.max(1) + 1];
        lines[0] = "pub fn run() -> std::result::Result<(), Box<dyn std::error::Error>> {".into();
        for part in &self.parts {
            let Part::Cell { code, line, .. } = part else { continue };
            for (i, code) in code.lines().enumerate() {
                lines[line - 1 + i] = code.into();
            }
            // On the line of the closing fence, so that a comment at the cell's end cannot swallow it.
            lines[line - 1 + code.lines().count()] = ";".into();
        }
        lines[self.lines.max(1)] = "Ok(()) }".into();
        lines.join("\n") + "\n"
    }
}
