//! The environments of this crate by name.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::arm::Pose;
use super::cartpole::{CartPole, CartPoleState};
use super::pendulum::{Pendulum, PendulumState};
use super::scene::{Body, Camera};
use super::tabletop::{Door, Lift, Push, Reach, Stack, TableOptions, TableTask, Tabletop, TabletopState};
use super::{Env, KnownReward, Snapshot, Spec, Step};
use crate::error::{Error, Result};

/// The tasks of this crate: each makes an environment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Task {
    /// Bring the hand to a point: [`super::tabletop::Reach`].
    Reach,
    /// Push a cube to a goal: [`super::tabletop::Push`].
    Push,
    /// Take a cube from the table: [`super::tabletop::Lift`].
    Lift,
    /// Put one cube on another: [`super::tabletop::Stack`].
    Stack,
    /// Turn a handle and open a door: [`super::tabletop::Door`].
    Door,
    /// Swing up a pendulum: [`super::pendulum`].
    Pendulum,
    /// Balance a pole: [`super::cartpole`].
    Cartpole,
}

impl Task {
    /// All tasks.
    pub const ALL: [Task; 7] =
        [Task::Reach, Task::Push, Task::Lift, Task::Stack, Task::Door, Task::Pendulum, Task::Cartpole];

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Task::Reach => "reach",
            Task::Push => "push",
            Task::Lift => "lift",
            Task::Stack => "stack",
            Task::Door => "door",
            Task::Pendulum => "pendulum",
            Task::Cartpole => "cartpole",
        }
    }

    /// The arm's part of the task, for tasks at the table.
    fn at_table(self) -> Option<Arc<dyn TableTask>> {
        match self {
            Task::Reach => Some(Arc::new(Reach)),
            Task::Push => Some(Arc::new(Push)),
            Task::Lift => Some(Arc::new(Lift)),
            Task::Stack => Some(Arc::new(Stack)),
            Task::Door => Some(Arc::new(Door)),
            Task::Pendulum | Task::Cartpole => None,
        }
    }

    /// The hand-written policy of an arm task, from compact observations to actions. None for the others.
    pub fn scripted_policy(self, options: TableOptions) -> Option<impl Fn(&[f32]) -> Vec<f32> + Send + use<>> {
        let task = self.at_table()?;
        Some(move |obs: &[f32]| options.action_of_hand(task.scripted(obs).expect("our tasks have one")))
    }

    /// An environment for the task, with default options.
    pub fn make(self) -> World {
        self.make_with(TableOptions::default()).expect("default options suit every task")
    }

    /// An environment for the task.
    ///
    /// # Errors
    /// [`Error::Config`] if pendulum or cart-pole are given options, which only arm tasks have, or if the options do not
    /// make sense.
    pub fn make_with(self, options: TableOptions) -> Result<World> {
        if let Some(task) = self.at_table() {
            return Ok(Tabletop::with_shared(task, options)?.into());
        }
        if options != TableOptions::default() {
            return Err(Error::Config(format!("{} has no options; those are for the arm's tasks", self.name())));
        }
        Ok(match self {
            Task::Pendulum => World::Pendulum(Pendulum::default()),
            _ => World::CartPole(CartPole::default()),
        })
    }
}

impl std::fmt::Display for Task {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.pad(self.name())
    }
}

impl std::str::FromStr for Task {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let found = Task::ALL.into_iter().find(|task| task.name() == name);
        found.ok_or_else(|| Error::unknown("task", name, Task::ALL.map(Task::name)))
    }
}

/// Any of the environments of this crate, in one type.
///
/// ```
/// use handful::prelude::*;
///
/// let task: Task = "reach".parse()?;
/// let env = task.make_with(TableOptions { horizon: Some(50), ..TableOptions::default() })?;
/// assert_eq!((env.spec().name.as_str(), env.spec().horizon), ("reach", 50));
/// # Ok::<(), Error>(())
/// ```
#[derive(Debug)]
#[non_exhaustive]
#[allow(clippy::large_enum_variant)] // one of them exists at a time
pub enum World {
    /// An arm task.
    Tabletop(Box<Tabletop>),
    /// The pendulum.
    Pendulum(Pendulum),
    /// The cart-pole.
    CartPole(CartPole),
}

impl World {
    /// The arm at its table, if this is an arm task.
    pub fn tabletop(&self) -> Option<&Tabletop> {
        match self {
            World::Tabletop(world) => Some(world),
            _ => None,
        }
    }
}

impl From<Tabletop> for World {
    fn from(world: Tabletop) -> Self {
        World::Tabletop(Box::new(world))
    }
}

/// A state of any of the environments ([`Snapshot`]).
#[derive(Clone, Debug)]
#[non_exhaustive]
pub enum WorldState {
    /// Of an arm task.
    Tabletop(Box<TabletopState>),
    /// Of the pendulum.
    Pendulum(PendulumState),
    /// Of the cart-pole.
    CartPole(CartPoleState),
}

/// Makes the same call on any of the environments.
macro_rules! delegate {
    ($world:expr, $inner:ident => $call:expr) => {
        match $world {
            World::Tabletop($inner) => $call,
            World::Pendulum($inner) => $call,
            World::CartPole($inner) => $call,
        }
    };
}

impl Env for World {
    fn spec(&self) -> &Spec {
        delegate!(self, world => world.spec())
    }

    fn reset(&mut self, seed: u64) -> Vec<f32> {
        delegate!(self, world => world.reset(seed))
    }

    fn step(&mut self, action: &[f32]) -> Result<Step> {
        delegate!(self, world => world.step(action))
    }

    fn hand(&self) -> Option<[f64; 3]> {
        delegate!(self, world => world.hand())
    }

    fn scene(&self) -> Vec<Body> {
        delegate!(self, world => world.scene())
    }

    fn poses(&self) -> Vec<Pose> {
        delegate!(self, world => world.poses())
    }

    fn camera(&self) -> Camera {
        delegate!(self, world => world.camera())
    }

    fn position_of(&self, obs: &[f32]) -> Option<[f64; 3]> {
        delegate!(self, world => world.position_of(obs))
    }
}

impl KnownReward for World {
    fn is_known(&self) -> bool {
        delegate!(self, world => world.is_known())
    }

    fn reward(&self, obs: &[f32], action: &[f32], next_obs: &[f32]) -> f32 {
        delegate!(self, world => world.reward(obs, action, next_obs))
    }

    fn terminated(&self, next_obs: &[f32]) -> bool {
        delegate!(self, world => world.terminated(next_obs))
    }
}

impl Snapshot for World {
    type State = WorldState;

    fn snapshot(&self) -> WorldState {
        match self {
            World::Tabletop(world) => WorldState::Tabletop(Box::new(world.snapshot())),
            World::Pendulum(world) => WorldState::Pendulum(world.snapshot()),
            World::CartPole(world) => WorldState::CartPole(world.snapshot()),
        }
    }

    /// # Panics
    /// If the state is one of another kind of environment.
    fn restore(&mut self, state: &WorldState) {
        match (self, state) {
            (World::Tabletop(world), WorldState::Tabletop(state)) => world.restore(state),
            (World::Pendulum(world), WorldState::Pendulum(state)) => world.restore(state),
            (World::CartPole(world), WorldState::CartPole(state)) => world.restore(state),
            _ => panic!("a state can only be restored in the kind of world that it was taken from"),
        }
    }
}
