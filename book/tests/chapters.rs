//! Every chapter runs, with all that it claims.
#![allow(unused, redundant_semicolons, clippy::all)]

/// As in the program `handful`.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

include!(concat!(env!("OUT_DIR"), "/chapters/index.rs"));
