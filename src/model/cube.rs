//! Cubes, whose sides nobody can tell apart: however one lies, it can be said to lie upright and to look ahead.
//!
//! A model that is told so learns from each push what would come of it with any other side up; otherwise a cube that has
//! tipped over is a thing that it has never seen.

use crate::env::Spec;

/// Where it stands how a cube lies: six numbers, its x-axis and its z-axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Cube {
    /// The first of them in an observation.
    pub observed: usize,
    /// The first of them among what is predicted.
    pub predicted: usize,
}

/// Another way of naming a cube's axes: what is called x and z now, each with the axis that it was (x, y, z count from 0)
/// and a sign. One of 24.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Names {
    x: (usize, f32),
    z: (usize, f32),
}

impl Names {
    /// What is called x, y and z now.
    fn of(self, axes: &[[f32; 3]; 3]) -> [[f32; 3]; 3] {
        let [x, z] = [self.x, self.z].map(|(k, sign)| axes[k].map(|a| sign * a));
        [x, cross(z, x), z]
    }
}

impl Cube {
    /// The cubes among the features of a world, of which `predicted` are. One that has not six of them, one after the other,
    /// is taken as it is seen.
    pub(super) fn find(spec: &Spec, predicted: &[usize]) -> Vec<Self> {
        let cube_of = |i: &usize| spec.observation[*i].cube.as_deref();
        let first = |axes: &[usize]| predicted.iter().position(|i| *i == axes[0]).expect("it is one of them");
        let whole = predicted.chunk_by(|a, b| b - a == 1 && cube_of(a) == cube_of(b));
        let whole = whole.filter(|axes| axes.len() == 6 && cube_of(&axes[0]).is_some());
        whole.map(|axes| Self { observed: axes[0], predicted: first(axes) }).collect()
    }

    /// The names under which it lies upright and looks ahead: its z-axis points as far up as any, its x-axis as far along the
    /// world's x as any that is left.
    pub(super) fn canonicalize(&self, obs: &[f32]) -> Names {
        let axes = axes(&obs[self.observed..]);
        let most = |along: usize, not: usize| {
            let others = (0..3).filter(|k| *k != not);
            let best = others.max_by(|a, b| axes[*a][along].abs().total_cmp(&axes[*b][along].abs()));
            let k = best.expect("there are three axes");
            (k, axes[k][along].signum())
        };
        let z = most(2, usize::MAX);
        Names { x: most(0, z.0), z }
    }

    /// The same observation with the axes named so.
    pub(super) fn rename(&self, names: Names, obs: &mut [f32]) {
        let [x, _, z] = names.of(&axes(&obs[self.observed..]));
        obs[self.observed..][..3].copy_from_slice(&x);
        obs[self.observed + 3..][..3].copy_from_slice(&z);
    }

    /// Makes its axes one long, and at right angles. Number by number foretold they come out a little off, the third axis,
    /// their product, more so, and from step to step they would grow without end.
    pub(super) fn orthonormalize(&self, obs: &mut [f32]) {
        let [x, _, z] = axes(&obs[self.observed..]);
        let z = unit(z);
        let along: f32 = x.iter().zip(z).map(|(x, z)| x * z).sum();
        let x = unit(std::array::from_fn(|i| x[i] - along * z[i]));
        obs[self.observed..][..3].copy_from_slice(&x);
        obs[self.observed + 3..][..3].copy_from_slice(&z);
    }

    /// Takes what is foretold of the cube when its axes are named so back to the names that `obs` has: changes, and their
    /// standard deviations, of all that is predicted.
    pub(super) fn decanonicalize(&self, names: Names, obs: &[f32], changes: &mut [f32], deviations: &mut [f32]) {
        let [x, y, z] = names.of(&axes(&obs[self.observed..]));
        let of = |numbers: &[f32]| -> [[f32; 3]; 2] {
            [0, 3].map(|from| std::array::from_fn(|i| numbers[self.predicted + from + i]))
        };
        let [[dx, dz], [sx, sz]] = [of(changes), of(deviations)];
        // The third axis follows from the other two; its deviation to first order.
        let new = cross(add(z, dz), add(x, dx));
        let dy: [f32; 3] = std::array::from_fn(|i| new[i] - y[i]);
        let sy: [f32; 3] = std::array::from_fn(|i| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            [sz[j] * x[k], sz[k] * x[j], z[j] * sx[k], z[k] * sx[j]].map(|part| part * part).iter().sum::<f32>().sqrt()
        });
        let handed = if (names.z.0 + 1) % 3 == names.x.0 { 1.0 } else { -1.0 };
        for (from, k) in [(0, 0), (3, 2)] {
            let (sign, change, deviation) = match k {
                k if k == names.x.0 => (names.x.1, dx, sx),
                k if k == names.z.0 => (names.z.1, dz, sz),
                _ => (handed * names.x.1 * names.z.1, dy, sy),
            };
            changes[self.predicted + from..][..3].copy_from_slice(&change.map(|d| sign * d));
            deviations[self.predicted + from..][..3].copy_from_slice(&deviation);
        }
    }
}

/// All three axes, of the x-axis and the z-axis one after the other.
fn axes(of: &[f32]) -> [[f32; 3]; 3] {
    let [x, z] = [0, 3].map(|from| std::array::from_fn(|i| of[from + i]));
    [x, cross(z, x), z]
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|i| a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3])
}

fn unit(a: [f32; 3]) -> [f32; 3] {
    let length = a.iter().map(|a| a * a).sum::<f32>().sqrt();
    a.map(|a| a / length)
}

fn add(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    std::array::from_fn(|i| a[i] + b[i])
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, UnitQuaternion, Vector3};

    use super::*;
    use crate::model::FeatureMap;
    use crate::rng;

    const CUBE: Cube = Cube { observed: 0, predicted: 0 };

    fn lying(rng: &mut rng::Rng) -> Rotation3<f64> {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| 2.0 * rng::normal(rng)));
        turn.to_rotation_matrix()
    }

    fn observed(turn: &Rotation3<f64>) -> [f32; 6] {
        let (x, z) = (turn * Vector3::x(), turn * Vector3::z());
        std::array::from_fn(|i| if i < 3 { x[i] } else { z[i - 3] } as f32)
    }

    /// Turned by any of its 24 symmetries a cube is said to lie the same way.
    #[test]
    fn nobody_can_tell_its_sides_apart() {
        let mut rng = rng::stream(0, "cube");
        let quarter = |axis| Rotation3::from_axis_angle(&axis, std::f64::consts::FRAC_PI_2);
        for _ in 0..50 {
            let mut turn = lying(&mut rng);
            let mut named = observed(&turn);
            CUBE.rename(CUBE.canonicalize(&named), &mut named);
            assert!(named[5] > 0.57 && named[0] > 0.0, "upright and ahead: {named:?}");
            for i in 0..24 {
                turn *= quarter(if i % 4 == 3 { Vector3::x_axis() } else { Vector3::z_axis() });
                turn *= quarter(if i % 3 == 1 { Vector3::y_axis() } else { Vector3::z_axis() });
                let mut other = observed(&turn);
                CUBE.rename(CUBE.canonicalize(&other), &mut other);
                assert!(named.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-5), "{named:?} {other:?}");
            }
        }
    }

    /// However far ahead a model runs, a cube stays one: bent axes come back to the turn that they are nearest to, about.
    #[test]
    fn bent_axes_are_straightened() {
        let mut rng = rng::stream(2, "cube");
        let predicted = (0..6).collect();
        let layout =
            FeatureMap { width: 6, inputs: vec![], near: vec![], predicted, differences: vec![], cubes: vec![CUBE] };
        for _ in 0..50 {
            let turn = lying(&mut rng);
            let straight = observed(&turn);
            let mut bent = straight.map(|a| 1.2 * a + 0.02 * rng::normal(&mut rng) as f32);
            layout.complete(&mut bent);
            let [x, z] = [0, 3].map(|from| Vector3::from_fn(|i, _| f64::from(bent[from + i])));
            assert!(
                (x.norm() - 1.0).abs() < 1e-6 && (z.norm() - 1.0).abs() < 1e-6 && x.dot(&z).abs() < 1e-6,
                "{bent:?}"
            );
            assert!(straight.iter().zip(bent).all(|(a, b)| (a - b).abs() < 0.15), "{straight:?} {bent:?}");
        }
    }

    /// A turn that is foretold under one name and named back is the turn itself, and so is what is unsure about it: the
    /// deviation of the axis that follows is held against drawn ones.
    #[test]
    fn what_is_foretold_is_named_back() {
        let mut rng = rng::stream(1, "cube");
        for _ in 0..200 {
            let turn = lying(&mut rng);
            let by = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| 0.1 * rng::normal(&mut rng)));
            let (before, after) = (observed(&turn), observed(&(by.to_rotation_matrix() * turn)));
            let names = CUBE.canonicalize(&before);
            let [mut from, mut to] = [before, after];
            CUBE.rename(names, &mut from);
            CUBE.rename(names, &mut to);
            let mut changes: Vec<f32> = to.iter().zip(&from).map(|(a, b)| a - b).collect();
            let mut deviations = [0.01, 0.02, 0.03, 0.01, 0.02, 0.03];
            let drawn: Vec<[f32; 6]> = (0..2000)
                .map(|_| {
                    let mut drawn: Vec<f32> =
                        changes.iter().zip(&deviations).map(|(c, d)| c + d * rng::normal(&mut rng) as f32).collect();
                    CUBE.decanonicalize(names, &before, &mut drawn, &mut deviations.clone());
                    drawn.try_into().expect("six numbers")
                })
                .collect();
            CUBE.decanonicalize(names, &before, &mut changes, &mut deviations);
            for i in 0..6 {
                assert!(
                    (before[i] + changes[i] - after[i]).abs() < 1e-5,
                    "{i}: {changes:?} from {before:?} to {after:?}"
                );
                let square = drawn.iter().map(|drawn| (drawn[i] - changes[i]).powi(2)).sum::<f32>() / 2000.0;
                assert!((square.sqrt() / deviations[i] - 1.0).abs() < 0.2, "{i}: {} {}", square.sqrt(), deviations[i]);
            }
        }
    }
}
