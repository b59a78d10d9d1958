//! The numbers of a run as an event file of TensorBoard: `tensorboard --logdir runs` shows them while it trains.
//!
//! An event file is a sequence of records (length, checksum, bytes, checksum), each of which holds an `Event` in the wire
//! format of Protocol Buffers. Scalars need five of its fields, and no other kind of event is written here.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use super::records::Progress;
use crate::error::{Error, Result};

/// TensorBoard reads files whose names contain `tfevents`.
const FILE: &str = "events.out.tfevents.handful";
const VERSION: &str = "brain.Event:2";

/// Brings the event file of a run's folder up to date. TensorBoard keeps the file open and reads what is added at its end; so
/// records are appended, unless what is there belongs to another course of the run (a checkpoint was lost): then it is replaced.
///
/// # Errors
/// If the file cannot be written.
pub(super) fn write(folder: &Path, progress: &Progress) -> Result<()> {
    let path = folder.join(FILE);
    let there = fs::read(&path).unwrap_or_default();
    let bytes = events(progress, began(&there).unwrap_or_else(|| now() - progress.seconds));
    let (rest, append) = match bytes.strip_prefix(there.as_slice()) {
        Some(rest) => (rest, true),
        None => (bytes.as_slice(), false),
    };
    let file = OpenOptions::new().create(true).write(true).append(append).truncate(!append).open(&path);
    file.and_then(|mut file| file.write_all(rest)).map_err(Error::io("write", &path))
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// When a run began, in seconds since 1970: the time in the first event of its file.
fn began(file: &[u8]) -> Option<f64> {
    // Behind the record's length and checksum, and the field's tag.
    Some(f64::from_le_bytes(file.get(13..21)?.try_into().ok()?)).filter(|time| time.is_finite())
}

/// All events of a run that began at this time.
fn events(progress: &Progress, began: f64) -> Vec<u8> {
    let mut scalars: Vec<(usize, String, f64)> = Vec::new();
    for row in &progress.episodes {
        scalars.push((row.step, "training/return".into(), row.total));
        scalars.push((row.step, "training/success".into(), f64::from(row.success)));
    }
    for row in &progress.losses {
        scalars.push((row.step, format!("loss/{}", row.name), f64::from(row.value)));
    }
    for row in &progress.evaluations {
        let summary = &row.summary;
        scalars.push((row.step, "evaluation/success".into(), summary.success));
        scalars.push((row.step, "evaluation/return".into(), summary.return_mean));
        scalars.push((row.step, "evaluation/ms_per_action".into(), summary.action_ms));
        scalars.push((row.step, "evaluation/updates".into(), row.updates as f64));
        let smoothness = summary.smoothness_sparc.into_iter();
        scalars.extend(smoothness.map(|sparc| (row.step, "evaluation/sparc".into(), sparc)));
    }
    for row in &progress.model {
        let error = &row.open_loop;
        scalars.push((row.step, format!("model/rmse_{}_steps_ahead", error.horizon), error.rmse));
    }
    for row in &progress.values {
        scalars.push((row.step, "value/expected".into(), row.expected));
        scalars.push((row.step, "value/realised".into(), row.realised));
    }
    // In the order in which they came to be: what is known later is appended.
    scalars.sort_by_key(|(step, ..)| *step);
    let mut bytes = record(&event(began, 0, &string(3, VERSION)));
    let mut episodes = progress.episodes.iter().peekable();
    let mut seconds = 0.0;
    for (step, tag, value) in scalars {
        while let Some(row) = episodes.next_if(|row| row.step <= step) {
            seconds = row.seconds;
        }
        bytes.extend(record(&event(began + seconds, step as u64, &scalar(&tag, value as f32))));
    }
    bytes
}

const VARINT: u8 = 0;
const FIXED64: u8 = 1;
const BYTES: u8 = 2;
const FIXED32: u8 = 5;

/// `Event`: wall time (field 1), step (2), and what happened, already with its field number.
fn event(time: f64, step: u64, what: &[u8]) -> Vec<u8> {
    let mut event = vec![1 << 3 | FIXED64];
    event.extend(time.to_le_bytes());
    event.push(2 << 3 | VARINT);
    event.extend(varint(step));
    event.extend(what);
    event
}

/// The field `Summary` (5) of an event with one value in it: tag (1) and number (2).
fn scalar(tag: &str, value: f32) -> Vec<u8> {
    let mut scalar = string(1, tag);
    scalar.push(2 << 3 | FIXED32);
    scalar.extend(value.to_le_bytes());
    message(5, &message(1, &scalar))
}

fn string(field: u8, text: &str) -> Vec<u8> {
    message(field, text.as_bytes())
}

fn message(field: u8, bytes: &[u8]) -> Vec<u8> {
    let mut message = vec![field << 3 | BYTES];
    message.extend(varint(bytes.len() as u64));
    message.extend(bytes);
    message
}

/// Seven bits a byte, the lowest first; the highest bit says that more follow.
fn varint(mut number: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while number >= 0x80 {
        bytes.push(number as u8 | 0x80);
        number >>= 7;
    }
    bytes.push(number as u8);
    bytes
}

fn record(event: &[u8]) -> Vec<u8> {
    let length = (event.len() as u64).to_le_bytes();
    [&length[..], &masked(&length), event, &masked(event)].concat()
}

/// The checksum of a record's parts: CRC-32C, rotated and shifted, so that checksums of checksums differ.
fn masked(bytes: &[u8]) -> [u8; 4] {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::study::records::{EpisodeRow, LossRow};

    fn progress(steps: usize) -> Progress {
        let episode = |i: usize| EpisodeRow {
            step: 100 * i,
            episode: i,
            total: -1.5,
            success: true,
            length: 100,
            seconds: 2.0 * i as f64,
        };
        let loss = |i: usize| LossRow { step: 500 * i, name: "critic_loss".into(), value: 0.25 };
        Progress {
            episodes: (1..=steps / 100).map(episode).collect(),
            losses: (1..=steps / 500).map(loss).collect(),
            ..Progress::default()
        }
    }

    /// What the writer of TensorBoard 2.21 wrote for a loss of 0.25 at step 500 and time 1.5.
    #[test]
    fn a_record_has_tensorboards_bytes() {
        let theirs = [
            27, 0, 0, 0, 0, 0, 0, 0, 26, 13, 158, 19, 9, 0, 0, 0, 0, 0, 0, 248, 63, 16, 244, 3, 42, 13, 10, 11, 10, 4,
            108, 111, 115, 115, 21, 0, 0, 128, 62, 199, 159, 154, 145,
        ];
        assert_eq!(record(&event(1.5, 500, &scalar("loss", 0.25))), theirs);
    }

    #[test]
    fn a_file_grows_at_its_end_and_a_damaged_one_is_replaced() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, read) = (folder.path().join(FILE), || fs::read(folder.path().join(FILE)).expect("a file"));
        write(folder.path(), &progress(1000)).expect("a writable folder");
        let before = read();
        write(folder.path(), &progress(1500)).expect("a writable folder");
        let after = read();
        assert!(after.starts_with(&before) && after.len() > before.len());
        // A record that was cut off by a crash is continued; a run that lost its last steps has its file replaced.
        fs::write(&path, &after[..before.len() + 5]).expect("a writable folder");
        write(folder.path(), &progress(1500)).expect("a writable folder");
        assert!(read() == after);
        write(folder.path(), &progress(1000)).expect("a writable folder");
        assert!(read() == before);
        // Its time of beginning stays.
        fs::write(&path, [&before[..40], b"not a record"].concat()).expect("a writable folder");
        write(folder.path(), &progress(1500)).expect("a writable folder");
        assert!(read() == after);
    }
}
