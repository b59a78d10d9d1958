//! Keeps the three outputs of a chapter consistent: notebooks up to date, cells formatted, formulas readable; and checks the checks.

use std::path::{Path, PathBuf};

use handful_book::chapter::{Chapter, Part};
use handful_book::page::Page;
use handful_book::{format, notebook};
use serde_json::json;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn chapters() -> Vec<Chapter> {
    Chapter::all(&root().join("chapters")).expect("chapters that can be read")
}

#[test]
fn every_notebook_belongs_to_its_chapter() {
    let complaints: Vec<String> =
        chapters().iter().filter_map(|chapter| notebook::complaint(chapter, &root().join("notebooks"))).collect();
    assert!(complaints.is_empty(), "\n{}\n", complaints.join("\n"));
}

#[test]
fn every_cell_is_formatted() {
    for chapter in chapters() {
        let lines = format::unformatted(&chapter).expect("rustfmt");
        assert!(lines.is_empty(), "chapters/{}.md, cells at lines {lines:?}: run `cargo book format`", chapter.name);
    }
}

#[test]
fn every_formula_can_be_read() {
    for chapter in chapters() {
        if let Err(error) = Page::new(&chapter, &[]) {
            panic!("chapters/{}.md: {error}", chapter.name);
        }
    }
}

#[test]
fn every_chapter_is_in_the_summary_and_nothing_else_is() {
    let summary = std::fs::read_to_string(root().join("chapters/SUMMARY.md")).expect("a summary");
    for chapter in chapters() {
        assert!(summary.contains(&format!("({}.md)", chapter.name)), "{} is not in SUMMARY.md", chapter.name);
    }
    let notes = summary.matches("(notes/").count();
    assert_eq!(summary.matches(".md)").count(), chapters().len() + notes);
}

#[test]
fn a_chapter_is_taken_apart_and_its_program_keeps_the_lines() {
    let text = "# Title\n\n```rust\nlet x = 1; // one\n```\ntext\n\n```rust,ignore\nnot run\n```\n<details>\n\n```rust\nx\n```\n</details>\n";
    let chapter = Chapter::parse("t", text).expect("a chapter");
    let cells: Vec<(&str, usize, bool)> = chapter
        .parts
        .iter()
        .filter_map(|part| match part {
            Part::Cell { code, line, folded } => Some((code.as_str(), *line, *folded)),
            Part::Text(_) => None,
        })
        .collect();
    assert_eq!(cells, [("let x = 1; // one\n", 4, false), ("x\n", 14, true)]);
    let program = chapter.program();
    let lines: Vec<&str> = program.lines().collect();
    assert_eq!((lines[3], lines[4], lines[13], lines[14]), ("let x = 1; // one", ";", "x", ";"));
    assert!(!program.contains("not run"));
    let error = Chapter::parse("t", "```rust\nlet x = 1;\n").expect_err("a fence that is not closed");
    assert!(error.to_string().contains("chapters/t.md:1"), "{error}");
}

/// A planted change, a planted gap and a planted panic are each found.
#[test]
fn stale_and_failed_notebooks_are_found() {
    let folder = std::env::temp_dir().join(format!("handful-press-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let chapter = Chapter::parse("t", "# T\n\n```rust\nassert!(1 + 1 == 2);\n```\n").expect("a chapter");
    let missing = notebook::complaint(&chapter, &folder).expect("there is no notebook");
    assert!(missing.contains("cargo book notebooks t"), "{missing}");

    let mut executed = notebook::generate(&chapter);
    for (i, cell) in executed["cells"].as_array_mut().expect("cells").iter_mut().enumerate() {
        if cell["cell_type"] == "code" {
            cell["execution_count"] = json!(i + 1);
        }
    }
    let path = folder.join("t.ipynb");
    notebook::write(&path, &executed).expect("written");
    assert_eq!(notebook::complaint(&chapter, &folder), None);

    let changed = Chapter::parse("t", "# T\n\n```rust\nassert!(1 + 1 == 3);\n```\n").expect("a chapter");
    assert!(notebook::complaint(&changed, &folder).expect("stale").contains("is older than"));
    notebook::write(&path, &notebook::generate(&chapter)).expect("written");
    assert!(notebook::complaint(&chapter, &folder).expect("not executed").contains("not executed"));

    assert_eq!(notebook::failure(&executed), None);
    let panic =
        json!([{ "output_type": "stream", "name": "stderr", "text": ["thread panicked at src/lib.rs:2:1:\n"] }]);
    executed["cells"][2]["outputs"] = panic;
    assert!(notebook::failure(&executed).expect("a panic").contains("assert!(1 + 1 == 2);"));
    executed["cells"][2]["outputs"] =
        json!([{ "output_type": "execute_result", "data": { "text/plain": "Chart { x" } }]);
    assert!(notebook::failure(&executed).expect("not drawn").contains("the chart as text"));
    std::fs::remove_dir_all(&folder).expect("removed");
}
