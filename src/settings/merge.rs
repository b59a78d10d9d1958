//! One table of settings over another, and values at dotted paths.

use toml::{Table, Value};

use super::below;
use crate::error::{Error, Result, shortened};

/// Puts `over` over `base`, table by table. `choices` are the paths of tables that name a variant, like the planner:
/// another variant takes the place of the one that is there, and the same one is merged with it.
pub(crate) fn merge(base: &mut Table, over: Table, choices: &[String]) {
    merge_at("", base, over, choices);
}

fn merge_at(path: &str, base: &mut Table, over: Table, choices: &[String]) {
    if choices.iter().any(|choice| choice == path) {
        base.retain(|variant, _| over.contains_key(variant));
    }
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge_at(&below(path, &key), base, over, choices),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

/// The value at a dotted path.
pub(crate) fn value_at<'a>(table: &'a Table, path: &str) -> Option<&'a Value> {
    match path.split_once('.') {
        Some((key, rest)) => value_at(table.get(key)?.as_table()?, rest),
        None => table.get(path),
    }
}

/// # Errors
/// If a table of `choices` names more variants than one, or none.
pub(crate) fn check_choices(table: &Table, choices: &[String]) -> Result<()> {
    for path in choices {
        let variants = value_at(table, path).and_then(Value::as_table);
        if let Some(variants) = variants.filter(|variants| variants.len() != 1) {
            let named: Vec<&str> = variants.keys().map(String::as_str).collect();
            let named = if named.is_empty() { "none".into() } else { shortened(&named.join(", "), 100) };
            return Err(Error::Config(format!("`{path}` is a choice, so name exactly one variant; it names {named}")));
        }
    }
    Ok(())
}
