//! Settings of [`Pets`](super::Pets).

use serde::{Deserialize, Serialize};

use crate::model::uncertainty::Risk;
use crate::model::{EnsembleConfig, Propagation};
use crate::plan::{ControlConfig, IcemConfig, PlannerConfig};
use crate::settings::{fits, ranges};

/// Settings of [`Pets`](super::Pets). [`Preset`](crate::agent::Preset) has tuned ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PetsConfig {
    /// The model.
    pub ensemble: EnsembleConfig,
    /// The planner and its settings.
    pub planner: PlannerConfig,
    /// How plans become control.
    pub control: ControlConfig,
    /// Time steps for which each action is held: a decision. The steps of the model, of plans and of the random actions' noise are
    /// decisions, and so costs, penalties and disagreement count decisions. A learned reward is the mean over a decision, with zeros
    /// after the end of the task; a known one is computed as if the decision were one time step. With k time steps, a plan over the
    /// same time takes 1/k of the predictions, and the model has 1/k of the transitions to learn from. `control.action_repeat` holds
    /// planned actions, too, but there the model predicts every time step.
    #[doc(alias = "frame skip")]
    pub action_repeat: usize,
    /// Whether plans pay `control.effort_penalty` and `control.change_penalty` in [`Mode::Explore`](crate::agent::Mode), too.
    /// Without, an agent moves smoothly in evaluations, and still tries what costs more.
    pub explore_with_costs: bool,
    /// Whether exploration plans in one member of the ensemble, as if that member were right. It is drawn at an episode's first decision,
    /// and again after a fit. So an episode tries what one possible model of the world thinks best; evaluations plan in all members. Alone,
    /// a member disagrees with nobody: in exploration, `disagreement_penalty` and `disagreement_bonus` have no effect, nor has `risk` if
    /// particles have no noise.
    ///
    /// Posterior sampling for reinforcement learning (Strens 2000; Osband, Russo & Van Roy 2013), with an ensemble in the place of the
    /// posterior as in bootstrapped DQN (Osband et al. 2016). Not in PETS. Members disagree because of their initial weights and
    /// minibatches, and if [`EnsembleConfig::bootstrap`] is set, because of their data.
    #[doc(alias = "Thompson sampling")]
    #[doc(alias = "PSRL")]
    pub posterior_sampling: bool,
    /// Weight of the terminal reward: this many times the reward of resting in a plan's last state is added to the plan's
    /// return, so that a short plan prefers to end well. The gradient steps of `gradient` and `hybrid` planners ascend the rewards alone.
    pub terminal_weight: f32,
    /// How uncertainty is propagated along imagined trajectories.
    #[doc(alias = "trajectory sampling")]
    pub propagation: Propagation,
    /// Particles: imagined trajectories of each candidate; a multiple of the ensemble's elites.
    pub particles: usize,
    /// How the returns of a candidate's particles become one score.
    pub risk: Risk,
    /// Return subtracted for each unit of disagreement between the members
    /// ([`ImaginedReturns::disagreement`](crate::model::ImaginedReturns)).
    pub disagreement_penalty: f32,
    /// Return added for each unit of disagreement, in [`Mode::Explore`](crate::agent::Mode) only. The penalty is subtracted there,
    /// too: if both are equal, exploration is neutral.
    #[doc(alias = "curiosity")]
    pub disagreement_bonus: f32,
    /// Time steps of random actions before the first fit.
    pub warm_up: usize,
    /// Exponent beta of the random actions' noise ([`ColoredNoise`](crate::plan::noise::ColoredNoise)): white noise (0)
    /// barely moves an arm.
    pub warm_up_noise_beta: f64,
    /// Time steps between two fits of the model.
    pub fit_every: usize,
    /// Capacity of the replay buffer, in decisions.
    pub replay: usize,
}

impl Default for PetsConfig {
    fn default() -> Self {
        Self {
            ensemble: EnsembleConfig::default(),
            planner: PlannerConfig::Icem(IcemConfig::default()),
            control: ControlConfig::default(),
            action_repeat: 1,
            explore_with_costs: true,
            posterior_sampling: false,
            terminal_weight: 0.0,
            propagation: Propagation::TsInf,
            particles: 5,
            risk: Risk::Neutral,
            disagreement_penalty: 0.0,
            disagreement_bonus: 0.0,
            warm_up: 500,
            warm_up_noise_beta: 2.0,
            fit_every: 200,
            replay: 1_000_000,
        }
    }
}

ranges!(PetsConfig {
    ensemble: Nested,
    planner: Nested,
    control: Nested,
    action_repeat: 1..=1000,
    explore_with_costs: Any,
    posterior_sampling: Any,
    terminal_weight: 0.0..=1e6,
    propagation: Any,
    particles: 1..=10_000,
    risk: Nested,
    disagreement_penalty: -1e6..=1e6,
    disagreement_bonus: -1e6..=1e6,
    warm_up: 2..=1_000_000_000,
    warm_up_noise_beta: 0.0..=10.0,
    fit_every: 1..=1_000_000_000,
    replay: 32..=100_000_000,
}
require particles.is_multiple_of(ensemble.elites) => "`particles` must be a multiple of `ensemble.elites`";
require control.suits(planner) => "`control.replan_every` must not exceed the planner's `horizon`";
require fits(&[planner.candidates(), planner.horizon(), control.action_repeat, *particles]) =>
    "the planner's candidates times `horizon` times `control.action_repeat` times `particles` do not fit into memory";
);
