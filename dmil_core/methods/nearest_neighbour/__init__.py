"""A control that learns nothing: the action of the support set's nearest state.

a = a_j,  j = argmin_i ‖s − s_i‖²  over all steps i of the support demonstrations, in standardised observations.

It is one line of arithmetic, and on a task whose starts and goals hardly differ hard to beat: what a method adds to
copying is measured against it. The appendix does not have it.
"""
