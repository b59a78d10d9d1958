//! Planning in latent space (Hansen et al. 2024, section 3.2): what the planner maximises, and a planner for each environment.

use super::TdMpc2Config;
use crate::agent::decision::Held;
use crate::agent::warm_up::RandomActions;
use crate::env::Spec;
use crate::model::implicit::{FrozenModel, ImplicitModel};
use crate::nn::values;
use crate::plan::{ActionCosts, ActionSequences, GuidedMppi, Objective, PlanObserver, Planner, WithCosts};
use crate::rng::{self, Rng};

use rand::RngExt;

/// The return of action sequences from one latent state, and the policy's proposals.
struct LatentReturns<'a> {
    model: &'a FrozenModel,
    z: Vec<f32>,
    critics: usize,
    discount: f32,
    rng: Rng,
}

impl<'a> LatentReturns<'a> {
    fn new(world: Imagined<'a>, obs: &[f32], rng: &mut Rng) -> Self {
        let Imagined { model, frozen, discount } = world;
        let z = values(&model.encode(obs)).to_vec();
        Self { model: frozen, z, critics: model.config().critics, discount, rng: rng::fork(rng) }
    }
}

impl Objective for LatentReturns<'_> {
    /// Each call draws two critics, and an action for the last state of each sequence.
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        let noise = rng::normals(sequences.count() * sequences.actions, &mut self.rng);
        let pair = two_of(self.critics, &mut self.rng);
        self.model.returns(&self.z, &sequences.values, sequences.horizon, &noise, pair, self.discount)
    }

    fn proposals(&mut self, count: usize, like: &ActionSequences) -> ActionSequences {
        let noise = rng::normals(count * like.horizon * like.actions, &mut self.rng);
        ActionSequences { values: self.model.policy_sequences(&self.z, like.horizon, &noise), ..like.clone() }
    }
}

/// Two different members of an ensemble.
pub(super) fn two_of(members: usize, rng: &mut Rng) -> [usize; 2] {
    let first = rng.random_range(0..members);
    let other = rng.random_range(0..members - 1);
    [first, if other < first { other } else { other + 1 }]
}

/// What a planner plans in.
#[derive(Clone, Copy)]
pub(super) struct Imagined<'a> {
    pub model: &'a ImplicitModel,
    pub frozen: &'a FrozenModel,
    pub discount: f32,
}

/// A planner with its own random numbers, for one environment.
pub(super) struct Controller {
    planner: GuidedMppi,
    /// The action that is held.
    pub held: Held,
    action_repeat: usize,
    noise: Noise,
    /// Whether it executes the mean of a plan.
    mean: bool,
    /// What plans pay for actions.
    costs: ActionCosts,
    pub rng: Rng,
}

/// The noise that is added to a plan's action, in units of the plan's deviation.
enum Noise {
    /// None: an evaluation.
    Absent,
    White,
    Coloured(RandomActions),
}

impl Noise {
    /// A number for each component of an action.
    fn draw(&mut self, components: usize, rng: &mut Rng) -> Vec<f64> {
        match self {
            Self::Absent => vec![0.0; components],
            Self::White => (0..components).map(|_| rng::normal(rng)).collect(),
            Self::Coloured(actions) => actions.deviates(rng).into_iter().map(f64::from).collect(),
        }
    }
}

impl Controller {
    /// The planner that explores.
    pub fn explorer(config: &TdMpc2Config, spec: &Spec, rng: Rng) -> Self {
        let decisions = spec.horizon.div_ceil(config.action_repeat);
        let coloured = |beta| Noise::Coloured(RandomActions::new(beta, decisions, spec.action_size));
        Self {
            noise: config.exploration_noise_beta.map_or(Noise::White, coloured),
            ..Self::without_noise(config, spec, rng)
        }
    }

    /// The planner of a slot, for evaluations. It depends on nothing but the slot's index.
    pub fn of_slot(config: &TdMpc2Config, spec: &Spec, index: usize) -> Self {
        Self {
            mean: config.evaluate_mean,
            // In the units in which rewards are learned.
            costs: ActionCosts {
                effort: config.effort_penalty / config.reward_unit,
                change: config.change_penalty / config.reward_unit,
            },
            ..Self::without_noise(config, spec, rng::stream(index as u64, "tdmpc2 seat"))
        }
    }

    fn without_noise(config: &TdMpc2Config, spec: &Spec, rng: Rng) -> Self {
        Self {
            planner: GuidedMppi::new(config.planner.clone(), spec.action_size),
            held: Held::default(),
            action_repeat: config.action_repeat,
            noise: Noise::Absent,
            mean: false,
            costs: ActionCosts::default(),
            rng,
        }
    }

    #[cfg(test)]
    pub fn planner(&self) -> &GuidedMppi {
        &self.planner
    }

    /// A new episode begins.
    pub fn reset(&mut self) {
        self.planner.reset();
        self.held.reset();
        if let Noise::Coloured(actions) = &mut self.noise {
            actions.reset();
        }
    }

    /// The next action from `obs`; plans when the last one has been held long enough.
    pub fn act(&mut self, world: Imagined, obs: &[f32], observer: &mut PlanObserver) -> Vec<f32> {
        let Self { planner, held, action_repeat, noise, mean, costs, rng } = self;
        let before = held.last(planner.deviation().len());
        held.next(*action_repeat, || {
            let mut objective = LatentReturns::new(world, obs, rng);
            let mut objective = WithCosts { objective: &mut objective, costs: *costs, before: &before };
            let planned = plan(planner, &mut objective, *mean, observer, rng);
            let numbers = planned.iter().zip(planner.deviation()).zip(noise.draw(planned.len(), rng));
            let action = numbers.map(|((a, std), deviate)| (f64::from(*a) + std * deviate).clamp(-1.0, 1.0) as f32);
            action.collect()
        })
    }
}

/// The first action of a plan, or of its `mean`; the rest of it stays for the next search.
fn plan(
    planner: &mut GuidedMppi,
    objective: &mut dyn Objective,
    mean: bool,
    observer: &mut PlanObserver,
    rng: &mut Rng,
) -> Vec<f32> {
    let mut actions = planner.plan(objective, observer, rng).actions;
    if mean {
        actions = planner.mean().iter().map(|a| *a as f32).collect();
    }
    actions.truncate(planner.deviation().len());
    planner.shift(1);
    actions
}
