//! Elementary functions whose loops vectorise.

/// 1 / (1 + exp(-x)).
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// The exponential function with a relative error of 3e-7, written so that loops over it vectorise, which those over the
/// standard library's do not. Arguments are clamped to +-87.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // x = n ln 2 + r with a whole n and |r| <= ln 2 / 2; exp(r) by its series; 2^n through the exponent's bits.
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    // Adding 1.5 * 2^23 leaves the nearest whole number in a float's lowest bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 87.0);
    let rounded = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = rounded - ROUND;
    let r = n.mul_add(-LN_2_LOW, n.mul_add(-LN_2_HIGH, x));
    let mut series: f32 = 1.0 / 720.0;
    for coefficient in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        series = series.mul_add(r, coefficient);
    }
    series * f32::from_bits((rounded.to_bits() << 23).wrapping_add(1.0_f32.to_bits()))
}

/// The hyperbolic tangent, to 3e-7.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    2.0 * sigmoid(2.0 * x) - 1.0
}

/// ln(1 + exp(x)), to 1e-7 of itself or of one.
#[inline(always)]
pub fn softplus(x: f32) -> f32 {
    // ln(1 + u) = 2 artanh(u / (2 + u)) for u = exp(-|x|), by its series.
    let u = exp(-x.abs());
    let z = u / (2.0 + u);
    let square = z * z;
    let mut series: f32 = 1.0 / 13.0;
    for coefficient in [1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0] {
        series = series.mul_add(square, coefficient);
    }
    x.max(0.0) + 2.0 * z * series
}

/// max(0, x); unlike `max`, it lets NaN through.
#[inline(always)]
pub(crate) fn relu(x: f32) -> f32 {
    if x < 0.0 { 0.0 } else { x }
}

#[inline(always)]
pub(crate) fn silu(x: f32) -> f32 {
    x / (1.0 + exp(-x))
}

#[inline(always)]
pub(crate) fn silu_slope(x: f32) -> f32 {
    let s = sigmoid(x);
    s * (1.0 + x * (1.0 - s))
}

/// `x tanh(softplus(x))`, with one exponential: for e = exp(x), tanh(ln(1 + e)) = q / (q + 2) with q = e (e + 2).
#[inline(always)]
pub(crate) fn mish(x: f32) -> f32 {
    x * mish_factor(exp(x.min(MISH_IS_IDENTITY)))
}

#[inline(always)]
pub(crate) fn mish_slope(x: f32) -> f32 {
    let e = exp(x.min(MISH_IS_IDENTITY));
    let factor = mish_factor(e);
    factor + x * (1.0 - factor * factor) * (e / (1.0 + e))
}

/// From here on, [`mish`] is the identity to the last bit, and the square of the exponential is still finite.
const MISH_IS_IDENTITY: f32 = 20.0;

/// tanh(ln(1 + e)).
#[inline(always)]
fn mish_factor(e: f32) -> f32 {
    let q = e * (e + 2.0);
    q / (q + 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fast_exponential_is_exact_enough() {
        for i in -8700..=8700 {
            let x = i as f32 / 100.0;
            let truth = f64::from(x).exp();
            let error = (f64::from(exp(x)) - truth).abs() / truth;
            assert!(error < 3e-7, "exp({x}) is off by {error:e}");
        }
        for i in -200..=200 {
            let x = i as f32 / 10.0;
            let truth = f64::from(x).exp().ln_1p();
            assert!((f64::from(softplus(x)) - truth).abs() < 2e-7 * truth.max(1.0), "softplus({x})");
        }
        for i in -4000..=4000 {
            let x = i as f32 / 100.0;
            let truth = |x: f64| x * x.exp().ln_1p().tanh();
            let (y, difference) = (truth(x.into()), (truth(f64::from(x) + 1e-4) - truth(f64::from(x) - 1e-4)) / 2e-4);
            assert!((f64::from(mish(x)) - y).abs() < 1e-6 * y.abs().max(1.0), "mish({x})");
            assert!((f64::from(mish_slope(x)) - difference).abs() < 2e-6, "the slope of mish({x})");
        }
        assert!(exp(-1e9) > 0.0 && exp(1e9).is_finite());
        assert!((sigmoid(0.0) - 0.5).abs() < 1e-7 && sigmoid(-100.0) < 1e-30 && sigmoid(100.0) == 1.0);
    }
}
