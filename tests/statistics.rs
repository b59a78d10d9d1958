//! Smoothness and statistics against numbers computed elsewhere in float64.

use handful::env::pendulum::PendulumState;
use handful::study::smoothness::{ldlj, of_path, sparc};
use handful::study::statistics::{area_under_curve, bootstrap, interquartile_mean, steps_to, wilson};
use handful::{env::cartpole::CartPoleState, rng};

fn near(what: &str, ours: f64, theirs: f64, tolerance: f64) {
    assert!((ours - theirs).abs() <= tolerance, "{what}: {ours}, expected {theirs}");
}

fn along_x(speed: &[f64]) -> Vec<[f64; 3]> {
    speed.iter().map(|v| [*v, 0.0, 0.0]).collect()
}

/// Speed of a minimum-jerk movement of duration T (s) over A (m), sampled at `rate` Hz.
fn minimum_jerk(duration: f64, distance: f64, rate: f64) -> Vec<f64> {
    let n = (duration * rate).round() as usize + 1;
    (0..n)
        .map(|i| {
            let tau = i as f64 / (n - 1) as f64;
            30.0 * distance / duration * tau.powi(2) * (1.0 - tau).powi(2)
        })
        .collect()
}

#[test]
fn smoothness_of_known_movements() {
    let bell: Vec<f64> = (0..200).map(|i| (-5.0 * (f64::from(i) / 100.0 - 1.0).powi(2)).exp()).collect();
    near("bell: SPARC", sparc(&bell, 100.0), -1.414_031_26, 1e-7);
    near("bell: LDLJ", ldlj(&along_x(&bell), 100.0), -5.816_357_41, 1e-7);
    for (duration, distance, rate, spectral, jerk) in [
        (1.0, 1.0, 100.0, -1.405_829_32, -5.301_633_25),
        (2.0, 0.3, 20.0, -1.400_500_56, -5.269_524_42),
        (1.0, 0.5, 1000.0, -1.402_426_06, -5.320_029_89),
    ] {
        let speed = minimum_jerk(duration, distance, rate);
        near("minimum jerk: SPARC", sparc(&speed, rate), spectral, 1e-7);
        near("minimum jerk: LDLJ", ldlj(&along_x(&speed), rate), jerk, 1e-7);
    }
    // Tremor of 8 Hz: small ones stay below SPARC's threshold, LDLJ sees them all.
    for (tremor, spectral, jerk) in [
        (0.05, -1.405_810_30, -7.762_338_84),
        (0.15, -1.878_165_32, -9.781_943_52),
        (0.30, -2.004_585_34, -11.017_236_94),
    ] {
        let smooth = minimum_jerk(1.0, 1.0, 100.0);
        let shaking = |(i, v): (usize, &f64)| v + tremor * (std::f64::consts::TAU * 8.0 * i as f64 / 100.0).sin();
        let speed: Vec<f64> = smooth.iter().enumerate().map(shaking).collect();
        near("tremor: SPARC", sparc(&speed, 100.0), spectral, 1e-7);
        near("tremor: LDLJ", ldlj(&along_x(&speed), 100.0), jerk, 1e-7);
    }
}

#[test]
fn rest_does_not_count_as_movement() {
    let mut x = 0.0;
    let mut path = vec![[0.0; 3]; 40];
    for v in minimum_jerk(2.0, 0.3, 20.0) {
        x += v / 20.0;
        path.push([x, 0.0, 0.0]);
    }
    let moving = path[39..].to_vec();
    path.extend(vec![[x, 0.0, 0.0]; 60]);
    assert_eq!(of_path(&path, 0.05), of_path(&moving, 0.05), "waiting before and after changes nothing");
    assert_eq!(of_path(&vec![[0.1; 3]; 50], 0.05), None, "nothing moves");
}

#[test]
fn wilson_intervals() {
    let [low, high] = wilson(95, 100);
    near("low", low, 0.888_247, 1e-5);
    near("high", high, 0.978_462, 1e-5);
    let [low, high] = wilson(0, 20);
    assert!(low.abs() < 1e-12);
    near("none of 20", high, 0.161_125, 1e-5);
}

#[test]
fn interquartile_means() {
    near("ten", interquartile_mean(&[0.1, 0.9, 0.4, 0.7, 0.2, 0.6, 0.5, 0.3, 1.0, 0.8]), 0.55, 1e-12);
    near("outliers", interquartile_mean(&[-5.0, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 9.0]), 0.325, 1e-12);
    near("floor rule", interquartile_mean(&[3.0, 1.0, 4.0, 1.5, 9.0, 2.6]), 2.775, 1e-12);
}

#[test]
fn success_curves() {
    let steps = [0.0, 1000.0, 2000.0, 3000.0, 4000.0, 5000.0];
    let success = [0.0, 0.1, 0.4, 0.7, 0.85, 0.9];
    near("area", area_under_curve(&steps, &success), 0.5, 1e-12);
    near("steps to 80 %", steps_to(0.8, &steps, &success).expect("it gets there"), 3_666.666_666_67, 1e-6);
    assert_eq!(steps_to(0.95, &steps, &success), None);
}

#[test]
fn the_bootstrap_covers_the_mean() {
    // A 95 % interval of the mean of 30 normal numbers should hold the true mean about 19 times in 20.
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let mut rng = rng::stream(0, "bootstrap test");
    let hits = (0..200).filter(|_| {
        let values: Vec<f64> = (0..30).map(|_| rng::normal(&mut rng)).collect();
        let [low, high] = bootstrap(&values, mean, &mut rng);
        low <= 0.0 && 0.0 <= high
    });
    let hits = hits.count();
    assert!((174..=198).contains(&hits), "{hits} of 200");
}

/// Gymnasium's Pendulum-v1 from (pi - 0.1, 0.5), torques 2, -1, and 3 (which is clipped to 2).
#[test]
fn the_pendulum_is_gymnasiums() {
    let mut state = PendulumState::new(std::f64::consts::PI - 0.1, 0.5);
    for (torque, angle, speed, reward) in [
        (2.0, 3.085_336_41, 0.874_875_06, -9.280_285_87),
        (-1.0, 3.123_688_66, 0.767_045_00, -9.596_841_38),
        (3.0, 3.177_712_27, 1.080_472_28, -9.820_266_63),
    ] {
        near("reward", state.step(torque), reward, 1e-7);
        near("angle", state.angle, angle, 1e-7);
        near("speed", state.speed, speed, 1e-7);
    }
}

/// Gym's equations for one step, evaluated by hand: at rest with the pole at 0.1 rad and a push of 10 N.
#[test]
fn the_cart_pole_is_gyms() {
    let mut state = CartPoleState::new([0.0, 0.0, 0.1, 0.0]);
    state.step(10.0);
    let (sin, cos) = 0.1_f64.sin_cos();
    let temp = 10.0 / 1.1;
    let turning = (9.8 * sin - cos * temp) / (0.5 * (4.0 / 3.0 - 0.1 * cos * cos / 1.1));
    let sliding = temp - 0.05 * turning * cos / 1.1;
    near("position", state.position, 0.0, 0.0);
    near("velocity", state.velocity, 0.02 * sliding, 1e-12);
    near("angle", state.angle, 0.1, 0.0);
    near("spin", state.spin, 0.02 * turning, 1e-12);
}
