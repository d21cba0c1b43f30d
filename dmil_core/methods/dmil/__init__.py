"""Dual Meta Imitation Learning (Gao et al. 2022): both levels of a hierarchical policy are meta-learned.

A high-level network π_h(z|s) picks one of K sub-skills π_k(a|s) at each step. Per task, the inner loop (Algorithm 1)
alternates
    θ_h ← θ_h − α ∇[CE(π_h, argmin_k ‖π_k(s) − a‖²) + λ L_aux]        on τ1 (equations 3 and 15),
    θ_k ← θ_k − α ∇ mean ‖π_k(s) − a‖² over {s : argmax π_h(s) = k}    on τ2 (equation 4),
and the outer loop descends the same losses at the adapted parameters on τ3 and τ4. The paper's variants are settings:
DMIL-High and DMIL-Low (F.3) adapt one level only, DMIL_nc (E.5) has λ = 0, DMIL_soft (E.6) a soft target for π_h.
"""
