//! A [`Tabletop`] is made: a task and its options are put together, and tried out once.

use std::sync::Arc;

use super::{
    ActionKind, HAND_VELOCITY, ObservationKind, Setup, TableOptions, TableTask, Tabletop, TabletopState, robosuite,
};
use crate::env::arm::{ArmDescription, JointVector};
use crate::env::osc::{Goal, OperationalSpaceController};
use crate::env::physics::{CONTROL_HZ, Physics};
use crate::env::{Feature, Spec};
use crate::error::{Error, Result};
use crate::rng;
use crate::settings::Ranges;

impl Tabletop {
    /// The Panda at the table with `task`.
    ///
    /// # Errors
    /// [`Error::Config`] if the task has no observation of the kind that `options` ask for, if its parts do not fit
    /// together (features and values, objects and what is drawn), or if its spec makes no sense ([`Spec::check`]).
    pub fn new(task: impl TableTask + 'static, options: TableOptions) -> Result<Self> {
        Self::with_shared(Arc::new(task), options)
    }

    /// [`Tabletop::new`] for a task that several environments share.
    ///
    /// # Errors
    /// As for [`Tabletop::new`].
    pub fn with_shared(task: Arc<dyn TableTask>, options: TableOptions) -> Result<Self> {
        options.check_at("env")?;
        let arm = ArmDescription::panda();
        let empty = Physics::new(arm.clone());
        let home = empty.kinematics(&arm.home);
        let goal = Goal { position: home.grip.translation.vector, orientation: home.grip.rotation };
        let state = TabletopState {
            controller: OperationalSpaceController::new(&arm, goal, arm.home),
            setup: Setup::default(),
            measured: home,
            measured_qd: JointVector::zeros(),
            finger_target: 0.0,
            elapsed: 0,
            compact: Vec::new(),
            physics: empty.clone(),
        };
        let action_size = match options.action {
            ActionKind::Hand => 4,
            ActionKind::Pose => 7,
        };
        let horizon = options.horizon.unwrap_or(task.horizon());
        let mut tabletop = Self {
            spec: Spec::new(task.name(), [], action_size, horizon, 1.0 / CONTROL_HZ).stages(task.stages()),
            home_orientation: goal.orientation,
            scripted: false,
            options,
            task,
            empty,
            state,
        };
        tabletop.try_out()?;
        Ok(tabletop)
    }

    /// Sets up an episode and takes it back: the features of the spec are known then, and whether the parts of the task
    /// fit together.
    fn try_out(&mut self) -> Result<()> {
        let refuse = |problem: String| Err(Error::Config(format!("{}: {problem}", self.task.name())));
        let mut physics = self.empty.clone();
        let setup = self.task.place(&mut physics, &mut rng::stream(0, "reset"));
        let (drawn, bodies) = (self.task.drawn(&setup).len(), setup.objects.len() + usize::from(setup.goal.is_some()));
        if drawn != bodies {
            return refuse(format!("`drawn` gives {drawn} bodies, objects and goal together are {bodies}"));
        }
        let mut tried = TabletopState { physics, setup, ..self.state.clone() };
        std::mem::swap(&mut tried, &mut self.state);
        let features = self.task.features();
        let compact = self.compact_observation();
        let values = compact.len() - HAND_VELOCITY.end;
        if values != features.len() {
            return refuse(format!("`observe` gives {values} numbers, `features` names {}", features.len()));
        }
        self.spec.observation = match self.options.observation {
            ObservationKind::Compact => hand_features().chain(features).collect(),
            ObservationKind::Robosuite => match robosuite::observe(self) {
                Some(values) => values.into_iter().map(|(name, _)| Feature::new(name)).collect(),
                None => return refuse("there is no robosuite observation of it (`TableTask::object_state`)".into()),
            },
        };
        self.scripted = self.task.scripted(&compact).is_some();
        self.state = tried;
        self.spec.check()
    }
}

/// The features at [`super::HAND_POSITION`] and [`HAND_VELOCITY`].
fn hand_features() -> impl Iterator<Item = Feature> {
    let position = [("hand x", -0.1), ("hand y", 0.0), ("hand z", 0.95)]
        .map(|(name, centre)| Feature::new(name).around(centre, 0.15));
    let velocity = ["hand vx", "hand vy", "hand vz"].map(|name| Feature::new(name).around(0.0, 0.2));
    position.into_iter().chain(velocity)
}
