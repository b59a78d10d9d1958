//! The environments, agents and presets that the command line and a study know by name.
//!
//! [`Registry::standard`] holds those of this crate. A program of one's own adds to it and hands it to the command line
//! (feature `cli`), which then trains, resumes, evaluates, compares and draws them as it does ours:
//!
//! ```no_run
//! # use handful::prelude::*;
//! # struct Puck; impl Puck { fn new() -> Self { Puck } }
//! # impl Env for Puck { fn spec(&self) -> &Spec { todo!() } fn reset(&mut self, _: u64) -> Vec<f32> { todo!() }
//! #   fn step(&mut self, _: &[f32]) -> Result<Step> { todo!() } }
//! # impl KnownReward for Puck { fn reward(&self, _: &[f32], _: &[f32], _: &[f32]) -> f32 { todo!() } }
//! # impl Snapshot for Puck { type State = (); fn snapshot(&self) {} fn restore(&mut self, _: &()) {} }
//! # #[cfg(feature = "cli")]
//! fn main() -> std::process::ExitCode {
//!     let puck = EnvEntry::new("puck", || Ok(Puck::new())).with_known_reward().with_oracle();
//!     handful::cli::main(&Registry::standard().env(puck))
//! }
//! ```

mod agents;
mod envs;

use std::path::Path;

use toml::{Table, Value};

pub use agents::AgentContext;
use agents::AgentEntry;
use envs::ErasedEnv;
pub use envs::{EnvEntry, NoOptions, Settings};

use super::config::{RunConfig, bad_config, upgrade_keys};
use super::folder::{load_weights, read_config};
use super::run::Run;
use super::runner::Budget;
use super::starts::{LIMIT, check_below};
use crate::agent::{Checkpoint, Learner, Method, PRESETS, Policy, preset_table, specialise};
use crate::env::Env;
use crate::error::{Error, Result};
use crate::rng;
use crate::settings::{check_choices, merge};

/// What a run is named by, and so cannot be changed by a file of settings.
const SET_ELSEWHERE: [(&str, &str); 4] =
    [("task", "--task"), ("method", "--method"), ("seed", "--seed"), ("shake", rng::SHAKE)];

/// Environments, agents and presets by name. A name has up to 64 letters (A to Z), digits, and `-` or `_` between them: it
/// becomes a folder and a part of reports. Another one is refused by [`Registry::config`].
pub struct Registry {
    envs: Vec<ErasedEnv>,
    agents: Vec<AgentEntry>,
    presets: Vec<(String, String)>,
    pub(super) quick_study: QuickStudy,
}

/// What the quick study compares.
#[derive(Clone, Default)]
pub(super) struct QuickStudy {
    pub tasks: Vec<String>,
    pub methods: Vec<String>,
    pub budget: Option<Budget>,
}

impl Registry {
    /// The tasks, agents and presets of this crate.
    pub fn standard() -> Self {
        let presets = PRESETS.iter().map(|(name, text)| (name.to_string(), text.to_string())).collect();
        let registry = Self { envs: Vec::new(), agents: Vec::new(), presets, quick_study: QuickStudy::default() };
        agents::register(envs::register(registry)).quick_study(
            &["reach"],
            // Runs start in this order. The longest come first, so that the cores finish at about the same time.
            &["dreamer", "pets-learned", "oracle", "tdmpc2", "pets", "sac", "scripted", "random"],
            Some(Budget { steps: 2_000, evaluate_every: 500, evaluation_episodes: 10, test_episodes: 20 }),
        )
    }

    /// Adds an environment; one of the same name is replaced.
    #[must_use]
    pub fn env<E: Env, O: Settings>(mut self, entry: EnvEntry<E, O>) -> Self {
        let entry = entry.erased();
        self.envs.retain(|other| other.name != entry.name);
        self.envs.push(entry);
        self
    }

    /// Adds an agent that learns, with settings of the type `C` (which stand in the table `[name]` of a preset or
    /// configuration file); one of the same name is replaced. A method of the same name comes with it, whose settings
    /// are the defaults and which trains for 10,000 steps, unless a preset of that name is there.
    #[must_use]
    pub fn agent<C, A>(self, name: &str, make: impl Fn(&AgentContext, C) -> Result<A> + Send + Sync + 'static) -> Self
    where
        C: Settings,
        A: Learner + 'static,
    {
        let make = move |context: &AgentContext, settings: C| Ok(Method::learner(make(context, settings)?));
        self.add_agent(AgentEntry::new(name, true, make))
    }

    /// Adds a policy that does not learn, in the same way. It is only tested.
    #[must_use]
    pub fn policy<C, P>(self, name: &str, make: impl Fn(&AgentContext, C) -> Result<P> + Send + Sync + 'static) -> Self
    where
        C: Settings,
        P: Policy + Checkpoint + 'static,
    {
        let make = move |context: &AgentContext, settings: C| Ok(Method::fixed(make(context, settings)?));
        self.add_agent(AgentEntry::new(name, false, make))
    }

    /// Says what the quick study compares, and with which budget: that is what a program does that is called without a command.
    #[must_use]
    pub fn quick_study(mut self, tasks: &[&str], methods: &[&str], budget: Option<Budget>) -> Self {
        let [tasks, methods] = [tasks, methods].map(|names| names.iter().map(ToString::to_string).collect());
        self.quick_study = QuickStudy { tasks, methods, budget };
        self
    }

    fn add_agent(mut self, entry: AgentEntry) -> Self {
        if self.presets.iter().all(|(name, _)| *name != entry.name) {
            let steps = if entry.learns { 10_000 } else { 0 };
            self.presets.push((entry.name.clone(), format!("agent = \"{}\"\nsteps = {steps}\n", entry.name)));
        }
        self.agents.retain(|other| other.name != entry.name);
        self.agents.push(entry);
        self
    }

    /// Adds a method: a preset in TOML, in the form of the files in `data/presets`; one of the same name is replaced.
    #[must_use]
    pub fn preset(mut self, method: &str, toml: &str) -> Self {
        self.presets.retain(|(name, _)| name != method);
        self.presets.push((method.into(), toml.into()));
        self
    }

    /// The names of all environments.
    pub fn env_names(&self) -> impl Iterator<Item = &str> {
        self.envs.iter().map(|entry| entry.name.as_str())
    }

    /// The names of all methods.
    pub fn method_names(&self) -> impl Iterator<Item = &str> {
        self.presets.iter().map(|(name, _)| name.as_str())
    }

    /// The configuration of a run: a method's preset for a task, changed by a file of the same form if one is given, and
    /// by `steps` if it is given. All defaults are filled in.
    ///
    /// # Errors
    /// If task or method are unknown, a preset has settings for an unknown task, `seed` or `steps` is too large, the file cannot be
    /// read, or a field or value in it is wrong.
    pub fn config(
        &self,
        task: &str,
        method: &str,
        seed: u64,
        steps: Option<usize>,
        file: Option<&Path>,
    ) -> Result<RunConfig> {
        let choices = self.choices(task)?;
        for (name, text) in &self.presets {
            // A preset that cannot be read is told when it is used.
            let tasks = toml::from_str(text).map_or(Ok(()), |preset| self.check_tasks(&preset));
            tasks.map_err(|problem| Error::Config(format!("the preset `{name}`: {problem}")))?;
        }
        let mut table = preset_table(&self.presets, task, method, &choices)?;
        if let Some(path) = file {
            self.change(&mut table, path, task, &choices)?;
        }
        table.insert("task".into(), Value::String(task.into()));
        table.insert("method".into(), Value::String(method.into()));
        table.insert("shake".into(), Value::Integer(rng::shake() as i64));
        // TOML's integers are signed: what does not fit would come out negative.
        for (field, value) in [("seed", Some(seed)), ("steps", steps.map(|steps| steps as u64))] {
            if let Some(value) = value {
                check_below(field, value, if field == "seed" { LIMIT } else { i64::MAX as u64 })?;
                table.insert(field.into(), Value::Integer(value as i64));
            }
        }
        let path = file.unwrap_or(Path::new(method));
        let mut config = RunConfig::from_table(table).map_err(|problem| bad_config(path, &problem))?;
        self.complete(&mut config, path).map_err(|problem| match file {
            Some(file) => in_file(file, problem),
            None => problem,
        })?;
        if config.steps == 0 && self.agent_entry(&config.agent)?.learns {
            return Err(Error::Config(format!("`steps` is 0, but {} learns; give at least 1", config.method)));
        }
        Ok(config)
    }

    /// The paths of the tables that name a variant, in the settings of a run on this task.
    fn choices(&self, task: &str) -> Result<Vec<String>> {
        let env = self.env_entry(task)?;
        Ok(self.agents.iter().flat_map(|agent| &agent.choices).chain(&env.choices).cloned().collect())
    }

    /// Puts what a file says over the settings of a run on this task.
    fn change(&self, table: &mut Table, path: &Path, task: &str, choices: &[String]) -> Result<()> {
        let changes = self.changes(path, task, table.get("agent"), choices)?;
        merge(table, changes, choices);
        check_choices(table, choices)
    }

    /// What a file changes for a task, in a method with this kind of `agent`.
    fn changes(&self, path: &Path, task: &str, agent: Option<&Value>, choices: &[String]) -> Result<Table> {
        let text = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
        let mut changes: Table = toml::from_str(&text).map_err(|problem| bad_config(path, &problem))?;
        let wrong = |problem: String| Error::Config(format!("{}: {problem}", path.display()));
        self.check_tasks(&changes).map_err(|problem| wrong(problem.to_string()))?;
        // Otherwise an old name would stand beside the new one that the preset uses.
        upgrade_keys(&mut changes);
        specialise(&mut changes, task, choices).map_err(|problem| wrong(problem.to_string()))?;
        for (key, instead) in SET_ELSEWHERE {
            if changes.contains_key(key) {
                return Err(wrong(format!("`{key}` cannot be set in a file; set it by {instead}")));
            }
        }
        match (changes.get("agent"), agent) {
            (Some(named), Some(agent)) if named != agent => {
                Err(wrong(format!("`agent` cannot be changed, it is {agent}; choose another method by --method")))
            }
            _ => Ok(changes),
        }
    }

    /// Fills in the defaults of environment and agent, in a configuration from `path`.
    fn complete(&self, config: &mut RunConfig, path: &Path) -> Result<()> {
        let (env, agent) = (self.env_entry(&config.task)?, self.agent_entry(&config.agent)?);
        let wrong = |problem: toml::de::Error| bad_config(path, &problem);
        config.env = (env.complete)("env", std::mem::take(&mut config.env)).map_err(wrong)?;
        config.settings = (agent.complete)(&config.agent, std::mem::take(&mut config.settings)).map_err(wrong)?;
        if !agent.learns && config.steps > 0 {
            let problem = format!("`steps` is {}, but {} does not learn; leave it out", config.steps, config.method);
            return Err(Error::Config(problem));
        }
        config.check()?;
        (env.check)("env", &config.env)?;
        (agent.check)(&config.agent, &config.settings)
    }

    /// The environment of a run.
    ///
    /// # Errors
    /// If the task is unknown, or the options do not suit it.
    pub fn make_env(&self, config: &RunConfig) -> Result<Box<dyn Env>> {
        (self.env_entry(&config.task)?.make)(&config.env)
    }

    /// The method of a run, before it has learned anything.
    ///
    /// # Errors
    /// If task or agent are unknown, or a setting cannot be used; [`Error::Unsupported`] if the agent needs something that the task
    /// does not have.
    pub fn method(&self, config: &RunConfig) -> Result<Method> {
        let (env, agent) = (self.env_entry(&config.task)?, self.agent_entry(&config.agent)?);
        let spec = (env.make)(&config.env)?.spec().clone();
        spec.check()?;
        let context = AgentContext { spec: &spec, seed: config.seed, env, options: &config.env };
        (agent.make)(&context, config.settings.clone())
    }

    /// Starts a run in `folder`, or resumes the one that is there.
    ///
    /// # Errors
    /// As [`Run::open`].
    pub fn open_run(&self, config: &RunConfig, folder: &Path) -> Result<Run<Box<dyn Env>>> {
        Run::open(self.as_begun(config, folder), self.method(config)?, || self.make_env(config), folder)
    }

    /// The configuration as the run in `folder` was begun with it: without the settings that did not exist at the time, if it has
    /// their defaults now.
    pub(crate) fn as_begun(&self, config: &RunConfig, folder: &Path) -> RunConfig {
        let same = |begun: &RunConfig| {
            let mut begun = begun.clone();
            self.complete(&mut begun, folder).is_ok() && begun == *config
        };
        read_config(folder).ok().map(|(_, begun)| begun).filter(same).unwrap_or_else(|| config.clone())
    }

    /// The method of the run in `folder`, with what it has learned.
    ///
    /// # Errors
    /// If there is no run, or its weights are missing, damaged, or another run's.
    pub fn trained_method(&self, folder: &Path) -> Result<(RunConfig, Method)> {
        self.trained_method_with(folder, None)
    }

    /// As [`Registry::trained_method`], but the method acts with the settings that `file` changes: with another planner, for
    /// example, in the model that the run has learned. Settings that belong to the weights cannot change; those
    /// of agents of one's own are checked only by the sizes of the weights.
    ///
    /// # Errors
    /// As [`Registry::trained_method`]; or if the file cannot be read, a field or value in it is wrong, or the weights do not fit
    /// the changed settings.
    pub fn trained_method_with(&self, folder: &Path, file: Option<&Path>) -> Result<(RunConfig, Method)> {
        let (path, as_read) = read_config(folder)?;
        let mut config = as_read.clone();
        self.complete(&mut config, &path)?;
        if let Some(file) = file {
            let mut table = config.to_table();
            self.change(&mut table, file, &config.task, &self.choices(&config.task)?)?;
            let mut changed = RunConfig::from_table(table).map_err(|problem| bad_config(file, &problem))?;
            let agent = self.agent_entry(&config.agent)?;
            let checked = self.complete(&mut changed, file);
            let checked = checked.and_then(|()| agent.check_trained_with(&config.settings, &changed.settings));
            checked.map_err(|problem| in_file(file, problem))?;
            config = changed;
        }
        let mut method = self.method(&config)?;
        // Not `config.learns()`: a file may say that it has no steps.
        if self.agent_entry(&config.agent)?.learns {
            load_weights(folder, &as_read, &mut method)?;
        }
        Ok((config, method))
    }

    /// # Errors
    /// If a table `[for.TASK]` is for a task that there is not.
    fn check_tasks(&self, settings: &Table) -> Result<()> {
        let mut tasks = settings.get("for").and_then(Value::as_table).into_iter().flat_map(Table::keys);
        tasks.try_for_each(|task| self.env_entry(task).map(|_| ()))
    }

    fn env_entry(&self, name: &str) -> Result<&ErasedEnv> {
        let found = self.envs.iter().find(|entry| entry.name == name);
        found.ok_or_else(|| Error::unknown("task", name, self.env_names()))
    }

    fn agent_entry(&self, name: &str) -> Result<&AgentEntry> {
        let found = self.agents.iter().find(|entry| entry.name == name);
        found.ok_or_else(|| Error::unknown("agent", name, self.agents.iter().map(|entry| entry.name.as_str())))
    }
}

/// A problem with settings, with the file that they come from.
fn in_file(file: &Path, problem: Error) -> Error {
    match problem {
        Error::Config(problem) => Error::Config(format!("{}: {problem}", file.display())),
        problem => problem,
    }
}

impl std::fmt::Debug for Registry {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let (envs, methods) = (self.env_names().collect::<Vec<_>>(), self.method_names().collect::<Vec<_>>());
        f.debug_struct("Registry").field("envs", &envs).field("methods", &methods).finish_non_exhaustive()
    }
}
