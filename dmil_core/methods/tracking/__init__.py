"""A control that learns nothing: closed-loop tracking of the demonstrated hand path.

With h the hand, o the object's first place, g the goal, those of the demonstration at its index i marked by a hat:
    e = ĥ_i + (1 − w_i)(o − ô) + w_i (g − ĝ) − h,
    a = clip(1[‖e‖ < 2δ] â_i + e / 4δ),    δ the hand's reach in a step,
    i ← i + 1 once ‖e‖ < 2δ, or after 15 steps without.
The weight w_i is 0 until the object first moves and then rises to 1 with the way of the hand, so that the path follows
the object until contact and the goal after it. Where a suite declares no object, as in joint space, nothing is shifted.
The support demonstration whose object and goal are nearest is tracked. The appendix does not have it.
"""
