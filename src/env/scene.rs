//! What an environment looks like: bodies made of primitives and a camera, for the 3D replay.
//!
//! ```
//! use handful::env::arm::Primitive;
//! use handful::env::scene::Body;
//!
//! // A puck of 5 cm in its own frame, and a green ghost of 10 cm for the goal.
//! let scene = [Body::solid("puck", "#3c6fd8", vec![Primitive::ball(0.05, [0.0; 3])]), Body::goal(0.1)];
//! assert!(scene[1].goal && scene[0].shapes.len() == 1);
//! ```

use serde::Serialize;

use super::arm::{Primitive, PrimitiveKind};

/// Where the 3D replay is seen from, m; z points up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Camera {
    /// Position of the camera.
    pub eye: [f64; 3],
    /// The point that it looks at.
    pub target: [f64; 3],
}

impl Default for Camera {
    /// Looks at the origin from about four metres.
    fn default() -> Self {
        Self { eye: [2.4, -2.8, 1.6], target: [0.0; 3] }
    }
}

/// A body to draw; its pose comes from [`super::Env::poses`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Body {
    /// Its name. The body called "hand" leaves a trail.
    pub name: String,
    /// Its colour, "#rrggbb".
    pub color: &'static str,
    /// Whether it marks a goal and is drawn translucent.
    pub goal: bool,
    /// Its shapes, in its own frame.
    pub shapes: Vec<Primitive>,
}

impl Body {
    /// A solid body.
    pub fn solid(name: impl Into<String>, color: &'static str, shapes: Vec<Primitive>) -> Self {
        Self { name: name.into(), color, goal: false, shapes }
    }

    /// A goal marker: a ball of the given radius.
    pub fn goal(radius: f64) -> Self {
        Self {
            name: "goal".into(),
            color: "#2fbf71",
            goal: true,
            shapes: vec![Primitive { kind: PrimitiveKind::Ball(radius), pose: super::arm::Pose::identity() }],
        }
    }
}
