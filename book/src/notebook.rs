//! Chapters as Jupyter notebooks: generating them, reading the outputs of an execution, and detecting stale ones.

use std::path::Path;
use std::{fs, io};

use serde_json::{Value, json};

use crate::chapter::{Chapter, Part};

/// The first cell of every notebook: its dependencies, without the crates that only a study needs.
pub const SETUP: &str = ":cache 4000\n:dep handful = { path = \"..\", default-features = false, features = [\"avx512\", \"figures\"] }\n:dep nalgebra = \"0.35\"\n";

/// The output of a cell.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Answer {
    /// What it printed.
    pub text: String,
    /// The figures that it showed, as HTML or SVG.
    pub shown: Vec<String>,
}

/// The notebook of a chapter, without outputs.
pub fn generate(chapter: &Chapter) -> Value {
    let mut cells = vec![code_cell("setup", SETUP, false)];
    for (i, part) in chapter.parts.iter().enumerate() {
        let id = format!("{}-{i}", chapter.name);
        cells.push(match part {
            Part::Text(text) => json!({
                "cell_type": "markdown", "id": id, "metadata": {}, "source": lines(&unfolded(text)),
            }),
            Part::Cell { code, folded, .. } => code_cell(&id, code, *folded),
        });
    }
    json!({
        "cells": cells,
        "metadata": {
            "kernelspec": { "display_name": "Rust", "language": "rust", "name": "rust" },
            "language_info": { "file_extension": ".rs", "mimetype": "text/rust", "name": "Rust" },
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    })
}

fn code_cell(id: &str, code: &str, folded: bool) -> Value {
    let metadata = if folded { json!({ "jupyter": { "source_hidden": true } }) } else { json!({}) };
    json!({
        "cell_type": "code", "execution_count": null, "id": id, "metadata": metadata, "outputs": [],
        "source": lines(code.trim_end()),
    })
}

/// In Jupyter, `<details>` cannot extend over several cells, so it is removed here; the code cell itself is folded instead.
/// GitHub's alerts (`> [!NOTE]`), which Jupyter does not know, become quotations.
fn unfolded(text: &str) -> String {
    let dropped = |line: &str| line == "</details>" || line.starts_with("> [!");
    let kept = text.lines().filter(|line| !dropped(line)).map(|line| {
        match line.strip_prefix("<details>").and_then(|line| line.trim().strip_prefix("<summary>")) {
            Some(summary) => format!("**{}** (unfold the cell below)", summary.trim_end_matches("</summary>")),
            None => line.to_string(),
        }
    });
    kept.collect::<Vec<_>>().join("\n").trim().to_string()
}

fn lines(text: &str) -> Value {
    text.split_inclusive('\n').map(Value::from).collect()
}

fn joined(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(lines) => lines.iter().filter_map(Value::as_str).collect(),
        _ => String::new(),
    }
}

/// Copies the outputs (and nothing else) from an executed notebook with the same cells.
pub fn with_answers(mut generated: Value, executed: &Value) -> Value {
    let is_code = |cell: &&Value| cell["cell_type"] == "code";
    let executed = executed["cells"].as_array().into_iter().flatten().filter(is_code);
    let cells = generated["cells"].as_array_mut().into_iter().flatten();
    for (cell, executed) in cells.filter(|cell| cell["cell_type"] == "code").zip(executed) {
        cell["execution_count"] = executed["execution_count"].clone();
        let outputs = executed["outputs"].as_array().into_iter().flatten();
        cell["outputs"] = outputs.filter(|output| !says_nothing(output)).map(without_noise).collect();
    }
    generated
}

/// The notebook of a chapter with its old outputs, if only the text has changed since its cells were executed.
pub fn with_new_text(chapter: &Chapter, folder: &Path) -> Option<Value> {
    let code = |notebook: &Value| -> Vec<String> {
        let cells = notebook["cells"].as_array().into_iter().flatten();
        cells.filter(|cell| cell["cell_type"] == "code").map(|cell| joined(&cell["source"])).collect()
    };
    let old = read(&folder.join(format!("{}.ipynb", chapter.name))).ok()?;
    let new = generate(chapter);
    let cells = old["cells"].as_array().into_iter().flatten();
    let executed = cells.filter(|cell| cell["cell_type"] == "code").all(|cell| !cell["execution_count"].is_null());
    (executed && code(&old) == code(&new)).then(|| with_answers(new, &old))
}

/// A cell that ends in a loop has the value `()`, which is not worth showing.
fn says_nothing(output: &Value) -> bool {
    joined(&output["data"]["text/plain"]).trim() == "()"
}

/// The output without what differs from run to run, such as timestamps in its metadata.
fn without_noise(output: &Value) -> Value {
    let mut output = output.clone();
    if let Some(fields) = output.as_object_mut() {
        fields.remove("metadata");
        if fields["output_type"] != "stream" && fields["output_type"] != "error" {
            fields.insert("metadata".into(), json!({}));
        }
    }
    output
}

/// Why a notebook is out of date, if it is.
pub fn complaint(chapter: &Chapter, folder: &Path) -> Option<String> {
    let mend = format!("run `cargo book notebooks {}`", chapter.name);
    let path = folder.join(format!("{}.ipynb", chapter.name));
    let Ok(notebook) = read(&path) else {
        return Some(format!("notebooks/{}.ipynb is missing or damaged: {mend}", chapter.name));
    };
    let sources = |notebook: &Value| -> Vec<(String, String)> {
        let cells = notebook["cells"].as_array().cloned().unwrap_or_default();
        cells.iter().map(|cell| (joined(&cell["cell_type"]), joined(&cell["source"]))).collect()
    };
    if sources(&notebook) != sources(&generate(chapter)) {
        return Some(format!("notebooks/{0}.ipynb is older than chapters/{0}.md: {mend}", chapter.name));
    }
    let silent = notebook["cells"].as_array().into_iter().flatten();
    let silent = silent.filter(|cell| cell["cell_type"] == "code" && cell["execution_count"].is_null()).count();
    (silent > 0).then(|| format!("notebooks/{}.ipynb has {silent} cells that were not executed: {mend}", chapter.name))
}

/// The first failure in an executed notebook, if there is one. The kernel may report a panic, or an error that leaves a cell
/// through `?`, as "ok", so this reads what the cells wrote to stderr as well.
pub fn failure(executed: &Value) -> Option<String> {
    for (i, cell) in executed["cells"].as_array().into_iter().flatten().enumerate() {
        for output in cell["outputs"].as_array().into_iter().flatten() {
            let text = joined(&output["text"]);
            // Instead of drawing a chart or a replay, the kernel prints its `Debug` form if the cell moved a variable into it.
            let plain = joined(&output["data"]["text/plain"]);
            let undrawn = ["Chart {", "Recording {"].iter().any(|form| plain.starts_with(form));
            let wrong = undrawn
                || output["output_type"] == "error"
                || output["name"] == "stderr" && (text.contains("panicked at") || text.contains("terminated with"));
            if wrong {
                let said = match text.is_empty() {
                    _ if undrawn => {
                        "the chart or replay as text instead of a picture: pass clones of the notebook's variables to it".into()
                    }
                    true => joined(&output["traceback"]),
                    false => text,
                };
                return Some(format!("cell {i}:\n{}\nfailed:\n{said}", joined(&cell["source"])));
            }
        }
    }
    None
}

/// The outputs of a chapter's cells, in order.
pub fn answers(notebook: &Value) -> Vec<Answer> {
    let cells = notebook["cells"].as_array().into_iter().flatten();
    cells.filter(|cell| cell["cell_type"] == "code").skip(1).map(answer).collect()
}

fn answer(cell: &Value) -> Answer {
    let mut answer = Answer::default();
    for output in cell["outputs"].as_array().into_iter().flatten() {
        if output["output_type"] == "stream" {
            if output["name"] == "stdout" {
                answer.text += &joined(&output["text"]);
            }
            continue;
        }
        let data = &output["data"];
        if let Some(picture) = ["text/html", "image/svg+xml"].iter().find_map(|kind| data.get(kind)) {
            answer.shown.push(joined(picture));
        } else if let Some(text) = data.get("text/plain") {
            answer.text += &joined(text);
            answer.text.push('\n');
        }
    }
    answer
}

/// Reads a notebook.
///
/// # Errors
/// If the file cannot be read, or is not JSON.
pub fn read(path: &Path) -> io::Result<Value> {
    Ok(serde_json::from_str(&fs::read_to_string(path)?)?)
}

/// Writes a notebook as Jupyter does: indented by one space, with a final newline.
///
/// # Errors
/// If it cannot be written.
pub fn write(path: &Path, notebook: &Value) -> io::Result<()> {
    let mut text = Vec::new();
    let indented = serde_json::ser::PrettyFormatter::with_indent(b" ");
    let mut serializer = serde_json::Serializer::with_formatter(&mut text, indented);
    serde::Serialize::serialize(notebook, &mut serializer)?;
    text.push(b'\n');
    fs::write(path, text)
}
