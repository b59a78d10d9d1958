//! Every chapter runs, with all that it claims.
#![allow(unused, redundant_semicolons, clippy::all)]

include!(concat!(env!("OUT_DIR"), "/chapters/index.rs"));
