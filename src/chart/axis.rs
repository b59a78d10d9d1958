//! What an axis can show: every number of a chart is checked here, and nowhere else.

/// The largest size of a number in a chart. Between it and the largest of all numbers, plotters' arithmetic overflows.
pub const LARGEST: f64 = 1e100;
/// The narrowest range, as a share of its larger end: a narrower one has no room for different ticks.
const NARROWEST: f64 = 1e-9;
/// The most labels on a logarithmic axis.
const LABELS: usize = 8;
/// How far outside of the frame a point is drawn, in lengths of the axis. A dashed line to a point much farther away would
/// take plotters hours.
const FARTHEST: f64 = 10.0;

/// The range of an axis, from left to right or from bottom to top; `low` is above `high` on a reversed axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    pub low: f64,
    pub high: f64,
    pub log: bool,
}

/// Whether a number can stand on an axis: finite, not too large, and positive if the axis is logarithmic.
pub fn fits(number: f64, log: bool) -> bool {
    number.abs() <= LARGEST && (!log || number >= 1.0 / LARGEST)
}

impl Axis {
    /// The range that was asked for; if no axis can have it, that of the numbers, with a small margin. `None` if there are
    /// no numbers either.
    pub fn new(asked: Option<[f64; 2]>, numbers: impl Iterator<Item = f64>, log: bool) -> Option<Self> {
        let usable = |[low, high]: &[f64; 2]| fits(*low, log) && fits(*high, log) && is_wide(*low, *high);
        let [low, high] = asked.filter(usable).or_else(|| span(numbers, log))?;
        Some(Self { low, high, log })
    }

    /// The numbers at a logarithmic axis: powers of ten and, if there is room, two and five times these, or all their multiples.
    pub fn log_labels(self) -> Vec<f64> {
        let [low, high] = [self.low.min(self.high), self.low.max(self.high)];
        // A little wider, because powers of ten are rounded.
        let inside = |label: &f64| (low * (1.0 - NARROWEST)..=high * (1.0 + NARROWEST)).contains(label);
        let decades = || low.log10().floor() as i32..=high.log10().ceil() as i32;
        for multiples in [(1..10).collect(), vec![1, 2, 5]] {
            let labels =
                decades().flat_map(|power| multiples.iter().map(move |times| f64::from(*times) * 10_f64.powi(power)));
            let labels: Vec<f64> = labels.filter(inside).collect();
            if labels.len() < 2 {
                return even_labels(low, high);
            }
            if labels.len() <= LABELS {
                return labels;
            }
        }
        let powers: Vec<f64> = decades().map(|power| 10_f64.powi(power)).filter(inside).collect();
        let step = powers.len().div_ceil(LABELS);
        powers.into_iter().step_by(step).collect()
    }

    /// Where a point is drawn: where it is, unless that is far outside of the frame.
    pub fn near(self, number: f64) -> f64 {
        let along = |x: f64| if self.log { x.ln() } else { x };
        let ends = [along(self.low), along(self.high)];
        let far = FARTHEST * (ends[1] - ends[0]).abs();
        let limit = |end: f64| if self.log { end.exp() } else { end };
        number.clamp(limit(ends[0].min(ends[1]) - far), limit(ends[0].max(ends[1]) + far))
    }

    /// Whether a number lies in the upper half.
    pub fn is_upper(self, number: f64) -> bool {
        let middle = if self.log { (self.low * self.high).sqrt() } else { (self.low + self.high) / 2.0 };
        (number > middle) == (self.low < self.high)
    }
}

/// As many multiples of one, two or five times a power of ten as there is room for.
fn even_labels(low: f64, high: f64) -> Vec<f64> {
    let power = 10_f64.powf((high - low).log10().floor());
    let multiples = |step: f64| -> Vec<f64> {
        let steps = (low / step).ceil() as i64..=(high / step).floor() as i64;
        steps.map(|count| count as f64 * step).collect()
    };
    let several = [power / 5.0, power / 2.0, power, 2.0 * power].map(multiples);
    several.into_iter().find(|labels| labels.len() <= LABELS).unwrap_or_default()
}

fn is_wide(low: f64, high: f64) -> bool {
    (high - low).abs() >= (NARROWEST * low.abs().max(high.abs())).max(1.0 / LARGEST)
}

/// The range of the numbers with a small margin, or `None` if there are none.
fn span(numbers: impl Iterator<Item = f64>, log: bool) -> Option<[f64; 2]> {
    let numbers = numbers.filter(|x| fits(*x, log));
    let (low, high) =
        numbers.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (f64::min(low, x), f64::max(high, x)));
    if low > high {
        return None;
    }
    if log {
        return Some([low / 1.1, high * 1.1]);
    }
    let margin = if is_wide(low, high) { 0.03 * (high - low) } else { high.abs().max(1.0) * 0.1 };
    Some([low - margin, high + margin])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_has_room_for_its_ticks() {
        let of = |asked, numbers: &[f64], log| Axis::new(asked, numbers.iter().copied(), log).map(|a| [a.low, a.high]);
        assert_eq!(of(None, &[0.0, 100.0], false), Some([-3.0, 103.0]));
        assert_eq!(of(Some([0.0, 4.0]), &[9.0], false), Some([0.0, 4.0]));
        assert_eq!(of(Some([4.0, 0.0]), &[9.0], false), Some([4.0, 0.0]), "reversed");
        for asked in
            [[f64::NAN, 1.0], [0.0, f64::INFINITY], [0.0, 1e300], [0.0, 5e-324], [1.0, 1.0], [1.0, 1.0 + 1e-12]]
        {
            assert_eq!(of(Some(asked), &[0.0, 100.0], false), Some([-3.0, 103.0]), "{asked:?}");
        }
        assert_eq!(of(None, &[1e16, 1e16 + 2.0], false), Some([0.9e16, 1.1e16 + 2.0]));
        assert_eq!(of(None, &[1e300, f64::NAN], false), None);
        assert_eq!(of(None, &[0.0, -1.0, 5e-324], true), None);
    }

    #[test]
    fn a_logarithmic_axis_has_labels() {
        let labels = |low, high| Axis { low, high, log: true }.log_labels();
        assert_eq!(labels(0.3, 4.5), [0.5, 1.0, 2.0]);
        assert_eq!(labels(4.5, 0.3), [0.5, 1.0, 2.0], "reversed");
        assert_eq!(labels(60.0, 100.0), [60.0, 70.0, 80.0, 90.0, 100.0]);
        assert_eq!(labels(1.0, 200.0), [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0]);
        assert_eq!(labels(0.5, 2e4), [1.0, 10.0, 100.0, 1e3, 1e4]);
        assert!((5..=8).contains(&labels(1.0 / LARGEST, LARGEST).len()));
        assert_eq!(labels(21.0, 29.0), [22.0, 24.0, 26.0, 28.0]);
        for (low, high) in [(3.1, 3.9), (0.45, 0.58), (110.0, 190.0), (6e-7, 6.1e-7), (9e9, 9.000_01e9)] {
            let labels = labels(low, high);
            assert!((3..=8).contains(&labels.len()), "{labels:?}");
        }
    }

    #[test]
    fn what_lies_far_outside_is_drawn_nearer() {
        let axis = Axis { low: 0.0, high: 1.0, log: false };
        assert_eq!([-0.5, 0.5, 1e100].map(|x| axis.near(x)), [-0.5, 0.5, 11.0]);
        let axis = Axis { low: 100.0, high: 10.0, log: true };
        assert_eq!([5.0, 1e9].map(|x| axis.near(x)), [5.0, 1e9]);
        assert!((axis.near(1e100).log10() - 12.0).abs() < 1e-9);
    }
}
