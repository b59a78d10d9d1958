//! One source, three outputs: from `chapters/*.md` come the pages (mdBook), the notebooks (Jupyter) and the tests (`cargo test`).
//!
//! | output | made by | stored in |
//! | --- | --- | --- |
//! | test | `build.rs`, when `cargo test` builds | nothing: it is generated again |
//! | notebook | `cargo book notebooks`, which makes Jupyter execute it | `notebooks/`, with the outputs of its cells |
//! | page | `cargo book build`, from the chapter and those outputs | `target/book` |
//!
//! And `cargo book census` asks how often each test holds when all random numbers are others.

pub mod census;
pub mod chapter;
pub mod format;
pub mod links;
pub mod notebook;
pub mod page;
