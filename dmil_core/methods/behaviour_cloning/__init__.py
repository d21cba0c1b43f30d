"""A control without hierarchy: behaviour cloning on all meta-training tasks, fine-tuned on the support set.

One network π(a|s) descends L_BC = mean ‖π(s) − a‖² (Pomerleau 1989) on the demonstrations that DMIL would draw as τ1 to
τ4, and at test on the support set, with DMIL's steps and learning rate. The difference to DMIL's success is what
the hierarchy and meta-learning add. The appendix does not have it; the network has the size of one of DMIL's.
"""
