//! Symmetry reduction: a cube looks the same after each of its 24 rotations onto itself, so its orientation can be
//! reduced to a canonical one.
//!
//! A model that reads and predicts canonical orientations generalises from one push to the same push of the cube on any
//! other side. Without, a cube that has tipped over is out of distribution.

use crate::env::Spec;

/// Where the orientation of a cube stands in an observation: six consecutive features, the unit vectors of its x-axis and
/// its z-axis in the world frame.
///
/// In the canonical orientation the z-axis is the axis that points up the most, and the x-axis the remaining one that
/// points along the world's x-axis the most.
#[doc(alias = "symmetry")]
#[doc(alias = "equivariance")]
#[derive(Clone, Debug, PartialEq)]
pub struct Cube {
    /// Index of the first of the six in an observation.
    pub observed: usize,
    /// Index of the first of the six among the predicted features.
    pub predicted: usize,
}

/// One of the 24 rotational symmetries of a cube, as a signed permutation of its axes: for the new x-axis and the new
/// z-axis the index of the old axis and its sign. The new y-axis follows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Symmetry {
    x: (usize, f32),
    z: (usize, f32),
}

impl Symmetry {
    /// The new x-, y- and z-axis.
    fn permute(self, axes: &[[f32; 3]; 3]) -> [[f32; 3]; 3] {
        let [x, z] = [self.x, self.z].map(|(k, sign)| axes[k].map(|a| sign * a));
        [x, cross(z, x), z]
    }
}

impl Cube {
    /// The cubes in an observation whose `predicted` features are given by index. Cubes without six consecutive
    /// predicted features are skipped: their features are read as they are.
    pub(super) fn find(spec: &Spec, predicted: &[usize]) -> Vec<Self> {
        let cube_of = |i: &usize| spec.observation[*i].cube.as_deref();
        let first = |axes: &[usize]| predicted.iter().position(|i| *i == axes[0]).expect("the axes are predicted");
        let whole = predicted.chunk_by(|a, b| b - a == 1 && cube_of(a) == cube_of(b));
        let whole = whole.filter(|axes| axes.len() == 6 && cube_of(&axes[0]).is_some());
        whole.map(|axes| Self { observed: axes[0], predicted: first(axes) }).collect()
    }

    /// The symmetry that takes the cube to its canonical orientation.
    pub(super) fn to_canonical(&self, obs: &[f32]) -> Symmetry {
        let axes = axes(&obs[self.observed..]);
        let most_aligned = |along: usize, not: usize| {
            let others = (0..3).filter(|k| *k != not);
            let best = others.max_by(|a, b| axes[*a][along].abs().total_cmp(&axes[*b][along].abs()));
            let k = best.expect("there are three axes");
            (k, axes[k][along].signum())
        };
        let z = most_aligned(2, usize::MAX);
        Symmetry { x: most_aligned(0, z.0), z }
    }

    /// Rotates the cube in `obs` by a symmetry.
    pub(super) fn apply(&self, symmetry: Symmetry, obs: &mut [f32]) {
        let [x, _, z] = symmetry.permute(&axes(&obs[self.observed..]));
        obs[self.observed..][..3].copy_from_slice(&x);
        obs[self.observed + 3..][..3].copy_from_slice(&z);
    }

    /// Gram-Schmidt: makes the two axes unit vectors at right angles. Networks predict the six features independently, so
    /// they come out slightly off; over an imagined trajectory the error would grow without bound.
    #[doc(alias = "Gram-Schmidt")]
    pub(super) fn orthonormalize(&self, obs: &mut [f32]) {
        let [x, _, z] = axes(&obs[self.observed..]);
        let z = unit(z);
        let projection: f32 = x.iter().zip(z).map(|(x, z)| x * z).sum();
        let x = unit(std::array::from_fn(|i| x[i] - projection * z[i]));
        obs[self.observed..][..3].copy_from_slice(&x);
        obs[self.observed + 3..][..3].copy_from_slice(&z);
    }

    /// Takes a prediction for the cube rotated by `symmetry` back to the orientation in `obs`: the changes of the predicted
    /// features, and their standard deviations.
    pub(super) fn decanonicalize(&self, symmetry: Symmetry, obs: &[f32], changes: &mut [f32], stds: &mut [f32]) {
        let [x, y, z] = symmetry.permute(&axes(&obs[self.observed..]));
        let of = |features: &[f32]| -> [[f32; 3]; 2] {
            [0, 3].map(|from| std::array::from_fn(|i| features[self.predicted + from + i]))
        };
        let [[dx, dz], [sx, sz]] = [of(changes), of(stds)];
        // The third axis follows from the other two; its standard deviation to first order.
        let new = cross(add(z, dz), add(x, dx));
        let dy: [f32; 3] = std::array::from_fn(|i| new[i] - y[i]);
        let sy: [f32; 3] = std::array::from_fn(|i| {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            [sz[j] * x[k], sz[k] * x[j], z[j] * sx[k], z[k] * sx[j]].map(|part| part * part).iter().sum::<f32>().sqrt()
        });
        let handedness = if (symmetry.z.0 + 1) % 3 == symmetry.x.0 { 1.0 } else { -1.0 };
        for (from, k) in [(0, 0), (3, 2)] {
            let (sign, change, std) = match k {
                k if k == symmetry.x.0 => (symmetry.x.1, dx, sx),
                k if k == symmetry.z.0 => (symmetry.z.1, dz, sz),
                _ => (handedness * symmetry.x.1 * symmetry.z.1, dy, sy),
            };
            changes[self.predicted + from..][..3].copy_from_slice(&change.map(|d| sign * d));
            stds[self.predicted + from..][..3].copy_from_slice(&std);
        }
    }
}

/// All three axes, given the x-axis and the z-axis one after the other.
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

    fn random_rotation(rng: &mut rng::Rng) -> Rotation3<f64> {
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| 2.0 * rng::normal(rng)));
        rotation.to_rotation_matrix()
    }

    fn observed(rotation: &Rotation3<f64>) -> [f32; 6] {
        let (x, z) = (rotation * Vector3::x(), rotation * Vector3::z());
        std::array::from_fn(|i| if i < 3 { x[i] } else { z[i - 3] } as f32)
    }

    /// Rotated by any of its 24 symmetries a cube has the same canonical orientation.
    #[test]
    fn the_canonical_orientation_is_invariant_to_symmetries() {
        let mut rng = rng::stream(0, "cube");
        let quarter = |axis| Rotation3::from_axis_angle(&axis, std::f64::consts::FRAC_PI_2);
        for _ in 0..50 {
            let mut rotation = random_rotation(&mut rng);
            let mut canonical = observed(&rotation);
            CUBE.apply(CUBE.to_canonical(&canonical), &mut canonical);
            assert!(canonical[5] > 0.57 && canonical[0] > 0.0, "z up and x ahead: {canonical:?}");
            for i in 0..24 {
                rotation *= quarter(if i % 4 == 3 { Vector3::x_axis() } else { Vector3::z_axis() });
                rotation *= quarter(if i % 3 == 1 { Vector3::y_axis() } else { Vector3::z_axis() });
                let mut other = observed(&rotation);
                CUBE.apply(CUBE.to_canonical(&other), &mut other);
                assert!(canonical.iter().zip(&other).all(|(a, b)| (a - b).abs() < 1e-5), "{canonical:?} {other:?}");
            }
        }
    }

    /// However long an imagined trajectory, the axes of a cube stay orthonormal and near what was predicted.
    #[test]
    fn predicted_axes_are_orthonormalized() {
        let mut rng = rng::stream(2, "cube");
        let predicted = (0..6).collect();
        let map = FeatureMap { width: 6, raw: vec![], near: vec![], predicted, differences: vec![], cubes: vec![CUBE] };
        for _ in 0..50 {
            let rotation = random_rotation(&mut rng);
            let straight = observed(&rotation);
            let mut bent = straight.map(|a| 1.2 * a + 0.02 * rng::normal(&mut rng) as f32);
            map.recompute_derived(&mut bent);
            let [x, z] = [0, 3].map(|from| Vector3::from_fn(|i, _| f64::from(bent[from + i])));
            assert!(
                (x.norm() - 1.0).abs() < 1e-6 && (z.norm() - 1.0).abs() < 1e-6 && x.dot(&z).abs() < 1e-6,
                "{bent:?}"
            );
            assert!(straight.iter().zip(bent).all(|(a, b)| (a - b).abs() < 0.15), "{straight:?} {bent:?}");
        }
    }

    /// A rotation predicted in canonical orientation and taken back is the rotation itself, and so is its uncertainty: the
    /// standard deviation of the third axis is compared with that of samples.
    #[test]
    fn predictions_are_decanonicalized() {
        let mut rng = rng::stream(1, "cube");
        for _ in 0..200 {
            let rotation = random_rotation(&mut rng);
            let by = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| 0.1 * rng::normal(&mut rng)));
            let (before, after) = (observed(&rotation), observed(&(by.to_rotation_matrix() * rotation)));
            let symmetry = CUBE.to_canonical(&before);
            let [mut from, mut to] = [before, after];
            CUBE.apply(symmetry, &mut from);
            CUBE.apply(symmetry, &mut to);
            let mut changes: Vec<f32> = to.iter().zip(&from).map(|(a, b)| a - b).collect();
            let mut stds = [0.01, 0.02, 0.03, 0.01, 0.02, 0.03];
            let drawn: Vec<[f32; 6]> = (0..2000)
                .map(|_| {
                    let mut drawn: Vec<f32> =
                        changes.iter().zip(&stds).map(|(c, d)| c + d * rng::normal(&mut rng) as f32).collect();
                    CUBE.decanonicalize(symmetry, &before, &mut drawn, &mut stds.clone());
                    drawn.try_into().expect("six features")
                })
                .collect();
            CUBE.decanonicalize(symmetry, &before, &mut changes, &mut stds);
            for i in 0..6 {
                assert!(
                    (before[i] + changes[i] - after[i]).abs() < 1e-5,
                    "{i}: {changes:?} from {before:?} to {after:?}"
                );
                let square = drawn.iter().map(|drawn| (drawn[i] - changes[i]).powi(2)).sum::<f32>() / 2000.0;
                // To first order only: axes that are made orthonormal again scatter less than their numbers.
                assert!((square.sqrt() / stds[i] - 1.0).abs() < 0.35, "{i}: {} {}", square.sqrt(), stds[i]);
            }
        }
    }
}
