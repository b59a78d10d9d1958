//! An episode as one HTML file with a 3D replay: it opens from the disk and asks nothing of the
//! network. `README.md` beside this file tells what its parts are.
//!
//! ```
//! use handful::prelude::*;
//! use handful::watch::Recording;
//!
//! let mut random = Random::new(Task::Pendulum.make().spec(), 0);
//! let recording = Recording::of_episode("random torques".into(), Task::Pendulum.make(), &mut random, 0)?;
//! assert_eq!(recording.steps(), 200);
//! assert!(recording.to_html().contains("<title>"));
//! # Ok::<(), Error>(())
//! ```

use std::path::Path;

use serde::Serialize;

use crate::agent::{ImaginedTrajectory, Policy, Slot};
use crate::env::Env;
use crate::env::arm::{Pose, Primitive, PrimitiveKind};
use crate::env::contract::Checked;
use crate::env::scene::{Body, Camera};
use crate::error::{Error, Result};
use crate::files;

const PAGE: &str = include_str!("viewer.html");
const VIEWER: &str = include_str!("viewer.js");
const THREE: &str = include_str!("three.bundle.js");

/// An episode as the page draws it.
#[derive(Clone, Debug, Serialize)]
pub struct Recording {
    title: String,
    task: String,
    dt: f64,
    up: &'static str,
    camera: Camera,
    bodies: Vec<DrawnBody>,
    frames: Vec<Frame>,
    /// For each frame the trajectories that the agent imagined there.
    paths: Vec<Vec<Path3>>,
}

/// An imagined trajectory: its points, its value (0 to 1 within its frame), the models' disagreement about it.
#[derive(Clone, Debug, Serialize)]
struct Path3 {
    points: Vec<[f64; 3]>,
    value: f64,
    spread: f32,
}

#[derive(Clone, Debug, Serialize)]
struct DrawnBody {
    name: String,
    color: &'static str,
    kind: &'static str,
    shapes: Vec<DrawnShape>,
}

#[derive(Clone, Debug, Serialize)]
#[serde(tag = "kind", rename_all = "lowercase")]
enum DrawnShape {
    Box { half: [f64; 3], pose: [f64; 7] },
    Capsule { radius: f64, half_length: f64, pose: [f64; 7] },
    Cylinder { radius: f64, half_length: f64, pose: [f64; 7] },
    Ball { radius: f64, pose: [f64; 7] },
}

#[derive(Clone, Debug, Serialize)]
struct Frame {
    poses: Vec<[f64; 7]>,
    reward: f32,
    success: bool,
    action: Vec<f32>,
}

impl Recording {
    /// Lets a policy act, as in an evaluation, in the episode of that seed.
    ///
    /// # Errors
    /// If the environment cannot take the policy's actions, or breaks its contract.
    pub fn of_episode<E: Env, P: Policy + ?Sized>(title: String, env: E, policy: &mut P, seed: u64) -> Result<Self> {
        Self::of_slot(title, env, policy, seed, 0)
    }

    /// The same, as the environment of that index among those that an evaluation runs side by side: a policy's random numbers may depend
    /// on it.
    ///
    /// # Errors
    /// As for [`Recording::of_episode`].
    pub(crate) fn of_slot<E: Env, P: Policy + ?Sized>(
        title: String,
        env: E,
        policy: &mut P,
        seed: u64,
        index: usize,
    ) -> Result<Self> {
        env.spec().check()?;
        let mut env = Checked::new(env);
        let mut obs = env.reset(seed)?;
        let bodies: Vec<DrawnBody> = env.env().scene().iter().map(drawn).collect();
        let rest = vec![0.0; env.env().spec().action_size];
        let mut frames =
            vec![Frame { poses: poses(env.env(), bodies.len())?, reward: 0.0, success: false, action: rest }];
        let mut paths = Vec::new();
        loop {
            let slot = Slot { index, ..Slot::single(frames.len() == 1, &obs, env.env()) };
            let (action, trajectories) = policy.explained_action(&slot)?;
            paths.push(drawn_trajectories(env.env(), &trajectories));
            let step = env.step(&action)?;
            let poses = poses(env.env(), bodies.len())?;
            frames.push(Frame { poses, reward: step.reward, success: step.success, action });
            if step.done() {
                break;
            }
            obs = step.observation;
        }
        let (spec, camera) = (env.env().spec(), env.env().camera());
        Ok(Self { title, task: spec.name.clone(), dt: spec.dt, up: "z", camera, bodies, frames, paths })
    }

    /// Whether there is something to see: bodies, or what an agent imagined.
    pub fn is_visible(&self) -> bool {
        !self.bodies.is_empty() || self.paths.iter().any(|paths| !paths.is_empty())
    }

    /// Steps in the episode.
    pub fn steps(&self) -> usize {
        self.frames.len() - 1
    }

    /// Whether the task was fulfilled at the last step.
    pub fn success(&self) -> bool {
        self.frames.last().is_some_and(|frame| frame.success)
    }

    /// Sum of rewards.
    pub fn total(&self) -> f64 {
        self.frames.iter().map(|frame| f64::from(frame.reward)).sum()
    }

    /// What [`Recording::to_html`] puts into the page: JSON in which `<` is written as an escape, so that no name can close the script
    /// around it.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a recording is JSON").replace('<', "\\u003c")
    }

    /// The page.
    pub fn to_html(&self) -> String {
        filled(&escaped(&self.title), &self.to_json())
    }

    /// Shows it in a notebook, in a frame of its own; called by the kernel.
    pub fn evcxr_display(&self) {
        // In an attribute, on one line.
        let page = self.to_html().replace('&', "&amp;").replace('"', "&quot;").replace('\n', "&#10;");
        println!(
            "EVCXR_BEGIN_CONTENT text/html\n<iframe class=\"replay\" title=\"3D replay\" loading=\"lazy\" style=\"width:100%;height:440px;border:0\" srcdoc=\"{page}\"></iframe>\nEVCXR_END_CONTENT"
        );
    }

    /// Writes the page.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<()> {
        files::write(path, self.to_html().as_bytes())
    }
}

/// The page without an episode, for a page with several: `{{title}}` and `{{recording}}` stand where an escaped title and the JSON of a
/// recording belong.
#[cfg(feature = "study")]
pub(crate) fn empty_page() -> String {
    filled("{{title}}", "{{recording}}")
}

/// Text as HTML shows it, also within an attribute.
pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// The page with its parts. One pass: what has been filled in is not searched again.
fn filled(title: &str, recording: &str) -> String {
    let mut page = String::new();
    let mut rest = PAGE;
    while let Some((before, after)) = rest.split_once("{{") {
        let (name, after) = after.split_once("}}").expect("placeholders are closed");
        page.push_str(before);
        page.push_str(match name {
            "title" => title,
            "recording" => recording,
            "three" => THREE,
            "viewer" => VIEWER,
            other => panic!("the page has no part called {other}"),
        });
        rest = after;
    }
    page + rest
}

/// Imagined trajectories as lines, their values scaled to lie between 0 and 1.
fn drawn_trajectories(env: &impl Env, trajectories: &[ImaginedTrajectory]) -> Vec<Path3> {
    let values = || trajectories.iter().map(|trajectory| f64::from(trajectory.value)).filter(|value| value.is_finite());
    let (low, high) = (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
    let drawn = trajectories.iter().filter(|trajectory| trajectory.value.is_finite()).map(|trajectory| Path3 {
        points: trajectory.observations.iter().filter_map(|obs| env.position_of(obs)).map(|p| p.map(round)).collect(),
        value: round((f64::from(trajectory.value) - low) / (high - low).max(1e-9)),
        spread: trajectory.disagreement,
    });
    let finite = |path: &Path3| path.points.iter().flatten().all(|x| x.is_finite());
    drawn.filter(|path| !path.points.is_empty() && finite(path)).collect()
}

/// # Errors
/// If there is not one finite pose for each of `bodies` bodies.
fn poses(env: &impl Env, bodies: usize) -> Result<Vec<[f64; 7]>> {
    let poses: Vec<[f64; 7]> = env.poses().iter().map(numbers).collect();
    let broken = |rule: String| Err(Error::Contract { env: env.spec().name.clone(), rule });
    if poses.len() != bodies {
        return broken(format!("`scene` has {bodies} bodies, `poses` has {}; they must be as many", poses.len()));
    }
    match poses.iter().position(|pose| pose.iter().any(|x| !x.is_finite())) {
        Some(body) => broken(format!("the pose of body {body} is not finite")),
        None => Ok(poses),
    }
}

fn numbers(pose: &Pose) -> [f64; 7] {
    let (p, q) = (pose.translation.vector, pose.rotation.coords);
    [p.x, p.y, p.z, q.x, q.y, q.z, q.w].map(round)
}

/// To a tenth of a millimetre, which is finer than a screen.
fn round(x: f64) -> f64 {
    (x * 1e4).round() / 1e4
}

fn drawn(body: &Body) -> DrawnBody {
    DrawnBody {
        name: body.name.clone(),
        color: body.color,
        kind: if body.goal { "goal" } else { "solid" },
        shapes: body.shapes.iter().map(drawn_shape).collect(),
    }
}

fn drawn_shape(shape: &Primitive) -> DrawnShape {
    let pose = numbers(&shape.pose);
    match shape.kind {
        PrimitiveKind::Box(half) => DrawnShape::Box { half: half.into(), pose },
        PrimitiveKind::Capsule(radius, half_length) => DrawnShape::Capsule { radius, half_length, pose },
        PrimitiveKind::Cylinder(radius, half_length) => DrawnShape::Cylinder { radius, half_length, pose },
        PrimitiveKind::Ball(radius) => DrawnShape::Ball { radius, pose },
    }
}
