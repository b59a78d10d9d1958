//! What is read from files may be damaged, or made to do damage: it is read whole or refused in a line, never with a panic or a
//! hang. `PROPTEST_CASES=10000 cargo test --test hostile` tries more than usual, `HANDFUL_SHAKE=1` others.

mod tables;
