//! What comes from outside, damaged or absurd: it is used or refused in one or two lines, and never ends in a panic, a hang
//! or an abort. `PROPTEST_CASES=10000 cargo test --test hostile` looks longer.

mod config;
