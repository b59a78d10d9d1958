//! What a world looks like: bodies made of primitives, for the 3D replay.

use super::arm::{Primitive, PrimitiveKind};

/// A body to draw; where it stands comes from [`super::Env::poses`].
#[derive(Clone, Debug)]
pub struct Body {
    /// Its name. The body called "hand" leaves a trail.
    pub name: String,
    /// Its colour, "#rrggbb".
    pub color: &'static str,
    /// Whether it marks a goal and is drawn as a ghost.
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
