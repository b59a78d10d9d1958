//! Percentiles, by which returns and values are scaled.

/// The value below which a share of `sorted` numbers lies, by linear interpolation between the closest ranks.
pub(super) fn percentile(sorted: &[f32], share: f32) -> f32 {
    let position = share * (sorted.len() - 1) as f32;
    let lower = sorted[position.floor() as usize];
    lower + position.fract() * (sorted[position.ceil() as usize] - lower)
}
