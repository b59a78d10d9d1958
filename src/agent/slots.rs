//! Environments that are evaluated side by side, and the memory that a policy keeps for each of them.

use crate::env::Env;

/// One of several environments that are evaluated side by side, as a policy meets it.
#[derive(Clone, Copy)]
pub struct Slot<'a> {
    /// Its index, the same throughout an episode.
    pub index: usize,
    /// Whether this is the first time step of an episode.
    pub first: bool,
    /// The observation.
    pub obs: &'a [f32],
    /// The environment itself. Only an oracle looks at it: [`Env`] objects can be downcast
    /// (`slot.env.downcast_ref::<MyEnv>()`).
    pub env: &'a dyn Env,
}

impl<'a> Slot<'a> {
    /// The slot of an environment that is on its own.
    pub fn single(first: bool, obs: &'a [f32], env: &'a dyn Env) -> Self {
        Self { index: 0, first, obs, env }
    }
}

impl std::fmt::Debug for Slot<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { index, first, obs, env } = self;
        write!(f, "Slot {{ index: {index}, first: {first}, obs: {obs:?}, env: {} }}", env.spec().name)
    }
}

/// The memory of a policy, one state for each slot: a recurrent state, a plan. A state is made anew when an episode
/// begins, from nothing but the slot's index, so that the same weights act alike in the same episode, whatever was
/// evaluated before.
#[derive(Debug)]
pub struct Slots<S> {
    states: Vec<Option<S>>,
}

impl<S> Default for Slots<S> {
    fn default() -> Self {
        Self { states: Vec::new() }
    }
}

impl<S> Slots<S> {
    /// The states of some slots, in their order; `fresh` makes the state of an index.
    ///
    /// # Panics
    /// If two slots have the same index.
    pub fn states(&mut self, slots: &[Slot], fresh: impl Fn(usize) -> S) -> Vec<&mut S> {
        let count = slots.iter().map(|slot| slot.index + 1).max().unwrap_or(0).max(self.states.len());
        self.states.resize_with(count, || None);
        for slot in slots {
            let state = &mut self.states[slot.index];
            if slot.first || state.is_none() {
                *state = Some(fresh(slot.index));
            }
        }
        let mut states: Vec<Option<&mut S>> = self.states.iter_mut().map(Option::as_mut).collect();
        slots.iter().map(|slot| states[slot.index].take().expect("slots have different indices")).collect()
    }

    /// The state of one index, made by `fresh` if there is none.
    pub fn state(&mut self, index: usize, fresh: impl Fn(usize) -> S) -> &mut S {
        if self.states.len() <= index {
            self.states.resize_with(index + 1, || None);
        }
        self.states[index].get_or_insert_with(|| fresh(index))
    }

    /// The state of an index, if it has one.
    pub fn existing(&self, index: usize) -> Option<&S> {
        self.states.get(index)?.as_ref()
    }

    /// Drops the state of an index: its next one is fresh.
    pub fn clear(&mut self, index: usize) {
        if let Some(state) = self.states.get_mut(index) {
            *state = None;
        }
    }
}
