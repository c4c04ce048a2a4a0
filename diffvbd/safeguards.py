"""Constants of the safeguards. They travel to the compiled kernels as arguments, so each exists once."""

SATURATION_EPS = 1e-12  # [m], keeps |d| + c + eps away from 0 (paper, appendix on safeguards)
FILTER_ETA = 0.9  # largest fraction of a gap that one move may close (method.md, section 6)
