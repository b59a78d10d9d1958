//! A differentiable simulator as an objective of the planners in [`crate::plan`], those that use gradients included.

use nalgebra::SVector;
use rayon::prelude::*;

use super::derivatives::gradient;
use super::{System, roll_out};
use crate::plan::{ActionSequences, Objective};

/// The return of action sequences in a [`System`]: the negative of their cost. Actions are clamped to [-1, 1].
///
/// ```
/// use handful::diff::{PendulumSwing, Simulated};
/// use handful::nalgebra::Vector2;
/// use handful::plan::{ActionSequences, Objective};
///
/// let mut hanging = Simulated::new(&PendulumSwing, Vector2::new(std::f64::consts::PI, 0.0));
/// // Two sequences of three actions: do nothing, and push.
/// let sequences = ActionSequences { horizon: 3, actions: 1, values: vec![0.0, 0.0, 0.0, 1.0, 1.0, 1.0] };
/// let (returns, gradients) = hanging.gradients(&sequences);
/// assert_eq!((returns.len(), gradients.len()), (2, 6));
/// ```
#[derive(Clone, Debug)]
pub struct Simulated<'a, Y, const N: usize, const M: usize> {
    system: &'a Y,
    start: SVector<f64, N>,
    /// Steps simulated so far; a step that was differentiated counts once.
    pub steps: usize,
}

impl<'a, Y: System<N, M>, const N: usize, const M: usize> Simulated<'a, Y, N, M> {
    /// Roll-outs of `system` from `start`.
    pub fn new(system: &'a Y, start: SVector<f64, N>) -> Self {
        Self { system, start, steps: 0 }
    }

    fn actions(row: &[f32]) -> Vec<SVector<f64, M>> {
        row.chunks_exact(M).map(|action| SVector::from_fn(|i, _| f64::from(action[i]).clamp(-1.0, 1.0))).collect()
    }
}

impl<Y: System<N, M>, const N: usize, const M: usize> Objective for Simulated<'_, Y, N, M> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        self.steps += sequences.count() * sequences.horizon;
        let rows = sequences.values.par_chunks_exact(sequences.horizon * M);
        rows.map(|row| -roll_out(self.system, &self.start, &Self::actions(row)).1 as f32).collect()
    }

    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        self.steps += sequences.count() * sequences.horizon;
        let rows = sequences.values.par_chunks_exact(sequences.horizon * M);
        let each = rows.map(|row| {
            let (cost, slopes, _) = gradient(self.system, &self.start, &Self::actions(row));
            (-cost as f32, slopes.iter().flat_map(|slope| slope.iter().map(|s| -*s as f32)).collect::<Vec<f32>>())
        });
        let (returns, slopes): (Vec<f32>, Vec<Vec<f32>>) = each.unzip();
        (returns, slopes.concat())
    }
}
