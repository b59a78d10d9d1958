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
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::error::{Error, Result};

/// Writes a file atomically, and creates its folder if necessary. The bytes go to a temporary file in the same folder, which
/// is then renamed, so that a crash, a full disk or Ctrl-C leaves either the old file or the new one. A symbolic link stays: what
/// it points at is written.
///
/// # Errors
/// If the folder cannot be created, or the file cannot be written.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    write_all(&[(path, bytes)])
}

/// Writes several files that belong together: all their bytes are on the disk before the first of them is renamed, so that a full disk
/// leaves all of the old ones.
///
/// # Errors
/// As [`write`].
pub(crate) fn write_all(files: &[(&Path, &[u8])]) -> Result<()> {
    let mut written = Vec::new();
    for (path, bytes) in files {
        // A pipe or a device cannot be replaced by a file. (Links to those of a process, as /dev/stdout is one, name no file.)
        if path.metadata().is_ok_and(|there| !there.is_file() && !there.is_dir()) {
            std::fs::write(path, bytes).map_err(Error::io("write", path))?;
            continue;
        }
        let path = target(path)?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
        let mut file = temporary().tempfile_in(folder).map_err(Error::io("write in", folder))?;
        file.write_all(bytes).and_then(|()| file.as_file().sync_all()).map_err(Error::io("write", &path))?;
        written.push((file, path));
    }
    for (file, path) in written {
        file.persist(&path).map_err(|failed| Error::io("write", &path)(failed.error))?;
    }
    Ok(())
}

/// What a path points at, through symbolic links.
///
/// # Errors
/// If there are so many of them that they must form a loop.
fn target(path: &Path) -> Result<PathBuf> {
    let mut target = path.to_path_buf();
    for _ in 0..40 {
        match std::fs::read_link(&target) {
            Ok(link) => target = target.parent().unwrap_or(Path::new("")).join(link),
            Err(_) => return Ok(target),
        }
    }
    Err(Error::io("write", path)(std::io::Error::other("its symbolic links form a loop")))
}

/// Whether two paths name one folder that exists.
pub(crate) fn same_folder(a: &Path, b: &Path) -> bool {
    a.canonicalize().is_ok_and(|a| b.canonicalize().is_ok_and(|b| a == b))
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

    #[cfg(unix)]
    #[test]
    fn links_and_devices_stay_what_they_are() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().expect("a folder");
        let here = folder.path();
        let read = |name: &str| std::fs::read(here.join(name)).expect(name);
        std::fs::create_dir(here.join("elsewhere")).expect("a writable folder");
        // Relative to the folder of the link; what it points at need not be there yet.
        symlink("elsewhere/table.csv", here.join("table.csv")).expect("a link");
        symlink(here.join("table.csv"), here.join("link to link")).expect("a link");
        for text in ["one", "two"] {
            write(&here.join("link to link"), text.as_bytes()).expect("a writable folder");
            assert_eq!(read("elsewhere/table.csv"), text.as_bytes());
            assert!(here.join("table.csv").is_symlink() && here.join("link to link").is_symlink());
        }
        symlink("loop", here.join("loop")).expect("a link");
        let problem = write(&here.join("loop"), b"nowhere").expect_err("a loop").to_string();
        assert!(problem.contains("loop") && problem.contains("symbolic links"), "{problem}");
        write(Path::new("/dev/null"), b"nothing").expect("a device");
        assert!(!Path::new("/dev/null").is_file());
    }

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
