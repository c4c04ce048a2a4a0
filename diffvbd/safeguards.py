"""Constants of the safeguards. They travel to the compiled kernels as arguments, so no header repeats these two.

diffvbd/reference has values of its own, on purpose: it imports nothing of what it checks. So has the guard of a floor,
8 ulps of a gap's terms below which no move is made: it stands in csrc/energies/floor_barrier.h and, as GUARD, in
reference/energies.py and reference/rigid.py. tests/test_layers.py compares those.
"""

SATURATION_EPS = 1e-12  # [m], keeps |d| + c + eps away from 0 (paper, appendix on safeguards)
FILTER_ETA = 0.9  # largest fraction of a gap that one move may close (method.md, section 6)
