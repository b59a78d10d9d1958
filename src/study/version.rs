//! The version of the program that makes a run.

use std::path::Path;
use std::process::Command;
use std::sync::LazyLock;
use std::time::SystemTime;

/// What stands between the versions that have worked on a run, where there is more than one.
const BETWEEN: &str = ", ";

/// What the program is made of.
const SOURCES: [&str; 4] = ["src", "data/presets", "Cargo.toml", "Cargo.lock"];

/// The version of this program, with the commit of its sources if they are in a repository of their own: what `git describe` says
/// of them when the first run begins, and `-changed` if they were written to since the program was built.
pub(super) static SOURCE: LazyLock<String> = LazyLock::new(|| {
    let sources = Path::new(env!("CARGO_MANIFEST_DIR"));
    let git = |arguments: &[&str]| -> Option<String> {
        let said = Command::new("git").arg("-C").arg(sources).args(arguments).output().ok()?;
        let text = String::from_utf8(said.stdout).ok()?;
        said.status.success().then(|| text.trim().to_string())
    };
    let own = git(&["rev-parse", "--show-toplevel"]).is_some_and(|top| Path::new(&top) == sources);
    let commit = own.then(|| git(&["describe", "--always", "--dirty", "--abbrev=10"])).flatten();
    let built = std::env::current_exe().and_then(|program| program.metadata()?.modified());
    let changed = built.is_ok_and(|built| SOURCES.iter().any(|part| is_newer(&sources.join(part), built)));
    let version = env!("CARGO_PKG_VERSION");
    commit.map_or(version.into(), |commit| format!("{version} ({commit}{})", if changed { "-changed" } else { "" }))
});

/// Whether a file, or one in a folder, is newer than this time.
fn is_newer(path: &Path, time: SystemTime) -> bool {
    if path.is_dir() {
        let entries = std::fs::read_dir(path).into_iter().flatten().flatten();
        return entries.map(|entry| entry.path()).any(|path| is_newer(&path, time));
    }
    path.metadata().and_then(|there| there.modified()).is_ok_and(|modified| modified > time)
}

/// All versions that have worked on a run, as one text.
pub(super) fn joined<'a>(versions: impl IntoIterator<Item = &'a String>) -> String {
    versions.into_iter().map(String::as_str).collect::<Vec<_>>().join(BETWEEN)
}

/// The versions in a text that [`joined`] made.
#[cfg(feature = "study")]
pub(super) fn separated(versions: &str) -> impl Iterator<Item = &str> {
    versions.split(BETWEEN).filter(|version| !version.is_empty())
}

/// Whether this text names one commit from which the program was built.
#[cfg(feature = "study")]
pub(super) fn is_one_commit(version: &str) -> bool {
    version.contains('(') && !["dirty", "changed", BETWEEN].iter().any(|part| version.contains(part))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn sources_that_are_newer_than_the_program_are_found() {
        let folder = tempfile::tempdir().expect("a folder");
        let now = SystemTime::now();
        std::fs::create_dir(folder.path().join("src")).expect("a folder");
        std::fs::write(folder.path().join("src/lib.rs"), "").expect("a writable folder");
        assert!(is_newer(folder.path(), now - Duration::from_secs(60)));
        assert!(!is_newer(folder.path(), now + Duration::from_secs(60)));
    }

    #[cfg(feature = "study")]
    #[test]
    fn only_one_clean_commit_is_one() {
        assert!(is_one_commit("0.1.0 (6c8e2bc543)"));
        let two = ["0.1.0 (6c8e2bc543)", "0.1.0 (f53e5da941)"].map(String::from);
        for version in ["", "0.1.0", "0.1.0 (6c8e2bc543-dirty)", "0.1.0 (6c8e2bc543-changed)", &joined(&two)] {
            assert!(!is_one_commit(version), "{version}");
        }
    }
}
