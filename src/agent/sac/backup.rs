//! The right-hand side of the soft Bellman equation.

use crate::replay::Batch;

/// The soft Bellman backup (Haarnoja et al. 2018, equations 2 and 3; there n is 1 and there are no ends), `[batch]`:
///
/// ```text
/// y = r + gamma^n (1 - terminated) (min Q(s', a') - alpha log pi(a'|s'))
/// ```
///
/// r is the discounted sum of n rewards; `q` is min Q(s', a') and `log_pi` is log pi(a'|s'), n time steps later. A truncated
/// episode is bootstrapped, a terminated one is not.
#[doc(alias = "Bellman")]
pub(super) fn soft_bellman_backup(
    batch: &Batch,
    q: &[f32],
    log_pi: &[f32],
    temperature: f32,
    discount: f32,
) -> Vec<f32> {
    let soft_values = q.iter().zip(log_pi).map(|(q, log_pi)| q - temperature * log_pi);
    let discounts = batch.steps.iter().map(|&n| discount.powi(n as i32));
    let targets = batch.rewards.iter().zip(&batch.terminated).zip(discounts).zip(soft_values);
    targets.map(|(((reward, terminated), discount), value)| reward + discount * (1.0 - terminated) * value).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_bootstrap_unless_the_task_ended() {
        let (rewards, terminated) = (vec![1.0, -0.5, 1.0], vec![0.0, 1.0, 0.0]);
        let batch = Batch { size: 3, rewards, terminated, steps: vec![1, 1, 2], ..Batch::default() };
        let y = soft_bellman_backup(&batch, &[4.5, 2.0, 4.5], &[-0.8, 1.2, -0.8], 0.2, 0.99);
        assert!((y[0] - 5.6134).abs() < 1e-6 && (y[1] + 0.5).abs() < 1e-6, "{y:?}");
        assert!((y[2] - 5.567_266).abs() < 1e-5, "two steps: {y:?}");
    }
}
