"""OptionGAIL (Jing et al. 2021, "Adversarial option-aware hierarchical imitation learning"), and its half without play.

Both learn one option model of all meta-training tasks together (`options`); there is no meta-learning, and at test a
few epochs on the support set (F.3). Networks are DMIL's in layers and units, for a fair comparison; the original has
64x64. With J = Σ_t log π_H(o_t | s_t, o_{t−1}) + log π_L(a_t | s_t, o_t):

- ``option-gail-offline`` goes up the likelihood, log Σ_o exp J, by its exact gradient (forward-backward), so that the
  options part while none is sure; then it is hard EM: o* = argmax_o J by Viterbi, and up J at o*. It is named as what
  it is: not adversarial, and without a simulator.
- ``option-gail`` begins in the same way, and goes on as the original, in the environments of meta-training tasks:
  1. relabel: o* by Viterbi for the demonstrations;
  2. discriminate: d(s, a, o', o), one of (K + 1)·K outputs on (s, a), goes down the binary cross-entropy of the
     policy's steps, which are 1, and the demonstrations', which are 0;
  3. improve: PPO (Schulman et al. 2017) on the rewards −log σ(d), which both levels share.

What the sources leave open, and what is chosen here:

- *Levels.* As in DAC (Zhang & Whiteson 2019), the two levels are two decision processes on one trajectory: the high
  one decides in (s_t, o_{t−1}), the low one in (s_t, o_t). A critic gives V_L(s, o); V_H(s, o') = Σ_o π_H(o|s,o') V_L.
  Each level has advantages of its own (`ppo`, which says why they are not RLlib's), standardised per round.
- *Ends.* The reward is positive everywhere, so an episode cut off at its success would be worth less than one that
  never succeeds. Ends come from the protocol and not from the task: every episode is valued by V_H beyond its end.
- *Centre.* Rewards are taken less their mean over the round. As every episode goes on beyond its end, that changes no
  true advantage, and it keeps values near 0, where the critic starts.
- *Weight decay* is decoupled (Loshchilov & Hutter 2019): with moments that start at 0, an L2 term would move a weight
  of little gradient at the full rate.
- *Slots.* The original's epoch of 4,096 steps is an iteration here, its steps split over the tasks of its slots. A
  slot takes its own steps of Adam from where the iteration starts and returns the way, parameters before minus after;
  the outer step goes to the slots' mean (``outer_step: average``), as in federated averaging (McMahan et al. 2017).
  Adam's moments start at 0 in each slot. The offline iterations are run in the same way.
- *Pre-training.* How the appendix's authors pre-trained is not said; the original's 16 million steps are in the size
  ``paper``, at most half a million of them in ``quick``.
- *Test.* So many epochs of hard EM on the support set, each one step of Adam on all of it with fresh Viterbi labels.
  The discriminator and the critic rest: meta-testing tasks are not acted in before they are evaluated.
"""
