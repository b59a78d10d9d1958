//! Writing files atomically: whole or not at all.
//!
//! ```
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("new/table.csv");
//! handful::files::write(&path, b"a,b\n1,2\n")?;
//! assert_eq!(std::fs::read(&path)?, b"a,b\n1,2\n");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

use std::io::Write;
use std::path::Path;
use std::time::Duration;

use crate::error::{Error, Result};

/// Writes a file atomically, and creates its folder if necessary. The bytes go to a temporary file in the same folder, which
/// is then renamed, so that a crash, a full disk or Ctrl-C leaves either the old file or the new one.
///
/// # Errors
/// If the folder cannot be created, or the file cannot be written.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    let mut file = temporary().tempfile_in(folder).map_err(Error::io("write in", folder))?;
    file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(Error::io("write", path))?;
    file.persist(path).map_err(|failed| Error::io("write", path)(failed.error))?;
    Ok(())
}

/// Removes the temporary files that killed processes have left in a folder, if they are older than `age`: younger ones may be
/// another process's that is still writing. What cannot be removed stays: it is in nobody's way.
pub(crate) fn sweep(folder: &Path, age: Duration) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let ours = TEMPORARY.iter().any(|prefix| {
            let rest = name.to_str().and_then(|name| name.strip_prefix(prefix));
            rest.is_some_and(|rest| rest.len() == 6 && rest.chars().all(|c| c.is_ascii_alphanumeric()))
        });
        let since = || Ok::<_, std::io::Error>(entry.metadata()?.modified()?.elapsed().unwrap_or_default());
        if ours && since().is_ok_and(|since| since >= age) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// What the names of temporary files begin with, now and in the first edition.
const TEMPORARY: [&str; 2] = [".handful-", ".tmp"];

/// Temporary files are readable by their owner only; ours must have ordinary permissions once they are renamed.
fn temporary() -> tempfile::Builder<'static, 'static> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY[0]);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_kill_left_behind_is_swept() {
        let folder = tempfile::tempdir().expect("a folder");
        let here = folder.path();
        let killed = temporary().tempfile_in(here).expect("a file").into_temp_path().keep().expect("a file");
        let first_edition = here.join(".tmpa1B2c3");
        let others = [".tmpfile", ".tmp-a1B2c3", "table.csv"].map(|name| here.join(name));
        for file in others.iter().chain([&first_edition]) {
            std::fs::write(file, "").expect("a writable folder");
        }
        sweep(here, Duration::from_secs(3600));
        assert!(killed.exists() && first_edition.exists(), "they may be in use");
        sweep(here, Duration::ZERO);
        assert!(!killed.exists() && !first_edition.exists());
        assert!(others.iter().all(|file| file.exists()));
    }
}
