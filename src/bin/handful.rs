//! The program `handful`: the library's command line with the tasks and agents of this crate.

use std::process::ExitCode;

use handful::study::registry::Registry;

/// Training makes and drops many arrays of a quarter of a megabyte; the system's allocator would give each back to
/// the kernel and fault it in again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    handful::cli::main(&Registry::standard())
}
