"""Tolerances of the tests: one table, with a reason each."""

# name: (value, reason). Relative to the largest entry (`relative_error`) unless the reason says otherwise.
TOLERANCE: dict[str, tuple[float, str]] = {
    "forward": (1e-14, "one step in float64: same update, sums in another order, about 50 ulps of the largest entry"),
    "adjoint": (1e-12, "floor of the bar on gradients; above it the bar is `spread_factor` times the scene's spread"),
    "spread_factor": (10.0, "how far the compiled gradient may lie beyond two references that differ in tet order"),
    "stiff_direction": (10.0, "error of a gradient over what an ulp in the inputs does to it, against 120 digits"),
    "headline_spread": (1e-13, "scenes better conditioned than this enter the headline table"),
    "headline": (5e-15, "what the headline table aims at: a few ulps per pair, averaged over a star"),
    "headline_median": (
        2e-14,
        "measured 1.1e-14: material gradients lose 1 / strain (1e-2) to cancellation",
    ),
    "headline_worst": (1e-12, "measured 4e-13; slivers and gaps amplify a rounding that permuted tets do not show"),
    "dual": (1e-14, "hand-written adjoint of one energy block against forward-mode scalars: no sweep amplifies it"),
    "dual_rounded": (
        1e-11,
        "the same adjoint in double: J - 1 and a gap lose what the state has lost",
    ),
    "solve_residual": (1e-15, "L D L^T of a 3x3 block against |A| |u| + |b|: 4 ulps whatever the conditioning"),
    "free_fall": (1e-13, "closed form; rounding of x + h v + h^2 g over the steps"),
    "block_residual": (1e-12, "residual right after its exact update, relative to the sum of its terms' magnitudes"),
    "closed_form": (1e-9, "converged sweeps against a formula: sweeps stop at that residual, not rounding"),
    "one_vertex": (1e-13, "one free vertex is solved by one sweep; rounding of the recurrence"),
    "property_factor": (100.0, "two samples of rounding in a scene of a few tets: ten times what spread_factor allows"),
    "property_subset": (1e-12, "the same sweeps in a leaner variant; a given rest shape rounds its metric anew"),
    "invariance": (1e-12, "rotation and translation change every rounding in the sweep"),
    "momentum": (1e-12, "converged step, relative to sum m |v|; sweeps stop at rounding level"),
    "rigid_momentum": (1e-14, "60 steps of one body, relative: each rounds its positions once, 1e-16"),
    "rigid_momentum_float32": (1e-5, "the same in float32"),
    "rigid_spin": (3e-3, "share of the spin that 60 steps leave: one sweep misses the shape of the body by that"),
    "rigid_fall": (1e-12, "20 steps of free fall, relative to the way: positions round at 1e-16 of a metre"),
    "rest_speed": (1e-3, "[m/s] of a body at rest on a plane; measured 2e-11, jelly still creeps"),
    "rest_drift": (1e-3, "[m] along a plane, of a body that nothing pushes there; measured 3e-5 while it settles"),
    "energy_gain": (1e-9, "share of its energy that a drop may gain: rounding of a sum of large terms"),
    "finite_difference": (1e-6, "central differences in float64: error h^2 + eps/h is about 1e-10, times curvature"),
    "contact_forward": (1e-13, "a step with contact: normals and weights lose eps L / gap, here a few digits"),
    "contact_adjoint": (1e-11, "floor of the bar on gradients of steps with contact; above it 10 times the spread"),
    "contact_finite_difference": (1e-5, "fifty steps in which features and bounds switch: kinks within the difference"),
    "float32_forward": (1e-5, "float32 near the origin: eps is 1.2e-7, times conditioning of the sweep"),
    "float32_gradient": (1e-4, "float32 near the origin: 1e-6 to 1e-5 measured, with room for stiff scenes"),
    "hessian": (1e-13, "first and second derivatives of one potential by two formulas: rounding of F and of the edges"),
    "conjugate_gradients": (1e-11, "a relative residual of 1e-13 times a condition number of 225"),
    "global_routes": (
        1e-10,
        "assembled against matrix-free, both solved to 1e-13: conditioning of the Hessian times that",
    ),
    "global_converged": (1e-9, "300 sweeps leave a residual near rounding, which the Hessian's conditioning amplifies"),
    "composed": (1e-14, "a hand-written or automatic vjp of small dense updates: a few ulps each"),
    "other_solvers": (5e-14, "XPBD and PD, one step of 20 sweeps, in which a few ulps of each update add up"),
    "other_solvers_rollout": (
        1e-13,
        "three steps of 20 sweeps: mass gradients of XPBD are a sum that cancels; double is 4e-14 from 80 bits",
    ),
    "sliding": (1e-3, "acceleration of a sliding block: its weight swings by what the settled start has left"),
    "stopped": (0.02, "speed left where a sliding block stops: friction fades below eps_v, and its shape swings"),
    "settled": (1e-3, "share of a weight that a stack still moves under after 100 steps from rest"),
    "contact_float32_forward": (5e-5, "bounds give 32 ulps of a position away, 1e-6 m; measured 3e-5 of the largest"),
    "contact_float32": (1e-2, "gradients through bounds and gaps in float32: measured 7e-3, without cut vertices 3e-4"),
    "minimum": (1e-7, "a search along lines stops where the energy no longer changes: half of the digits"),
    "memory": (0.1, "predicted against measured bytes: allocator granularity and small buffers"),
    "paper_generality": (2e-14, "the paper's worst is 1.1e-14: PD adds a solve with a factor in each iteration"),
}


def tolerance(name: str) -> float:
    """The value of an entry of `TOLERANCE`."""
    return TOLERANCE[name][0]
