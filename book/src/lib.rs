//! One source, three readings. People write `chapters/*.md`; from it come the page (mdBook), the notebook (Jupyter) and the test
//! (`cargo test`).
//!
//! | reading | made by | kept |
//! | --- | --- | --- |
//! | test | `build.rs`, when `cargo test` builds | nowhere: it is made anew |
//! | notebook | `cargo book notebooks`, which has Jupyter execute it | `notebooks/`, with what its cells answered |
//! | page | `cargo book build`, from the chapter and those answers | `target/book` |

pub mod chapter;
pub mod format;
pub mod links;
pub mod notebook;
pub mod page;
