//! Mass, centre of mass and inertia of rigid bodies.

use nalgebra::{Isometry3, Matrix3, Point3, RealField, Vector3, convert};

/// Mass, centre of mass and inertia of a rigid body, all in the body's own frame, in any kind of number.
#[derive(Clone, Copy, Debug)]
pub struct Inertia<S = f64> {
    /// Mass, kg.
    pub mass: S,
    /// Centre of mass, m.
    pub com: Vector3<S>,
    /// Inertia about the centre of mass, kg m2.
    pub tensor: Matrix3<S>,
}

impl Inertia {
    /// A body whose principal axes are the frame's axes.
    pub fn diagonal(mass: f64, com: [f64; 3], principal: [f64; 3]) -> Self {
        Self { mass, com: com.into(), tensor: Matrix3::from_diagonal(&principal.into()) }
    }

    /// The same body in numbers of another kind.
    pub fn cast<S: RealField + Copy>(&self) -> Inertia<S> {
        Inertia { mass: convert(self.mass), com: self.com.map(convert), tensor: self.tensor.map(convert) }
    }
}

impl<S: RealField + Copy> Inertia<S> {
    /// A solid cube of that mass (kg) and half an edge (m) around `com` (m).
    pub fn cube(mass: S, half: S, com: Vector3<S>) -> Self {
        Self { mass, com, tensor: Matrix3::identity() * (mass * half * half * convert(2.0 / 3.0)) }
    }

    /// The same body in a frame in which its own frame has pose `pose`.
    pub fn seen_at(&self, pose: &Isometry3<S>) -> Self {
        let r = pose.rotation.to_rotation_matrix();
        Self {
            mass: self.mass,
            com: (pose * Point3::from(self.com)).coords,
            tensor: r.matrix() * self.tensor * r.matrix().transpose(),
        }
    }

    /// Two bodies welded together (parallel axis theorem).
    pub fn welded(&self, other: &Self) -> Self {
        let mass = self.mass + other.mass;
        let com = (self.com * self.mass + other.com * other.mass) / mass;
        let about = |part: &Self| {
            let d = part.com - com;
            part.tensor + (Matrix3::identity() * d.norm_squared() - d * d.transpose()) * part.mass
        };
        Self { mass, com, tensor: about(self) + about(other) }
    }
}
