//! Vectors and poses between nalgebra's double precision and rapier's single precision.

use nalgebra::{Quaternion, Translation3, UnitQuaternion, Vector3};
use rapier3d::math::{Pose as RapierPose, Rotation, Vector};

use crate::env::arm::Pose;

/// A vector in single precision, as rapier computes.
pub(super) fn to_vector(v: &Vector3<f64>) -> Vector {
    Vector::new(v.x as f32, v.y as f32, v.z as f32)
}

/// A vector of rapier in double precision.
pub(super) fn from_vector(v: Vector) -> Vector3<f64> {
    Vector3::new(v.x.into(), v.y.into(), v.z.into())
}

/// A pose in single precision, as rapier computes.
pub(super) fn to_rapier(pose: &Pose) -> RapierPose {
    let q = pose.rotation.coords;
    RapierPose::from_parts(
        to_vector(&pose.translation.vector),
        Rotation::from_xyzw(q.x as f32, q.y as f32, q.z as f32, q.w as f32),
    )
}

/// A pose of rapier in double precision.
pub(super) fn from_rapier(pose: &RapierPose) -> Pose {
    let q = pose.rotation;
    Pose::from_parts(
        Translation3::from(from_vector(pose.translation)),
        UnitQuaternion::from_quaternion(Quaternion::new(q.w.into(), q.x.into(), q.y.into(), q.z.into())),
    )
}
