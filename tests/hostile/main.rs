//! What is read from files may be damaged, absurd, or made to do damage: it is used, or refused in one or two lines, and never ends
//! in a panic, a hang or an abort. `PROPTEST_CASES=10000 cargo test --test hostile` tries more than usual, `HANDFUL_SHAKE=1` others.

mod config;
mod tables;
