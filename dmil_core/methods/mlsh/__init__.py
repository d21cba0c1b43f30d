"""Meta Learning Shared Hierarchies (Frans et al. 2018), its behaviour-cloning variant (F.2 and Table 11).

All tasks share a bank of K sub-skills, which is what meta-training learns. The high level belongs to one task: for
each sampled task, and again for a new one, it starts from fresh weights with a fresh Adam. It picks a sub-skill z for
every macro-step m of 3 steps, counted from a trajectory's start and cut off at its end; the states are those of the
demonstrations whatever is picked, so nothing corrects for who chose the actions there (F.2). Per sampled task:

    500 updates of the high level alone (the warm-up), then 1000 of both levels, each a step of Adam down
    L_h = −mean min(ρA, clip(ρ)A) + c mean (V_h(s_m) − R_m)²,     R_m = −Σ_{t ∈ m} ‖μ_z(s_t) − a_t‖²,
    L_l = −mean min(ρA, clip(ρ)A) + c mean (V_z(s_t) − r_t)²,     r_t = −‖ã_t − a_t‖², ã_t ~ N(μ_z(s_t), σ²),

with PPO's clip(ρ) in 1 ± 0.02 (Schulman et al. 2017). The slot returns the bank before minus after, and the outer step
goes to the slots' mean. At test the high level is learned anew on the support set while the sub-skills stay as they
are; then both levels take their modes.

What the appendix leaves open, and what is chosen here:

- What an update is. A batch of 900 state-action pairs is drawn together with sub-skills and actions by the policy of
  that moment, and serves for `passes` updates. So ρ is the policy of now over the one that drew: 1 at the batch's first
  update, and the clip bounds how far the others go. The authors' RL code passes 10 times with a clip of 0.2. With 0.02,
  10 passes missed the two skills of the tests' toy (in four new tasks 0.83 to 0.98 of the states after 40 iterations),
  and 3 passes found them (0.97 to 0.98 after 20).
- What a batch is made of: whole trajectories in random order, the last one cut off where the batch is full. A support
  set that is smaller comes more than once, each time with other sub-skills drawn.
- Values: each network has one more output, where the RL code has networks of their own. So the trunk is shared, and
  rewards are scaled to a root mean square of 1 first. Advantages are standardised over the batch; there, over each
  sub-skill's part of it.
- γ. Transitions follow the demonstration, so what is drawn at one state has no consequence at the next, and γ = 0
  loses nothing; the RL code has γ = 0.99 and λ = 0.98. Nor has a high level to explore beyond its own draws, where the
  RL code picks a tenth of the sub-skills at random.
- σ is a setting. The reward is best at σ = 0, where any step takes the ratio out of the clip and learning ends.
- The high level's return takes the error of the mean action, which acts at test: that of ã only adds noise to it.
- A fresh high level starts near uniform: its last layer begins small (Andrychowicz et al. 2021).
"""
