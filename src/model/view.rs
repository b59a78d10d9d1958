//! Observations as latent models see and tell them.

use dfdx::tensor::Cpu;

use super::cube::Cube;
use super::layout::NEAR;
use crate::env::{Role, Spec};
use crate::nn::kernels::tanh;
use crate::nn::two_hot::{symexp, symlog};
use crate::nn::{Tensor3, tensor, values};

/// Shifts and scales observations by the world's own [`crate::env::Feature`]s, and tames large numbers ([`symlog`]); and
/// back.
///
/// Places are seen as the way there: what is the minuend of a difference is left out, and found again as subtrahend and
/// difference together. A few hundred episodes show only a few hundred goals, but the way to one changes all the time.
/// And ways are seen once more, and told once more, through a tanh, which shows as large what is small: a centimetre
/// decides between a hand that touches and one that does not.
#[derive(Clone, Debug)]
pub struct LatentFeatures {
    centre: Vec<f32>,
    scale: Vec<f32>,
    /// The numbers that have a course of their own.
    lively: Vec<usize>,
    /// The numbers that are seen.
    seen: Vec<usize>,
    /// The differences, seen once more.
    near: Vec<usize>,
    /// What is found again, in this order: `[itself, subtrahend, difference]`.
    found: Vec<[usize; 3]>,
    /// Cubes, which are seen, and told, as if each lay upright and looked ahead.
    cubes: Vec<Cube>,
}

impl LatentFeatures {
    /// The view of a world's observations.
    pub fn new(spec: &Spec) -> Self {
        let features = &spec.observation;
        let place = |name: &str| features.iter().position(|feature| feature.name == name);
        let (mut near, mut found) = (Vec::new(), Vec::<[usize; 3]>::new());
        for (i, feature) in features.iter().enumerate() {
            let Role::Difference { minuend, subtrahend } = &feature.role else { continue };
            near.push(i);
            if let (Some(minuend), Some(subtrahend)) = (place(minuend), place(subtrahend))
                // Each once, and none that another was found from.
                && found.iter().all(|[itself, from, _]| ![*itself, *from].contains(&minuend))
            {
                found.push([minuend, subtrahend, i]);
            }
        }
        let lively: Vec<usize> = (0..features.len()).filter(|i| features[*i].role == Role::Dynamic).collect();
        Self {
            cubes: Cube::find(spec, &lively),
            centre: features.iter().map(|feature| feature.centre).collect(),
            scale: features.iter().map(|feature| feature.scale).collect(),
            // How a cube lies is told under other names.
            lively: lively.into_iter().filter(|i| features[*i].cube.is_none()).collect(),
            seen: (0..features.len()).filter(|i| found.iter().all(|[itself, ..]| itself != i)).collect(),
            near,
            found,
        }
    }

    /// Numbers that networks see and tell of an observation.
    pub fn width(&self) -> usize {
        self.seen.len() + self.near.len()
    }

    /// Rows of observations as networks see them, `[1, rows, width]`.
    pub fn seen(&self, cpu: &Cpu, obs: &[f32]) -> Tensor3 {
        let size = self.centre.len();
        let mut seen = Vec::with_capacity(obs.len());
        let mut row = Vec::with_capacity(size);
        for obs in obs.chunks_exact(size) {
            row.clear();
            row.extend_from_slice(obs);
            self.cubes.iter().for_each(|cube| cube.rename(cube.canonicalize(obs), &mut row));
            let scaled = |i: &usize| (row[*i] - self.centre[*i]) / self.scale[*i];
            seen.extend(self.seen.iter().map(|i| symlog(scaled(i))));
            seen.extend(self.near.iter().map(|i| tanh(NEAR * scaled(i))));
        }
        tensor(cpu, seen, (1, obs.len() / size, self.width()))
    }

    /// What networks tell, in physical units, row by row.
    pub fn told(&self, told: &Tensor3) -> Vec<f32> {
        let size = self.centre.len();
        let mut obs = vec![0.0; values(told).len() / self.width() * size];
        for (obs, told) in obs.chunks_exact_mut(size).zip(values(told).chunks_exact(self.width())) {
            for (&i, told) in self.seen.iter().zip(told) {
                obs[i] = symexp(*told) * self.scale[i] + self.centre[i];
            }
            for &[itself, from, way] in &self.found {
                obs[itself] = obs[from] + obs[way];
            }
        }
        obs
    }

    /// The numbers that a model is judged by, with what is a noticeable change of each.
    pub fn lively(&self) -> Vec<(usize, f32)> {
        self.lively.iter().map(|&i| (i, 0.1 * self.scale[i])).collect()
    }
}

#[cfg(test)]
mod tests {
    use dfdx::prelude::HasShape;

    use super::*;
    use crate::env::{Env, Task};
    use crate::nn::device;

    #[test]
    fn what_is_seen_can_be_told() {
        for task in Task::ALL {
            let mut world = task.make();
            let mut obs = world.reset(3);
            let view = LatentFeatures::new(world.spec());
            view.cubes.iter().for_each(|cube| cube.rename(cube.canonicalize(&obs), &mut obs));
            let seen = view.seen(&device(), &[obs.clone(), obs.clone()].concat());
            assert_eq!(*seen.shape(), (1, 2, view.width()));
            let told = view.told(&seen);
            for (i, (told, obs)) in told.iter().zip(obs.iter().cycle()).enumerate() {
                let scale = view.scale[i % view.scale.len()];
                assert!((told - obs).abs() < 1e-4 * scale, "{} {i}: {told}, not {obs}", task.name());
            }
        }
        let push = LatentFeatures::new(Task::Push.make().spec());
        assert_eq!(push.found.len(), 6, "cube and goal are found again from the ways there");
    }
}
