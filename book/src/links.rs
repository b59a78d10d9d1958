//! Broken links and missing pictures.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// Every broken reference in the pages of a folder: to a file that does not exist, or to an anchor that its page lacks.
pub fn broken(folder: &Path) -> std::io::Result<Vec<String>> {
    let mut pages = BTreeMap::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.extension().is_some_and(|kind| kind == "html") {
            pages.insert(path.clone(), fs::read_to_string(&path)?);
        }
    }
    let places: BTreeMap<&PathBuf, BTreeSet<&str>> =
        pages.iter().map(|(path, page)| (path, attributes(page, "id").collect())).collect();
    let mut broken = Vec::new();
    for (path, page) in &pages {
        for reference in attributes(page, "href").chain(attributes(page, "src")) {
            if reference.contains(':') || reference.starts_with("//") || reference.is_empty() {
                continue;
            }
            let (file, place) = reference.split_once('#').unwrap_or((reference, ""));
            let target =
                if file.is_empty() { path.clone() } else { folder.join(file.split('?').next().unwrap_or(file)) };
            let there = target.exists()
                && (place.is_empty() || places.get(&target).is_none_or(|places| places.contains(place)));
            if !there {
                broken.push(format!("{}: {reference}", path.file_name().unwrap_or_default().display()));
            }
        }
    }
    Ok(broken)
}

/// All values of an attribute, in the form in which mdBook writes it.
fn attributes<'a>(page: &'a str, name: &str) -> impl Iterator<Item = &'a str> {
    let opening = format!(" {name}=\"");
    let mut rest = page;
    std::iter::from_fn(move || {
        let at = rest.find(&opening)? + opening.len();
        let value = &rest[at..];
        let end = value.find('"')?;
        rest = &value[end..];
        Some(&value[..end])
    })
}
