//! What an environment's observations and actions are.

use crate::error::{Error, Result};

/// The names, sizes and units of an environment's observations and actions.
///
/// ```
/// use handful::env::{Feature, Spec};
///
/// let observation = [
///     Feature::new("x").around(0.0, 0.5),
///     Feature::new("goal").around(0.0, 0.5).constant(),
///     Feature::new("x to goal").difference("goal", "x"),
/// ];
/// let spec = Spec::new("line", observation, 1, 50, 0.1).stages(["near", "there"]);
/// spec.check()?;
///
/// let misspelt = Spec::new("line", [Feature::new("x to goal").difference("gaol", "x")], 1, 50, 0.1);
/// assert!(misspelt.check().is_err());
/// # Ok::<(), handful::error::Error>(())
/// ```
#[doc(alias = "observation space")]
#[doc(alias = "action space")]
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Spec {
    /// The environment's name.
    pub name: String,
    /// One feature for each number of an observation, in order.
    pub observation: Vec<Feature>,
    /// Dimension of an action; each component lies in [-1, 1]. Let 0 be rest where there is one: costs on actions pull there.
    pub action_size: usize,
    /// Control steps in an episode; reaching this limit is a truncation, not a termination.
    pub horizon: usize,
    /// Seconds from one action to the next.
    pub dt: f64,
    /// The stages on the way to success, in order, for reports.
    pub stages: Vec<String>,
}

/// One number of an observation. Ensembles predict its change over a time step, so observe an angle that can turn all the way round as
/// its sine and cosine.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Feature {
    /// Its name, with its unit where it has one.
    pub name: String,
    /// A typical value.
    pub centre: f32,
    /// A typical distance from `centre`. SAC's networks are fed (value - centre) / scale, clamped to ±10; latent models, and SAC with
    /// `latent_features`, its symlog. The dynamics of ensembles are standardised by the data, with a part of the scale as a floor.
    pub scale: f32,
    /// How it changes over an episode: models predict only features that are [`Role::Dynamic`].
    pub role: Role,
    /// The cube whose orientation it belongs to, if any. Six consecutive features give a cube's orientation: the directions
    /// of its x-axis and of its z-axis. A cube looks the same from every side, and models may make use of that symmetry.
    pub cube: Option<String>,
    /// Whether it is a flag, 0 or 1. Ensembles do not clip a flag's training target, so that they predict even a rare flip in full.
    pub flag: bool,
}

/// How a feature changes over an episode.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Role {
    /// It has dynamics of its own, which models predict.
    #[default]
    Dynamic,
    /// It is constant throughout an episode, as a goal is. The dynamics of an ensemble neither predict it nor read it, nor a difference
    /// that contains it: a quantity on which the motion depends (a mass, a friction) is [`Role::Dynamic`]. SAC reads it, and so do
    /// latent models and learned rewards, unless it is the minuend of a difference.
    Constant,
    /// It is the difference `minuend - subtrahend` of two other features, and computed from them.
    Difference {
        /// Name of the feature that is subtracted from.
        minuend: String,
        /// Name of the feature that is subtracted.
        subtrahend: String,
    },
}

impl Feature {
    /// A dynamic feature with centre 0 and scale 1.
    pub fn new(name: impl Into<String>) -> Self {
        Self { name: name.into(), centre: 0.0, scale: 1.0, role: Role::Dynamic, cube: None, flag: false }
    }

    /// The same feature, constant throughout an episode.
    pub fn constant(self) -> Self {
        Self { role: Role::Constant, ..self }
    }

    /// The same feature as the difference `minuend - subtrahend` of two other features, given by name.
    pub fn difference(self, minuend: impl Into<String>, subtrahend: impl Into<String>) -> Self {
        Self { role: Role::Difference { minuend: minuend.into(), subtrahend: subtrahend.into() }, ..self }
    }

    /// The same feature as a flag, 0 or 1: whether something touches, for example.
    pub fn flag(self) -> Self {
        Self { flag: true, ..self.around(0.5, 0.5) }
    }

    /// The same feature as one of the six that give a cube's orientation.
    pub fn axis_of_cube(self, cube: &str) -> Self {
        Self { cube: Some(cube.into()), ..self }
    }

    /// The same feature with another centre and scale.
    pub fn around(self, centre: f32, scale: f32) -> Self {
        Self { centre, scale, ..self }
    }
}

impl Spec {
    /// An environment with these numbers in its observations, `action_size` numbers in [-1, 1] as its action, episodes of
    /// at most `horizon` control steps, and `dt` seconds from one action to the next.
    pub fn new(
        name: impl Into<String>,
        observation: impl IntoIterator<Item = Feature>,
        action_size: usize,
        horizon: usize,
        dt: f64,
    ) -> Self {
        let observation = observation.into_iter().collect();
        Self { name: name.into(), observation, action_size, horizon, dt, stages: Vec::new() }
    }

    /// The same with the stages on the way to success, in order.
    pub fn stages(self, stages: impl IntoIterator<Item = impl Into<String>>) -> Self {
        Self { stages: stages.into_iter().map(Into::into).collect(), ..self }
    }

    /// Checks that the specification makes sense. Agents call it before anything else.
    ///
    /// # Errors
    /// [`Error::Config`] names the environment, the feature and the rule: at least one feature, one number in the
    /// action and one step in the horizon; `dt` positive and finite; names neither empty nor given twice; centres finite,
    /// scales positive and finite; a [`Role::Difference`] names two features that are no differences themselves.
    pub fn check(&self) -> Result<()> {
        let refuse = |problem: String| Err(Error::Config(format!("{}: {problem}", self.name)));
        if self.observation.is_empty() {
            return refuse("an observation needs at least one feature".into());
        }
        for (name, value) in [("action_size", self.action_size), ("horizon", self.horizon)] {
            if value == 0 {
                return refuse(format!("`{name}` must be at least 1"));
            }
        }
        if !(self.dt > 0.0 && self.dt.is_finite()) {
            return refuse(format!("`dt` must be positive and finite, it is {}", self.dt));
        }
        let mut names = std::collections::HashSet::new();
        for (i, Feature { name, centre, scale, .. }) in self.observation.iter().enumerate() {
            if name.is_empty() {
                return refuse(format!("feature {i} has no name"));
            }
            if !names.insert(name) {
                return refuse(format!("two features are called `{name}`"));
            }
            if !centre.is_finite() {
                return refuse(format!("the centre of feature `{name}` must be finite, it is {centre}"));
            }
            if !(*scale > 0.0 && scale.is_finite()) {
                return refuse(format!("the scale of feature `{name}` must be positive and finite, it is {scale}"));
            }
        }
        for Feature { name, role, .. } in &self.observation {
            let Role::Difference { minuend, subtrahend } = role else { continue };
            for part in [minuend, subtrahend] {
                match self.index_of(part).map(|i| &self.observation[i]) {
                    None => {
                        return refuse(format!("feature `{name}` is a difference of `{part}`, which is no feature"));
                    }
                    Some(Feature { role: Role::Difference { .. }, .. }) => {
                        return refuse(format!("feature `{name}` is a difference of `{part}`, itself a difference"));
                    }
                    Some(_) => {}
                }
            }
        }
        Ok(())
    }

    /// The place in an observation of the feature with this name.
    pub fn index_of(&self, name: &str) -> Option<usize> {
        self.observation.iter().position(|feature| feature.name == name)
    }

    /// Dimension of an observation.
    pub fn observation_size(&self) -> usize {
        self.observation.len()
    }

    /// Whether `action` can be taken: the right length, and every number finite.
    ///
    /// # Errors
    /// [`Error::Action`] names the length or the number that is wrong.
    pub fn check_action(&self, action: &[f32]) -> Result<()> {
        if action.len() != self.action_size {
            return Err(Error::action(
                &self.name,
                format!("an action has {} numbers, this one has {}", self.action_size, action.len()),
            ));
        }
        match action.iter().position(|a| !a.is_finite()) {
            Some(i) => Err(Error::action(&self.name, format!("action[{i}] is {}", action[i]))),
            None => Ok(()),
        }
    }
}
