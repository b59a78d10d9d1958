//! The map in `src/lib.rs` is true: a module imports only from its own layer and the layers below it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The layer of each module, as the table in `lib.rs` has it: `| layer | [`module`], ... | ... |`.
fn layers() -> BTreeMap<String, u32> {
    let text = std::fs::read_to_string("src/lib.rs").expect("the crate's root");
    let rows = text.lines().filter_map(|line| line.strip_prefix("//! | ")).filter_map(|row| {
        let mut cells = row.split('|').map(str::trim);
        let layer: u32 = cells.next()?.parse().ok()?;
        Some((layer, cells.next()?.to_string()))
    });
    let names = rows.flat_map(|(layer, modules)| {
        let names = modules.split('`').skip(1).step_by(2).map(String::from).collect::<Vec<_>>();
        names.into_iter().map(move |name| (name, layer))
    });
    names.collect()
}

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a folder of the crate") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            sources(&path, found);
        } else if path.extension().is_some_and(|ending| ending == "rs") {
            found.push(path);
        }
    }
}

/// The modules that a source file outside its tests names as `crate::module`, also in `use crate::{a::b, c}`.
fn imports(text: &str) -> Vec<String> {
    let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
    let code: String = lines.collect::<Vec<_>>().join("\n");
    let word = |text: &str| text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    let mut names = Vec::new();
    for (at, _) in code.match_indices("crate::") {
        let rest = &code[at + "crate::".len()..];
        match rest.strip_prefix('{') {
            None => names.push(word(rest)),
            Some(group) => {
                let mut depth = 0;
                for (i, c) in group.char_indices() {
                    match c {
                        '{' => depth += 1,
                        '}' if depth == 0 => break,
                        '}' => depth -= 1,
                        _ if depth == 0 && (i == 0 || group[..i].trim_end().ends_with(',')) && c.is_alphabetic() => {
                            names.push(word(&group[i..]));
                        }
                        _ => {}
                    }
                }
            }
        }
    }
    names
}

#[test]
fn a_module_imports_only_from_layers_below() {
    let layers = layers();
    assert!(layers.len() >= 14, "the map names every module: {layers:?}");
    let mut files = Vec::new();
    sources(Path::new("src"), &mut files);
    assert!(files.len() > 60, "the whole crate");
    for file in files {
        let inside = file.strip_prefix("src").expect("a file of src");
        let module = inside.components().next().expect("a name").as_os_str().to_string_lossy().replace(".rs", "");
        if ["lib", "bin"].contains(&module.as_str()) {
            continue;
        }
        let own = layers.get(&module).unwrap_or_else(|| panic!("`{module}` is not on the map in src/lib.rs"));
        for import in imports(&std::fs::read_to_string(&file).expect("a source file")) {
            if let Some(layer) = layers.get(&import) {
                assert!(layer <= own, "{}: `{module}` (layer {own}) uses `{import}` (layer {layer})", file.display());
            }
        }
    }
}

#[test]
fn imports_are_found_in_every_form() {
    let text = "use crate::plan::Planner;\nuse crate::{env::{Env, Spec}, rng};\nlet x = crate::nn::device();\n// crate::study\n#[cfg(test)]\nmod tests { use crate::agent; }";
    assert_eq!(imports(text), ["plan", "env", "rng", "nn"]);
}

/// A file that has become long holds more than one job.
#[test]
fn no_file_is_long() {
    let mut files = Vec::new();
    sources(Path::new("src"), &mut files);
    for file in files {
        let lines = std::fs::read_to_string(&file).expect("a source file").lines().count();
        assert!(lines <= 350, "{} has {lines} lines", file.display());
    }
}
