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

/// Temporary files are readable by their owner only; ours must have ordinary permissions once they are renamed.
fn temporary() -> tempfile::Builder<'static, 'static> {
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder
}
