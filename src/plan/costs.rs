//! Costs of actions, which any objective can charge: what makes planned motion economical and smooth.

use super::{ActionSequences, Objective};

/// What a plan pays for its actions.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct ActionCosts {
    /// Times the sum of the squared actions.
    pub effort: f32,
    /// Times the sum of the squared changes from one action to the next, the first from the last executed action.
    pub change: f32,
}

impl ActionCosts {
    /// What a sequence of actions costs after the executed action `before`, and the derivative with respect to each number, which is
    /// subtracted from `slopes`.
    fn of(&self, before: &[f32], sequence: &[f32], slopes: Option<&mut [f32]>) -> f32 {
        let Self { effort, change } = *self;
        if effort == 0.0 && change == 0.0 {
            return 0.0;
        }
        let changes: Vec<f32> = sequence.iter().zip(before.iter().chain(sequence)).map(|(a, last)| a - last).collect();
        if let Some(slopes) = slopes {
            for (i, slope) in slopes.iter_mut().enumerate() {
                let next = changes.get(i + before.len()).unwrap_or(&0.0);
                *slope -= 2.0 * (effort * sequence[i] + change * (changes[i] - next));
            }
        }
        let squares = |values: &[f32]| values.iter().map(|x| x * x).sum::<f32>();
        effort * squares(sequence) + change * squares(&changes)
    }
}

/// An objective, less the costs of the actions.
pub(crate) struct WithCosts<'a> {
    pub objective: &'a mut dyn Objective,
    pub costs: ActionCosts,
    /// The last executed action.
    pub before: &'a [f32],
}

impl Objective for WithCosts<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        let returns = self.objective.returns(sequences);
        returns.iter().zip(sequences.rows()).map(|(total, row)| total - self.costs.of(self.before, row, None)).collect()
    }

    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        let (mut returns, mut gradients) = self.objective.gradients(sequences);
        let slopes = gradients.chunks_exact_mut(sequences.width());
        for ((total, slopes), row) in returns.iter_mut().zip(slopes).zip(sequences.rows()) {
            *total -= self.costs.of(self.before, row, Some(slopes));
        }
        (returns, gradients)
    }

    fn proposals(&mut self, count: usize, like: &ActionSequences) -> ActionSequences {
        self.objective.proposals(count, like)
    }
}
