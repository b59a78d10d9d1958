//! Turns every chapter into a program for the tests, with the same file name and line numbers, so that compiler errors point to
//! the chapter.

use std::path::{Path, PathBuf};
use std::{env, fs};

#[path = "src/chapter.rs"]
mod chapter;

use chapter::Chapter;

fn main() {
    let chapters = Path::new(env!("CARGO_MANIFEST_DIR")).join("../chapters");
    println!("cargo::rerun-if-changed={}", chapters.display());
    println!("cargo::rerun-if-changed=src/chapter.rs");
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo names a folder")).join("chapters");
    fs::create_dir_all(&out).expect("a folder for the programs");
    let mut index = String::new();
    for chapter in Chapter::all(&chapters).expect("chapters that can be read") {
        println!("cargo::rerun-if-changed={}", chapters.join(format!("{}.md", chapter.name)).display());
        let file = out.join(format!("{}.md", chapter.name));
        fs::write(&file, chapter.program()).expect("a program written");
        let module = format!("chapter_{}", chapter.name.replace('-', "_"));
        index += &format!(
            "#[test]\nfn {module}() {{\n    {module}_program::run().unwrap();\n}}\n#[path = {file:?}]\nmod {module}_program;\n"
        );
    }
    fs::write(out.join("index.rs"), index).expect("an index written");
}
