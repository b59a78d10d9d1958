//! Trajectory sampling: particles, each assigned to one member at a time.

use super::noise::StepNoise;
use super::rollout::Rollout;

impl Rollout<'_> {
    /// Trajectory sampling (Chua et al. 2018, section 5 and Algorithm 1): every particle draws its next state from the
    /// member that it is assigned to, `s' ~ N(mean_b(s, a), variance_b(s, a))`. With TS-inf the assignment is fixed over the
    /// horizon, with TS1 it changes at every time step; with TS-inf-mean the noise is zero.
    ///
    /// Deviation for TS1: instead of drawing a member for each particle independently, the particles are permuted and
    /// divided equally among the members, and the permutation is the same for all candidates (common random numbers).
    ///
    /// At the `first` time step a candidate's particles still coincide, so each member needs one forward pass for all of
    /// its particles.
    #[doc(alias = "TS-inf")]
    #[doc(alias = "TS1")]
    pub(super) fn trajectory_sampling(&mut self, first: bool, noise: StepNoise) {
        let dynamics = self.imagination.dynamics;
        let (width, outputs, candidates) = (dynamics.observation_size(), dynamics.outputs(), self.candidates);
        let predicted = &dynamics.features.predicted;
        let particles_per_member = self.particles / dynamics.members();
        for (member, particles) in noise.order.chunks_exact(particles_per_member).enumerate() {
            let distinct = if first { &particles[..1] } else { particles };
            let rows = distinct.iter().flat_map(|p| p * candidates..(p + 1) * candidates);
            let head = dynamics.forward(member, rows, &self.states, &self.actions, &mut self.scratch);
            for (&p, head) in particles.iter().zip(head.chunks_exact(candidates * 2 * outputs).cycle()) {
                let noise = &noise.noise[p * outputs..][..outputs];
                let rows = p * candidates * width..(p + 1) * candidates * width;
                let rows = self.states[rows.clone()].chunks_exact(width).zip(self.next[rows].chunks_exact_mut(width));
                for (head, (state, next)) in head.chunks_exact(2 * outputs).zip(rows) {
                    let (change, std) = head.split_at(outputs);
                    let drawn = change.iter().zip(std).zip(noise).map(|((c, s), n)| c + s * n);
                    next.copy_from_slice(state);
                    predicted.iter().zip(drawn).for_each(|(i, drawn)| next[*i] += drawn);
                    dynamics.features.recompute_derived(next);
                }
            }
        }
    }

    /// Adds the disagreement of the members (epistemic uncertainty): for each predicted feature the standard deviation,
    /// over members, of the mean of the member's particles.
    pub(super) fn add_member_disagreement(&mut self, noise: StepNoise) {
        let dynamics = self.imagination.dynamics;
        let width = dynamics.observation_size();
        let (members, candidates, particles) = (dynamics.members(), self.candidates, self.particles);
        let particles_per_member = noise.order.len() / members;
        let mut means = vec![0.0; members * width];
        for (c, disagreement) in self.disagreement.iter_mut().enumerate() {
            means.fill(0.0);
            for (place, p) in noise.order.iter().enumerate() {
                let state = &self.next[(p * candidates + c) * width..][..width];
                let mean = &mut means[place / particles_per_member * width..][..width];
                mean.iter_mut().zip(state).for_each(|(m, x)| *m += x / particles_per_member as f32);
            }
            let variance: f32 = dynamics
                .typical_changes()
                .map(|(i, typical)| {
                    let centre = (0..members).map(|m| means[m * width + i]).sum::<f32>() / members as f32;
                    let squares = (0..members).map(|m| (means[m * width + i] - centre).powi(2)).sum::<f32>();
                    squares / members as f32 / (typical * typical)
                })
                .sum();
            let alive = (0..particles).filter(|p| self.alive[p * candidates + c]).count() as f32 / particles as f32;
            *disagreement += alive * (variance / dynamics.features.predicted.len() as f32).sqrt();
        }
    }
}
