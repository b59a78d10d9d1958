//! Smoothness and statistics against numbers computed elsewhere in float64; the protocol of a comparison.

use std::path::Path;

use handful::agent::dreamer::ActorCriticConfig;
use handful::agent::{DreamerConfig, PetsConfig};
use handful::checkpoint::Weights;
use handful::env::cartpole::CartPoleState;
use handful::env::pendulum::PendulumState;
use handful::model::{EnsembleConfig, RssmConfig, WorldModelConfig};
use handful::plan::{IcemConfig, PlannerConfig};
use handful::prelude::*;
use handful::rng;
use handful::study::config::RunConfig;
use handful::study::run::Event;
use handful::study::runner::{Budget, Profile, StudyPlan};
use handful::study::smoothness::{action_change, ldlj, of_path, sparc};
use handful::study::starts::{LIMIT, Starts, training_seed};
use handful::study::statistics::{
    Time, area_under_curve, bootstrap, censored_median, falls_below_again, interquartile_mean, mean, paired_difference,
    performance_profile, probability_of_being_earlier, probability_of_improvement, ratio_of_means, ratio_t_interval,
    restricted_mean, steps_to, t_interval, two_level_bootstrap, welch_interval, wilson,
};
use rayon::prelude::*;

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
    // Sampled ever faster, the dimensionless jerk becomes that of the formula, 204.8.
    near("minimum jerk: limit", ldlj(&along_x(&minimum_jerk(1.0, 1.0, 1e4)), 1e4), -5.322_033_89, 3e-4);
    // Two movements, with one sample at rest between them.
    let half = minimum_jerk(0.5, 0.5, 100.0);
    let twice = [&half[..], &half[1..]].concat();
    near("two movements: SPARC", sparc(&twice, 100.0), -2.244_546_17, 1e-7);
    near("two movements: LDLJ", ldlj(&along_x(&twice), 100.0), -8.073_222_24, 1e-7);
    // Tremor of 8 Hz: small ones stay below SPARC's threshold, LDLJ sees them all.
    for (tremor, spectral, jerk) in [
        (0.05, -1.405_810_30, -7.762_338_84),
        (0.10, -1.405_753_29, -9.033_495_69),
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
fn changes_of_actions() {
    let actions = [[0.0, 1.0], [1.0, 1.0], [1.0, -1.0]].map(Vec::from);
    near("two numbers, two changes", action_change(&actions).expect("three actions"), 1.25_f64.sqrt(), 1e-12);
    assert_eq!((action_change(&actions[..1]), action_change(&[])), (None, None));
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
    near("nothing is dropped of three", interquartile_mean(&[0.0, 0.0, 0.9]), 0.3, 1e-12);
    near("three are kept of five", interquartile_mean(&[0.1, -5.0, 0.6, 0.2, 9.0]), 0.3, 1e-12);
    // Pooled over unequal tasks, it leaves out runs of the easiest and the hardest.
    let rates = SUCCESSES.concat().iter().map(|n| *n as f64 / 20.0).collect::<Vec<f64>>();
    near("three tasks", interquartile_mean(&rates), 0.7444, 1e-4);
    near("the mean of three tasks", mean(&rates), 0.6667, 1e-4);
}

/// Five runs each of two methods on two tasks.
#[test]
fn scores_of_two_methods() {
    let first: [[f64; 5]; 2] = [[0.2, 0.5, 0.4, 0.7, 0.3], [0.9, 0.8, 1.1, 0.6, 1.0]];
    let second: [[f64; 5]; 2] = [[0.1, 0.6, 0.2, 0.3, 0.4], [0.7, 0.8, 0.9, 0.5, 1.2]];
    for (scores, middle, profile) in [(first, 0.65, [0.8, 0.6, 0.3, 0.1]), (second, 0.55, [0.7, 0.5, 0.2, 0.1])] {
        near("interquartile mean", interquartile_mean(&scores.concat()), middle, 1e-12);
        assert_eq!(performance_profile(&scores.concat(), &[0.3, 0.5, 0.8, 1.0]), profile);
    }
    let mut rng = rng::stream(0, "improvement test");
    for (task, expected) in [0.66, 0.60].into_iter().enumerate() {
        let (better, [low, high]) = probability_of_improvement(&first[task], &second[task], &mut rng);
        near("improvement", better, expected, 1e-12);
        assert!(low < better && better < high, "{low} {high}");
    }
}

#[test]
fn success_curves() {
    let steps = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0];
    let success = [0.0, 0.1, 0.4, 0.7, 0.9, 0.95];
    near("area", area_under_curve(&steps, &success, 50.0), 0.515, 1e-12);
    near("area of a part", area_under_curve(&steps, &success, 20.0), 0.15, 1e-12);
    near("area up to a step between two", area_under_curve(&steps, &success, 25.0), 0.215, 1e-12);
    assert!(area_under_curve(&steps, &success, 60.0).is_nan(), "the curve does not reach that far");
    // By the evaluation where it is reached, not by a step between two.
    assert_eq!(steps_to(0.8, &steps, &success), Some(40.0));
    assert_eq!(steps_to(0.8, &[0.0, 500.0, 1000.0], &[0.0, 1.0, 1.0]), Some(500.0));
    assert_eq!(steps_to(0.95, &steps, &success), None, "the last evaluation has no next one");
    assert_eq!(steps_to(0.9, &steps, &success), Some(40.0));
    let falling = [0.0, 0.9, 0.5, 0.8, 0.8, 0.1];
    assert_eq!(steps_to(0.8, &steps, &falling), Some(30.0), "one high evaluation is not enough");
    assert!(falls_below_again(0.8, &steps, &falling) && !falls_below_again(0.8, &steps, &falling[..5]));
    assert!(!falls_below_again(0.9, &steps, &falling), "it has not been there");
    // Between two evaluations, a straight line would reach 0.8 at 3,667 steps.
    let steps = [0.0, 1000.0, 2000.0, 3000.0, 4000.0, 5000.0];
    let success = [0.0, 0.1, 0.4, 0.7, 0.85, 0.9];
    near("area", area_under_curve(&steps, &success, 5000.0), 0.5, 1e-12);
    assert_eq!(steps_to(0.8, &steps, &success), Some(4000.0));
}

/// The mean ends of so many intervals: those of a single one have an error from its resamples that can be larger than the tolerance.
fn on_average(count: usize, interval: impl FnMut() -> [f64; 2]) -> [f64; 2] {
    let intervals: Vec<[f64; 2]> = std::iter::repeat_with(interval).take(count).collect();
    [0, 1].map(|end| mean(&intervals.iter().map(|interval| interval[end]).collect::<Vec<_>>()))
}

/// Steps of two methods, five seeds each, in thousands, when those that do not get there count as the budget of 150.
const SLOW: [f64; 5] = [60.0, 80.0, 100.0, 120.0, 150.0];
const FAST: [f64; 5] = [40.0, 50.0, 50.0, 70.0, 90.0];

/// Two methods, five seeds each, thousands of steps, budget 150; the last seed of the first does not get there.
#[test]
fn censored_times() {
    let first = [Some(60.0), Some(80.0), Some(100.0), Some(120.0), None];
    let second = [50.0, 40.0, 90.0, 50.0, 70.0].map(Some);
    assert_eq!((censored_median(&first), censored_median(&second)), (Some(100.0), Some(50.0)));
    let means = [restricted_mean(&first, 150.0), restricted_mean(&second, 150.0)];
    assert_eq!(means, [102.0, 60.0]);
    assert_eq!(censored_median(&[Some(60.0), None, None]), None, "the median is censored itself");
    // The second is earlier in 22 of 25 pairs.
    let within = |times: &[Option<f64>], budget| {
        times.iter().map(|time| time.map_or(Time::Censored(budget), Time::Reached)).collect::<Vec<Time>>()
    };
    let mut rng = rng::stream(0, "ratio test");
    let (earlier, [low, high]) =
        probability_of_being_earlier(&within(&second, 150.0), &within(&first, 150.0), &mut rng);
    near("earlier", earlier, 0.88, 1e-12);
    assert!(low < 0.88 && low > 0.4 && high == 1.0, "{low} {high}");
    // Within a budget of 60, the last seed of the first may be earlier than those of the second that took 70 and 90.
    let (earlier, _) = probability_of_being_earlier(&within(&second, 150.0), &within(&[None], 60.0), &mut rng);
    near("earlier than one that is censored before", earlier, (3.0 + 2.0 / 2.0) / 5.0, 1e-12);
    let later = probability_of_being_earlier(&within(&[None], 60.0), &within(&second, 150.0), &mut rng).0;
    near("both ways", earlier + later, 1.0, 1e-12);
    // One that reaches the level at its last evaluation is censored there.
    assert_eq!(probability_of_being_earlier(&[Time::Reached(60.0)], &[Time::Censored(60.0)], &mut rng).0, 0.5);
    assert_eq!(probability_of_improvement(&[1.0], &[1.0, 1.0], &mut rng), (0.5, [0.5; 2]));
    near("ratio", ratio_of_means(&SLOW, &FAST, &mut rng).0, 1.7, 1e-12);
    // Exact, over all samples. The upper end of a single interval has a standard deviation of 0.014.
    let [low, high] = on_average(50, || ratio_of_means(&SLOW, &FAST, &mut rng).1);
    near("low", low, 1.154, 0.01);
    near("high", high, 2.458, 0.01);
}

/// Successes in 20 episodes of five seeds, on an easy, a middling and a hard task.
const SUCCESSES: [[usize; 5]; 3] = [[20, 20, 19, 20, 18], [17, 12, 19, 4, 15], [9, 0, 14, 2, 11]];

/// One agent's test: so many successes in 20 episodes.
fn agents(successes: [usize; 5]) -> Vec<Vec<f64>> {
    successes.map(|n| (0..20).map(|i| f64::from(i < n)).collect()).to_vec()
}

/// Expected ends: exact, by convolution.
#[test]
fn the_two_level_bootstrap_of_three_tasks() {
    let tasks = SUCCESSES.map(agents);
    let mut rng = rng::stream(0, "two-level test");
    let mut interval = |tasks: &[Vec<Vec<f64>>; 3]| {
        on_average(25, || two_level_bootstrap(&[&tasks[0], &tasks[1], &tasks[2]], &mut rng))
    };
    let [low, high] = interval(&tasks);
    near("low", low, 0.5467, 0.004);
    near("high", high, 0.7800, 0.004);
    // Seeds alone: each brings one number.
    let means = tasks.map(|seeds| seeds.iter().map(|episodes| vec![mean(episodes)]).collect::<Vec<_>>());
    let [low, high] = interval(&means);
    near("low, seeds alone", low, 0.5533, 0.004);
    near("high, seeds alone", high, 0.7700, 0.004);
    let [low, high] = wilson(200, 300);
    near("low, as if episodes were independent", low, 0.6115, 1e-4);
    near("high, as if episodes were independent", high, 0.7176, 1e-4);
}

#[test]
fn t_intervals() {
    // Mean 0.67, standard deviation 0.293, five seeds.
    let [low, high] = t_interval(&[0.85, 0.6, 0.95, 0.2, 0.75]).expect("five seeds");
    near("low", low, 0.67 - 2.776_445 * 0.292_831 / 5.0_f64.sqrt(), 1e-4);
    near("high", high, 0.67 + 2.776_445 * 0.292_831 / 5.0_f64.sqrt(), 1e-4);
    assert_eq!(t_interval(&[0.5]), None, "one seed says nothing about others");
    // More seeds than there are quantiles in a table: of the variance n / (n - 1), the mean's is 1 / (n - 1).
    for (n, quantile) in [(11, 2.228_139), (12, 2.200_985), (13, 2.178_813), (32, 2.039_513), (102, 1.983_731)] {
        let seeds: Vec<f64> = (0..n - n % 2).map(|i| if i % 2 == 0 { 1.0 } else { -1.0 }).collect();
        let seeds = if n % 2 == 0 { seeds } else { [seeds, vec![0.0]].concat() };
        let spread = seeds.iter().map(|x| x * x).sum::<f64>() / f64::from(n) / f64::from(n - 1);
        let [low, high] = t_interval(&seeds).expect("many seeds");
        near("quantile", (high - low) / 2.0 / spread.sqrt(), quantile, 1e-4);
    }
}

#[test]
fn paired_differences() {
    let half: Vec<f64> = (0..20).map(|i| f64::from(i % 2)).collect();
    let (all, none) = (vec![1.0; 20], vec![0.0; 20]);
    let check = |what: &str, first: Vec<Vec<f64>>, second: Vec<Vec<f64>>, expected: [f64; 3]| {
        let (middle, [low, high]) = paired_difference(&first, &second, &mut rng::stream(0, "pairs"));
        [middle, low, high].iter().zip(expected).for_each(|(ours, theirs)| near(what, *ours, theirs, 1e-12));
    };
    // Whichever starts are drawn, there is no difference.
    check("failures from the same starts", vec![half.clone()], vec![half.clone(), half.clone()], [0.0, 0.0, 0.0]);
    // The second's successes among 20 drawn starts are binomial: 6 to 14.
    check("one agent each", vec![all.clone()], vec![half], [0.5, 0.3, 0.7]);
    // 0, 1 or 2 of 2 drawn seeds fail, in 1, 2 and 1 of 4 cases.
    check("seeds that differ", vec![all.clone()], vec![all.clone(), none.clone()], [0.5, 0.0, 1.0]);
    check("starts that one of them met", vec![[all, vec![0.0; 30]].concat()], vec![none], [1.0, 1.0, 1.0]);
}

/// Means 0.9 and 0.5, three seeds each with a variance of 0.01; the quantile for two degrees of freedom is 4.3027.
#[test]
fn t_intervals_of_two_methods() {
    let (first, second) = ([0.8, 0.9, 1.0], [0.4, 0.5, 0.6]);
    let [low, high] = welch_interval(&first, &second).expect("three seeds each");
    near("low", low, 0.4 - 0.351_312, 1e-5);
    near("high", high, 0.4 + 0.351_312, 1e-5);
    // Relative standard errors 0.057735 / 0.9 and 0.057735 / 0.5.
    let [low, high] = ratio_t_interval(&first, &second).expect("three seeds each");
    let factor = (4.3027 * 0.064_150_f64.hypot(0.115_470)).exp();
    near("ratio from", low, 1.8 / factor, 1e-4);
    near("ratio to", high, 1.8 * factor, 1e-4);
    // The fewer seeds decide.
    let more = [0.3, 0.4, 0.5, 0.6, 0.7];
    let wide = welch_interval(&first, &more).expect("three and five seeds");
    near("width", (wide[1] - wide[0]) / 2.0, 4.3027 * (0.01 / 3.0 + 0.025 / 5.0_f64).sqrt(), 1e-9);
    assert_eq!(welch_interval(&first, &[0.5]), None, "one seed says nothing about others");
}

/// The 97.5 % quantile for four degrees of freedom, those of five seeds.
const OF_FIVE: f64 = 2.776_445;

/// Welch and Satterthwaite's degrees of freedom of a sum, from the standard errors of its terms, each the mean of five seeds.
fn satterthwaite(errors: &[f64]) -> f64 {
    let sum = |power: i32| errors.iter().map(|error| error.powi(power)).sum::<f64>();
    sum(2).powi(2) / (sum(4) / 4.0)
}

/// The reference takes Welch and Satterthwaite's degrees of freedom, here 8, and so a quantile of 2.3063. Ours takes the four
/// of a single method, which makes its interval wider, because five seeds tell little of a variance; the ratio, and the
/// standard error of its logarithm, are the reference's.
#[test]
fn the_interval_of_a_ratio_has_the_standard_error_of_the_references() {
    let spread = |first: &[f64], second: &[f64]| {
        let [low, high] = ratio_t_interval(first, second).expect("five seeds each");
        ((low * high).sqrt(), (high / low).ln() / 2.0 / OF_FIVE)
    };
    let (ratio, error) = spread(&SLOW, &FAST);
    near("ratio", ratio, 1.7, 1e-12);
    near("from", ratio * (-2.306_295 * error).exp(), 1.04, 0.005);
    near("to", ratio * (2.306_295 * error).exp(), 2.78, 0.005);
    // Beside seeds that are all alike, one method's error stands alone.
    near("freedom", satterthwaite(&[SLOW, FAST].map(|steps| spread(&steps, &[1.0; 5]).1)), 8.0, 0.01);
}

/// Three tasks have an interval of their own each in a report, and none together; but from their standard errors follows that of
/// the reference, with Welch and Satterthwaite's 8.18 degrees of freedom and a quantile of 2.2973.
#[test]
fn standard_errors_of_three_tasks_make_the_t_interval_of_the_reference() {
    let intervals = SUCCESSES.map(|of_task| t_interval(&of_task.map(|n| n as f64 / 20.0)).expect("five seeds"));
    let errors = intervals.map(|[low, high]| (high - low) / 2.0 / OF_FIVE);
    near("freedom", satterthwaite(&errors), 8.18, 0.005);
    let middle = mean(&intervals.map(|[low, high]| (low + high) / 2.0));
    let half = 2.297_273 * errors.iter().map(|error| error * error).sum::<f64>().sqrt() / 3.0;
    near("low", middle - half, 0.5226, 1e-4);
    near("high", middle + half, 0.8107, 1e-4);
}

/// A method in a study by hand: its name, the successes of each seed in 20 episodes, from which step on, and the steps between
/// evaluations and of the last one.
type ByHand = (&'static str, &'static [usize], usize, [usize; 2]);

/// The folder of a study of these methods, with its report.
fn study_by_hand(methods: &[ByHand]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let mut tests = String::from("task,method,seed,episode,return,success,length,stage,sparc,ldlj\n");
    let mut evaluations = String::from("task,method,seed,step,episodes,success,action_ms,seconds\n");
    for (method, seeds, from, [every, last]) in methods {
        for (seed, successes) in seeds.iter().enumerate() {
            for i in 0..20 {
                tests += &format!("pole,{method},{seed},{},-1.5,{},200,0,,\n", i + 1, i < *successes);
            }
            for step in (0..=*last).step_by(*every) {
                let success = if step >= *from { *successes as f64 / 20.0 } else { 0.0 };
                let seconds = step as f64 / 100.0 + seed as f64;
                evaluations += &format!("pole,{method},{seed},{step},20,{success:?},{}.5,{seconds}\n", step / 1000);
            }
        }
    }
    for (name, text) in [("tests", tests), ("evaluations", evaluations), ("models", "".into()), ("values", "".into())] {
        std::fs::write(folder.path().join(name).with_extension("csv"), text).expect("a writable folder");
    }
    handful::study::report::write(folder.path(), folder.path()).expect("a study");
    folder
}

fn report_in(folder: &Path) -> String {
    std::fs::read_to_string(folder.join("report.md")).expect("a report")
}

/// Four seeds are the fewest that an exact rank test can tell from four others.
#[test]
fn a_verdict_needs_four_seeds() {
    let of = |seeds: &'static [usize]| {
        let folder = study_by_hand(&[("pets", seeds, 500, [500, 2000]), ("sac", &[10, 12, 11, 10], 500, [500, 2000])]);
        report_in(folder.path())
    };
    let (four, three) = (of(&[20, 19, 20, 20]), of(&[20, 19, 20]));
    assert!(four.contains("Significantly more test success than `sac`: `pets` (+45 [+"), "{four}");
    assert!(
        three.contains("Fewer than 4 seeds of one of the two, too few to compare test success with `sac`: `pets`."),
        "{three}"
    );
    let (fast, slow): (ByHand, ByHand) = (("pets", &[20; 4], 500, [500, 2000]), ("sac", &[20; 4], 1500, [500, 2000]));
    let folder = study_by_hand(&[fast, slow]);
    let report = report_in(folder.path());
    assert!(report.contains("Significantly fewer steps to 80 % than `sac`: `pets` (3.0 [3.0, 3.0])."), "{report}");
    assert!(report.contains("+0.0 percentage points, without an interval"), "{report}");
    // Nobody else was compared.
    assert!(
        report.contains(
            "`pets` is given a reward function; of the methods that are not, `sac` is the earliest, by step 1500."
        ),
        "{report}"
    );
    let alone = study_by_hand(&[fast]);
    assert!(report_in(alone.path()).contains("`pets` is given a reward function.\n"));
    // Who succeeds without training takes no steps: there is no ratio.
    let at_once: ByHand = ("pets", &[20; 4], 0, [500, 2000]);
    let report = report_in(study_by_hand(&[at_once, slow]).path());
    assert!(!report.contains("To 80 % success `sac` takes"), "{report}");
    assert!(
        report.contains("Some seeds are at 80 % at step 0, so there is no ratio of steps to `sac`: `pets`."),
        "{report}"
    );
}

#[test]
fn a_report_says_where_methods_do_not_have_the_same_environment() {
    let folder = study_by_hand(&[("pets", &[20], 500, [500, 1000]), ("sac", &[10], 500, [500, 1000])]);
    let report_by = |versions: [&str; 2], pets: &str, sac: &str| {
        let mut runs = String::from("task,method,seed,version,configuration\n");
        for ((method, env), version) in [("pets", pets), ("sac", sac)].into_iter().zip(versions) {
            runs += &format!("pole,{method},0,{version},\"agent = \"\"{method}\"\"\n[env]\n{env}\"\n");
        }
        std::fs::write(folder.path().join("runs.csv"), runs).expect("a writable folder");
        handful::study::report::write(folder.path(), folder.path()).expect("a study");
        report_in(folder.path())
    };
    let report_with = |pets: &str, sac: &str| report_by(["0.1.0 (abc)"; 2], pets, sac);
    let shaped = "reward = \"\"shaped\"\"";
    let alike = report_with(shaped, shaped);
    for absent in ["a different reward", "Not the same environment", "different versions"] {
        assert!(!alike.contains(absent), "{alike}");
    }
    let knows = report_with(&format!("{shaped}\nplanning_reward = \"\"log\"\""), shaped);
    assert!(
        knows.contains("On `pole`, `pets` plans with a different reward (`log`) from the one that is measured"),
        "{knows}"
    );
    assert!(!knows.contains("Not the same environment"), "{knows}");
    let differ = report_with(shaped, "reward = \"\"sparse\"\"");
    let expected = "that of `sac` on `pole` is not that of `pets` (its `reward` is \"sparse\", not \"shaped\")";
    assert!(differ.contains("**Not the same environment:**") && differ.contains(expected), "{differ}");
    let older = report_by(["0.1.0 (abc)", "0.1.0 (def)"], shaped, shaped);
    assert!(older.contains("The runs on `pole` were made by different versions of the program"), "{older}");
}

/// Changes every row of a table, its header included.
fn rewrite(path: &Path, change: &dyn Fn(&[&str]) -> String) {
    let text = std::fs::read_to_string(path).expect("a table");
    let rows = text.lines().map(|line| change(&line.split(',').collect::<Vec<_>>()) + "\n");
    std::fs::write(path, rows.collect::<String>()).expect("a writable folder");
}

/// Four seeds each, 0.1 apart: a standard error of 0.0913 for the difference, and three degrees of freedom.
#[test]
fn smoothness_and_model_errors_stand_in_the_report() {
    let folder = study_by_hand(&[("pets", &[20; 4], 500, [500, 1000]), ("sac", &[20; 4], 500, [500, 1000])]);
    rewrite(&folder.path().join("tests.csv"), &|row| match row[2].parse::<f64>() {
        Ok(seed) => {
            let sparc = if row[1] == "pets" { -2.0 } else { -3.0 } - 0.1 * seed;
            [&row[..8], &[&sparc.to_string()], &row[9..]].concat().join(",")
        }
        Err(_) => row.join(","),
    });
    let mut models = String::from("task,method,seed,step,horizon,rmse,nll,coverage90,rmse_p90\n");
    for (seed, (error, coverage)) in [(0.5, 0.7), (0.2, 0.8), (0.3, 0.9), (0.4, 0.6)].into_iter().enumerate() {
        models += &format!("pole,pets,{seed},500,1,9.0,,0.1,\npole,pets,{seed},1000,1,{error},,{coverage},\n");
        models += &format!("pole,pets,{seed},1000,15,1.5,,0.5,\n");
    }
    std::fs::write(folder.path().join("models.csv"), models).expect("a writable folder");
    handful::study::report::write(folder.path(), folder.path()).expect("a study");
    let tables = handful::study::tables::Tables::read(folder.path()).expect("a study");
    let value = |method: &str, column: &str| tables.value("pole", method, column).expect("a column");
    near("difference", value("pets", "sparc_minus_sac").expect("a number"), 1.0, 1e-12);
    near("low", value("pets", "sparc_minus_sac_t_low").expect("an end"), 1.0 - 3.182_446 * 0.091_287, 1e-4);
    near("of one", value("sac", "smoothness_sparc_t_high").expect("an end"), -3.15 + 3.182_446 * 0.064_550, 1e-4);
    assert_eq!(value("sac", "sparc_minus_sac"), None);
    let report = report_in(folder.path());
    for part in [
        "SPARC minus that of `sac`, with t intervals that are not corrected for their number: `pets` +1.00 [+0.71, +1.29].",
        "| method | error, 1 step | error, 5 steps | error, 15 steps | error, 25 steps | coverage, 1 step | coverage, 15 steps |",
        "| pets | 0.35 [0.20, 0.50] | - | 1.50 [1.50, 1.50] | - | 0.75 [0.60, 0.90] | 0.50 [0.50, 0.50] |",
    ] {
        assert!(report.contains(part), "no `{part}` in: {report}");
    }
}

/// A success rate of zero for everyone says nothing about which method is better.
#[test]
fn where_nothing_succeeds_returns_are_compared() {
    let folder = study_by_hand(&[("pets", &[0; 4], 0, [500, 1000]), ("sac", &[0; 4], 0, [500, 1000])]);
    let rewrite = |table: &str, change: &dyn Fn(&[&str]) -> String| rewrite(&folder.path().join(table), change);
    rewrite("evaluations.csv", &|row| row.join(",") + if row[0] == "task" { ",return_mean" } else { ",-15.0" });
    // Seed 0 of `pets` has -10, seed 1 -11, and so on; those of `sac` have -20, -21.
    rewrite("tests.csv", &|row| match row[2].parse::<f64>() {
        Ok(seed) => {
            let total = if row[1] == "pets" { -10.0 } else { -20.0 } - seed;
            [&row[..4], &[&total.to_string()], &row[5..]].concat().join(",")
        }
        Err(_) => row.join(","),
    });
    handful::study::report::write(folder.path(), folder.path()).expect("a study");
    let tables = handful::study::tables::Tables::read(folder.path()).expect("a study");
    let value = |column: &str| tables.value("pole", "pets", column).expect("a column").expect("a number");
    assert_eq!(value("return_minus_sac"), 10.0);
    // Student's t with 3 degrees of freedom, a variance of 5/3 and four seeds each.
    near("low", value("return_minus_sac_t_low"), 10.0 - 3.182_446 * (5.0_f64 / 6.0).sqrt(), 1e-4);
    near("high", value("return_t_high"), -11.5 + 3.182_446 * (5.0_f64 / 12.0).sqrt(), 1e-4);
    let report = report_in(folder.path());
    for part in [
        "Significantly higher test returns than `sac`: `pets` (+10.0 [+",
        "`pets` has a mean test return of -11.5 (t interval [-13.6, -9.4]). Return from the same test starts, minus that of `sac`: +10.0 [",
    ] {
        assert!(report.contains(part), "no `{part}` in: {report}");
    }
    assert!(!report.contains("No significant difference in test success"), "{report}");
}

/// `dreamer` with five seeds, one of which fails, `pets` with two, `sac` with one.
#[test]
fn a_summary_says_what_its_seeds_can_tell() {
    let folder = study_by_hand(&[
        ("dreamer", &[20, 20, 20, 0, 20], 1000, [500, 2000]),
        ("pets", &[20, 20], 500, [500, 1000]),
        ("sac", &[10], 1000, [1000, 2000]),
    ]);
    let tables = handful::study::tables::Tables::read(folder.path()).expect("a study");
    let value = |method: &str, column: &str| tables.value("pole", method, column).expect("a column");
    // Resampled seeds: none of five fails in a third of the draws, three or more in 6 %.
    near("low", value("dreamer", "success_low").expect("an end"), 0.4, 1e-12);
    near("high", value("dreamer", "success_high").expect("an end"), 1.0, 1e-12);
    assert_eq!(value("dreamer", "success_t_high"), Some(1.0));
    near("t", value("dreamer", "success_t_low").expect("an end"), 0.8 - 2.776_445 * 0.2, 1e-4);
    // All episodes agree, or there is one seed only: Wilson's.
    assert_eq!(value("pets", "success_low"), Some(wilson(40, 40)[0]));
    assert_eq!(value("sac", "success_low"), Some(wilson(10, 20)[0]));
    assert_eq!((value("sac", "success_t_low"), value("pets", "success_t_low")), (None, None));
    // The interquartile mean trims something from four seeds on.
    assert!(value("dreamer", "success_iqm").is_some());
    assert_eq!((value("pets", "success_iqm"), value("pets", "success_iqm_low")), (None, None));
    assert_eq!((value("dreamer", "steps_to_80"), value("sac", "steps_to_80")), (Some(1000.0), None));
    assert_eq!(value("dreamer", "seeds_reaching_80"), Some(4.0));
    // Ten seconds and the seed's number; seed 3 does not get there.
    assert_eq!((value("dreamer", "seconds_to_80"), value("sac", "seconds_to_80")), (Some(12.0), None));
    assert_eq!((value("dreamer", "action_ms"), value("pets", "action_ms")), (Some(2.5), Some(1.5)));
    assert_eq!(value("dreamer", "steps_to_80_restricted_mean"), Some(1200.0));
    assert_eq!(value("sac", "steps_to_80_restricted_mean"), Some(2000.0));
    // Areas end where the shortest budget does.
    assert_eq!(value("dreamer", "common_budget"), Some(1000.0));
    assert_eq!(value("pets", "area_under_curve"), Some(0.75));
    assert_eq!(value("pets", "success_minus_sac"), Some(0.5));
    assert_eq!((value("pets", "sac_steps_ratio"), value("dreamer", "sac_steps_ratio")), (Some(4.0), None));
    assert_eq!(value("sac", "success_minus_sac"), None);
    // Four of five seeds have more success, and are earlier; the fifth ties in that neither gets there.
    assert_eq!(
        (value("dreamer", "improvement_over_sac"), value("dreamer", "earlier_than_sac")),
        (Some(0.8), Some(0.9))
    );
    assert_eq!((value("dreamer", "earlier_than_sac_low"), value("sac", "improvement_over_sac")), (Some(0.7), None));
    assert_eq!(
        (value("pets", "updates"), value("pets", "action_change"), value("pets", "optimism")),
        (None, None, None)
    );
    let report = report_in(folder.path());
    for part in [
        "by step 1000 (median; 4 of 5 seeds reach it within 2000)",
        "| 1000 (12 s) | 2.5 |",
        "- **pole**\n  - `pets` is the earliest to reach 80 % success, by step 500 (median). `pets` is given a reward function; of the \
         methods that are not, `dreamer` is the earliest, by step 1000.\n  - Not every seed reaches 80 % within its budget, so there is no ratio of \
         steps to `sac`: `dreamer`. Fewer than 4 seeds of one of the two, too few to compare steps to 80 % with `sac`: `pets`.\n  - Fewer than 4 seeds of one of the two, \
         too few to compare test success with `sac`: `dreamer`, `pets`. Not all methods have the same budget (see the checklist).\n",
        "one seed: the interval covers its test episodes, not what another seed would bring",
        "minus that of `sac`: +50.0 percentage points [",
        "takes at least 4.00 times as many steps on average",
        "**Not evaluated alike:** `dreamer` every 500 steps with 20 episodes",
        "`sac` every 1000 steps",
        "| 0.80 [0.40, 1.00] | 0.90 [0.70, 1.00] |",
        "- **no**: each learning method of a task has at least five seeds. Exceptions: `pets` on `pole` has 2; `sac` on `pole` has 1.",
        "- **no**: all learning methods of a task have the same seeds. Exceptions: `pets` on `pole` lacks 2, 3, 4; `sac` on `pole` lacks 1, 2, 3, 4.",
        "Exceptions: the version is not recorded.",
        "- **no**: all learning methods of a task are trained for the same number of steps. Exceptions: on `pole`, 1000 for `pets` and 2000 for `dreamer` and `sac`.",
    ] {
        assert!(report.contains(part), "no `{part}` in: {report}");
    }
}

#[test]
fn sets_of_starts_share_no_seed() {
    let (last_seed, last_episode) = (LIMIT - 1, LIMIT as usize - 1);
    let ends = |from: Result<u64>, to: Result<u64>| [from.expect("in range"), to.expect("in range")];
    let of = |seeds: EvalSeeds| ends(seeds.seed(0), seeds.seed(last_episode));
    let users = ends(EvalSeeds::Seed(0).seed(0), EvalSeeds::Seed(last_seed).seed(last_episode));
    let training = ends(training_seed(0, 0), training_seed(last_seed, last_episode));
    let mut sets = [training, of(EvalSeeds::Curve), of(EvalSeeds::Test), users, of(EvalSeeds::Development)];
    sets.sort_unstable();
    assert!(sets.iter().all(|[first, last]| first < last), "{sets:?}");
    assert!(sets.windows(2).all(|pair| pair[0][1] < pair[1][0]), "{sets:?}");
    // Within a set, seeds that follow each other do not overlap either.
    assert!(training_seed(3, last_episode).expect("in range") < training_seed(4, 0).expect("in range"));
    // Published numbers depend on these.
    assert_eq!(training_seed(3, 5).expect("in range"), (3 << 20) + 5);
    assert_eq!(EvalSeeds::Curve.seed(7).expect("in range"), (1 << 40) + 7);
    assert_eq!(EvalSeeds::Test.seed(7).expect("in range"), (2 << 40) + 7);
    assert_eq!(EvalSeeds::Seed(9).seed(7).expect("in range"), (3 << 40) + (9 << 20) + 7);
    for beyond in [
        training_seed(LIMIT, 0),
        training_seed(0, LIMIT as usize),
        EvalSeeds::Test.seed(LIMIT as usize),
        EvalSeeds::Seed(17_592_186_044_415).seed(0),
    ] {
        let problem = beyond.expect_err("no such seed").to_string();
        assert!(problem.contains("it must lie in 0..1048576"), "{problem}");
    }
}

/// Methods are compared at the same steps, with the same number of episodes, in evaluations and in the test.
#[test]
fn presets_of_a_task_agree_on_their_evaluations() {
    let registry = Registry::standard();
    for task in registry.env_names() {
        let configs = ["pets", "dreamer", "planet", "size1m", "tdmpc2", "sac"]
            .map(|method| registry.config(task, method, 0, None, None).expect("a preset"));
        let protocol = |c: &RunConfig| (c.evaluate_every, c.evaluation_episodes, c.test_episodes, c.starts);
        for config in &configs {
            assert_eq!(protocol(config), protocol(&configs[0]), "{task}, {}", config.method);
            assert!(config.steps.is_multiple_of(config.evaluate_every), "{task}, {}: off the grid", config.method);
            assert_eq!((config.test_episodes, config.starts), (100, Starts::Test));
        }
    }
}

/// The quick study has a budget of its own, a full one those of the presets.
#[test]
fn a_plan_limits_the_budget_of_its_runs() {
    let registry = Registry::standard();
    let quick = StudyPlan::new(&registry, Profile::Quick, "quick".into());
    let grids = |budget| -> Vec<[usize; 4]> {
        let runs = StudyPlan { budget, ..quick.clone() }.runs(&registry).expect("known names");
        let learning = runs.iter().map(|(config, _)| config).filter(|config| config.learns());
        let grid = |c: &RunConfig| [c.steps, c.evaluate_every, c.evaluation_episodes, c.test_episodes];
        learning.map(grid).collect()
    };
    assert_eq!(grids(quick.budget), [[2_000, 500, 10, 20]; 10], "five methods, two seeds");
    let larger = Budget { steps: 100_000, evaluate_every: 1_000, evaluation_episodes: 300, test_episodes: 300 };
    assert_eq!(grids(Some(larger)), [[3_000, 1_000, 20, 100]; 10], "the presets say fewer");
    assert_eq!(grids(None), [[3_000, 100, 20, 100]; 10]);
    let never = StudyPlan { budget: Some(Budget { evaluate_every: 0, ..larger }), ..quick.clone() };
    assert!(never.runs(&registry).is_err_and(|problem| problem.to_string().contains("evaluate_every")));
}

/// Runs that last seconds: SAC, PETS, Dreamer, and planning in Dreamer's world model.
fn small_runs() -> Vec<RunConfig> {
    let registry = Registry::standard();
    let run = |method: &str| registry.config("reach", method, 1, Some(400), None).expect("a preset");
    let planner = IcemConfig { horizon: 4, population: 10, elites: 4, iterations: 2, ..IcemConfig::default() };
    let planner = PlannerConfig::Icem(planner);
    let mut pets: PetsConfig = run("pets").settings().expect("PETS's settings");
    (pets.warm_up, pets.planner) = (200, planner.clone());
    pets.ensemble = EnsembleConfig { hidden: vec![16], first_steps: 50, steps: 20, check_every: 10, ..pets.ensemble };
    let mut dreamer: DreamerConfig = run("dreamer").settings().expect("Dreamer's settings");
    (dreamer.batch, dreamer.length, dreamer.dreams, dreamer.train_ratio, dreamer.warm_up) = (2, 8, None, 1.0, 200);
    dreamer.world = WorldModelConfig { units: 16, layers: 1, ..dreamer.world };
    dreamer.world.rssm = RssmConfig { deter: 16, blocks: 2, hidden: 8, stoch: 4, classes: 4, ..RssmConfig::default() };
    dreamer.behaviour = ActorCriticConfig { units: 16, layers: 1, horizon: 5, ..ActorCriticConfig::default() };
    let planet = DreamerConfig { planner: Some(planner), ..dreamer.clone() };
    vec![
        run("debug"),
        run("pets").with_settings(&pets),
        run("dreamer").with_settings(&dreamer),
        run("planet").with_settings(&planet),
    ]
}

fn finish(config: &RunConfig, folder: &Path) {
    let mut run = Registry::standard().open_run(config, folder).expect("a new run");
    while !matches!(run.step().expect("a healthy run"), Event::Tested(_)) {}
}

/// Also evaluations in the middle of an episode, which lasts 100 steps here.
#[test]
fn evaluations_do_not_disturb_training() {
    small_runs().par_iter().for_each(|config| {
        let folder = tempfile::tempdir().expect("a folder");
        let learned = [130, 400].map(|evaluate_every| {
            let folder = folder.path().join(evaluate_every.to_string());
            let few = RunConfig { evaluate_every, evaluation_episodes: 2, test_episodes: 2, ..config.clone() };
            finish(&few, &folder);
            // Without the note of whose they are, which says how often the run is evaluated.
            Weights::read(&folder.join("weights.safetensors")).expect("weights").extract("")
        });
        assert!(learned[0] == learned[1], "{}", config.method);
    });
}

/// A run that helps to choose settings meets neither the curve's starts nor the test's.
#[test]
fn a_tuning_run_is_measured_on_development_starts() {
    let config = RunConfig { steps: 200, evaluation_episodes: 3, test_episodes: 3, ..small_runs().remove(0) };
    let folder = tempfile::tempdir().expect("a folder");
    let measured = [Starts::Test, Starts::Development].map(|starts| {
        let folder = folder.path().join(starts.name());
        finish(&RunConfig { starts, ..config.clone() }, &folder);
        let table = |name: &str| std::fs::read_to_string(folder.join(name)).expect("a table");
        let returns = table("evaluations.csv").lines().nth(1).and_then(|row| row.split(',').nth(3)?.parse().ok());
        let (_, mut method) = Registry::standard().trained_method(&folder).expect("a complete run");
        let mut evaluator = Evaluator::new(|| Registry::standard().make_env(&config)).expect("a world");
        let again = evaluator.evaluate(&mut method, 3, starts.test()).expect("valid actions").summary();
        let summary: toml::Table = toml::from_str(&table("summary.toml")).expect("TOML");
        assert_eq!(summary["return_mean"].as_float(), Some(again.return_mean), "{starts:?}");
        let before: f64 = returns.expect("a number");
        before
    });
    assert_ne!(measured[0], measured[1], "the same untrained agent, from other starts");
    // A folder of an earlier version does not say; it was measured as a reported run.
    let path = folder.path().join("test/config.toml");
    let text = std::fs::read_to_string(&path).expect("a configuration");
    let (values, text) = text.split_once('\n').expect("several lines");
    assert!(values.starts_with("values = ") && text.contains("starts = \"test\"\n"), "{text}");
    std::fs::write(&path, text.replace("starts = \"test\"\n", "")).expect("a writable folder");
    assert_eq!(RunConfig::read(&path).expect("a configuration"), config);
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
