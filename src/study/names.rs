//! Names of tasks, methods and agents: they become parts of file names, of tables and of Markdown.

use crate::error::{Error, Result};

/// With the rest of a figure's name, two of them fit into a file name.
const LONGEST: usize = 64;

/// What an identifier is. Marks at its ends would be emphasis in Markdown, or an option on the command line.
pub(crate) const NAME_RULE: &str = "a name has up to 64 letters (A to Z), digits, and `-` or `_` between them";

/// # Errors
/// If the name of a `what` is not an identifier.
pub(crate) fn check_name(what: &str, name: &str) -> Result<()> {
    let inner = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    let outer = |c: Option<char>| c.is_some_and(|c| c.is_ascii_alphanumeric());
    if outer(name.chars().next()) && outer(name.chars().last()) && name.chars().all(inner) && name.len() <= LONGEST {
        return Ok(());
    }
    Err(Error::Config(format!("`{}` cannot be the name of {what}: {NAME_RULE}", excerpt(name))))
}

/// The beginning of a text that may be anything, on one line.
pub(crate) fn excerpt(text: &str) -> String {
    let mut start: String = text.chars().take(40).collect();
    if start.len() < text.len() {
        start.push('…');
    }
    start.escape_debug().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_an_identifier() {
        for name in ["reach", "pets-learned", "size1m", "a", "0", "A_b"] {
            check_name("a task", name).expect(name);
        }
        let long = "a".repeat(65);
        for name in ["", "../x", "a/b", "a.b", "-a", "_a_", "a b", "a|b", "<b>", "größe", "a\nb", "C:", &long] {
            let problem = check_name("a task", name).expect_err(name).to_string();
            assert!(problem.contains("the name of a task") && problem.lines().count() == 1, "{problem}");
        }
    }
}
