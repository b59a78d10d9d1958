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
    x.max(0.0) + ln_1p(exp(-x.abs()))
}

/// `sign(x) ln(1 + |x|)`: a logarithm for both signs (Hafner et al. 2023, arXiv v1, eq. 2), to 3e-7 of itself (1e-6 above 2e38; of
/// subnormal numbers, digits are lost).
#[inline(always)]
pub fn symlog(x: f32) -> f32 {
    // 1 + |x| = 2^n (1 + f) with 1 + f between the roots of 1/2 and 2, up to where 2^-n is a normal number.
    let size = x.abs();
    let n = ((1.0 + size).to_bits() as i32 - std::f32::consts::FRAC_1_SQRT_2.to_bits() as i32) >> 23;
    let scale = f32::from_bits(((127 - n.min(126)) << 23) as u32);
    let log = ln_1p(size.mul_add(scale, scale - 1.0)) + n.min(126) as f32 * std::f32::consts::LN_2;
    // Infinity and NaN stay what they are.
    (if size < f32::INFINITY { log } else { size }).copysign(x)
}

/// ln(1 + f) for f from -0.3 to 1, and less exactly to 3.
#[inline(always)]
fn ln_1p(f: f32) -> f32 {
    // It is 2 artanh(f / (2 + f)); that by its series.
    let z = f / (2.0 + f);
    let square = z * z;
    let mut series: f32 = 1.0 / 13.0;
    for coefficient in [1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0] {
        series = series.mul_add(square, coefficient);
    }
    2.0 * z * series
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
        for i in -38_000..=38_000 {
            for x in [i as f32 / 1000.0, 10_f32.powf(i as f32 / 1000.0)] {
                let truth = f64::from(x).abs().ln_1p().copysign(x.into());
                let error = (f64::from(symlog(x)) - truth).abs();
                assert!(error <= 3e-7 * truth.abs(), "symlog({x}) is off by {error:e}");
            }
        }
        assert_eq!(symlog(-f32::INFINITY), -f32::INFINITY);
        assert!(symlog(f32::NAN).is_nan() && (symlog(f32::MAX) - 88.722_84).abs() < 2e-3);
        assert!(exp(-1e9) > 0.0 && exp(1e9).is_finite());
        assert!((sigmoid(0.0) - 0.5).abs() < 1e-7 && sigmoid(-100.0) < 1e-30 && sigmoid(100.0) == 1.0);
    }
}
