//! A differentiable simulator as an objective: every planner can then be asked about it, those by gradients too.

use nalgebra::SVector;
use rayon::prelude::*;

use super::{ActionSequences, Objective};
use crate::diff::derivatives::gradient;
use crate::diff::{System, roll_out};

/// What action sequences are worth in a [`System`]: the negative of what they cost.
pub struct Simulated<'a, Y, const N: usize, const M: usize> {
    system: &'a Y,
    start: SVector<f64, N>,
    /// Steps simulated so far; a step that was differentiated counts once.
    pub steps: usize,
}

impl<'a, Y: System<N, M>, const N: usize, const M: usize> Simulated<'a, Y, N, M> {
    /// From this state on.
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
