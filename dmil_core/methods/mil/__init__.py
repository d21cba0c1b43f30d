"""MIL: model-agnostic meta-learning over a policy that reads the demonstrations (Finn et al. 2017; F.2, Table 10).

The policy f_θ(s | D) is a transformer (Vaswani et al. 2017): the steps [s, a] of the support demonstrations D go into
its encoder, the current state is the decoder's query, its output the action. Per task, with support steps (s_t, a_t),
    L_inner(θ) = mean over t of ‖f_θ(s_t | D without t) − a_t‖²,    θ' = θ − α clip(∇ L_inner(θ)),
    L_outer(θ) = mean over query pairs (s, a) of ‖f_θ'(s | D) − a‖²,
and the outer Adam descends Σ over tasks of L_outer (Finn et al. 2017, "One-shot visual imitation learning via
meta-learning"). At test the same inner steps are taken on the support set, and f_θ'(s | D) acts.

What the appendix leaves open, and what is done here:

- **Copying.** The support states are asked for with the support itself in the encoder, where each answer could be read
  off. Hiding step t from the decoder alone is no help: self-attention has carried a_t into all other tokens. So every
  other step is predicted from the remaining ones, and the other way round: what is asked for never enters the encoder,
  and no path leads from a_t to its prediction. It is two passes of half the size. A learned first token is always
  there, so that a support of one step can be learned from: it is asked for with nothing else to go by.
- **Pairs.** Table 10's batch of 512 state-action pairs bounds both losses: the inner one asks for all steps of the
  support, or so many evenly spaced ones, and the outer one for as many pairs, drawn evenly from all steps of the task's
  other demonstrations. The encoder sees the whole support in the outer loss, and half of it in each inner pass.
- **Positions.** Three demonstrations do not fit 250 positions: places count from 0 in each demonstration, and a learned
  embedding marks which one a step belongs to. A longer demonstration is thinned out to 250 evenly spaced steps.
- **Shots.** A support set of meta-training has one to `shots` demonstrations, each as often, so that one model serves
  both the 1-shot and the 3-shot test. There is one embedding for each, none for more: more is a `UserError`.
- **Feed-forward units** are 2,048, as is usual with d_model 512; with it the model has 18.9 M parameters. Positions are
  encoded by sines. Departures from the original transformer stand in `transformer`.
- **Dropout** applies in the outer loss only: the inner gradient should be of the model that acts.
- **Inner loop.** One step, inner gradients clipped number by number at ±10, and second order, as in MIL. α is 0.001,
  the lower end of MIL's 0.001 to 0.01: with 512 units, 0.01 takes an untrained model's loss up. The size quick is of
  first order with α 0.003; with 0.01, on demonstrations of the kitchen, the loss without the inner step rose to over
  100, which a gradient taken after that step does not see. MIL's temporal loss is for videos without actions: here
  they are given.
- **Outer learning rate.** MIL's 1e-3 was for convolutions of 4 layers; with 512 units and no warm-up it is Table 9's
  1e-4 here, and 1e-3 for the small model of the size quick.
"""
