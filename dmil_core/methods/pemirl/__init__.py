"""PEMIRL, behaviour-cloning variant: one policy for all tasks, conditioned on a context inferred from demonstrations.

Yu et al., "Meta-inverse reinforcement learning with probabilistic context variables" (2019), infer a context m from a
trajectory and learn for it a policy and a reward, by adversarial inverse reinforcement learning (Fu et al. 2018) with
an information term between m and τ. The appendix (F.2, Table 12) trains its models on demonstrations only. Per task,
m_c ~ q_ψ(·|τ_c) from C trajectories; of 16 others, with s along the demonstration, a the expert's action and
ã ~ π_ω(·|s,m),

- imitation: E[−log π_ω(a|s,m)] + 0.1 KL(q_ψ(m|τ_c) ‖ N(0, 1)), m reparametrised, trains ψ and ω;
- discriminator: −E log D(s,a,s′,m) − E log(1 − D(s,ã,s′,m)), D = eᶠ / (eᶠ + π_ω),
  f = r_θ(s,m) + γ h_φ(s′,m) − h_φ(s,m), trains θ and φ;
- information: −β E log q_ψ(m|τ̃), with τ̃ the states and the policy's actions, trains ψ; θ gets the gradient of
  −β Cov(log q_ψ(m|τ̃), R_θ) over the trajectories of one m (see `information_surrogate`);
- policy: −E[A log π_ω(ã|s,m)], A the reward f − log π_ω(ã|s,m), standardised over the batch, trains ω.

At test m is the mean of q_ψ's means over the shots, and π_ω's mean acts; there is no gradient step.

What this variant can teach. On demonstrated transitions the expert and the policy share s and s′, and f does not depend
on the action. So f tends to the middle of the two log π, and the policy's expected gradient is that of its entropy,
for any f: it widens σ and says nothing of the mean. All that the mean action learns comes from the imitation term;
reward and potential stand beside. Negatives with a mismatched m, one of N(0, 1), at least ask the reward which states
go with m, but the policy's expected gradient stays the entropy's, and q_ψ gets none from the discriminator.

What the appendix leaves open, and what we chose:

- One step on all losses together, by the outer Adam. PPO's clip of 0.02 (Table 12) bounds the later ones of several
  steps on the same actions; the first has the ratio 1, where the clipped surrogate has the gradient above. So there is
  no setting for it.
- Imitation has the weight 1, as in the original's pre-training (−log π + 0.1 KL), not the 0.01 of its second phase,
  which would leave the actions to a policy term that has nothing to teach here. That one has 0.1: it pulls each log σ
  up by its weight over the deviation of the rewards (at least √(d/2) for d actions), imitation holds it down by at
  most 1. With the weight 1, on the tests' toy, σ grew from 1 to 1.6, m came to mean nothing (KL 0.004), and
  the actions' error was that of m = 0; without the term it was about as with 0.1.
- m is inferred from one trajectory and explains others of the task, so it cannot hold what is particular to one; the
  original has it explain its own. Of the 16 trajectories each m explains 16 / C; with C = 1 there is one m a task, as
  in the original.
- q_ψ is one network on (s, a), averaged over the steps, as trajectories are ragged; the original reads a whole
  trajectory of fixed length. m has the original's 3 dimensions.
- R_θ is the mean of r_θ over the steps, where the original takes the sum. Replayed trajectories do not answer to the
  reward, so nothing but the discriminator, which is a mean over steps too, holds it.
- The discriminator does not train ψ, as in the text of the original; its code does it.
- σ of the policy does not depend on the state and starts at 0.3, where the original's starts at 1: Adam moves log σ by
  at most its learning rate a step, and from 1 the paper's 1e-4 would leave it above 0.8 for 2000 iterations, with
  likelihoods so flat that the divergence outweighs what m could contribute.
- The last state of a demonstration is its own successor. Hidden layers of reward and potential are as wide as the
  others.
"""
