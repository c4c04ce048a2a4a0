"""Bits of a scene's mask of energies; twins of those in csrc/energies/energies.h.

The elastic block, contact, then the energies of single vertices in the order of their list: a new one moves no bit.
"""

EXACT_BLOCK, PAPER_BLOCK = 1, 2  # of the elastic block
ELASTIC = EXACT_BLOCK | PAPER_BLOCK
CONTACT = 4
FIRST_VERTEX_BIT = 3  # shift of the first energy of energies.VERTEX_ENERGIES
FILTERS = 1 << FIRST_VERTEX_BIT  # the one energy with a step filter, FloorBarrier
# Bits that only Python reads: of a law that is not quadratic in one vertex, whose updates take fractions of their
# steps; and above the number of a generated law (ops/laws.py).
DECIDES, LAW_SHIFT = 1 << 15, 16
TAKES_FRACTIONS = FILTERS | DECIDES
KEEPS_POSITIONS = CONTACT | TAKES_FRACTIONS  # what is decided must come back to the bit
VERTEX_ENERGIES = DECIDES - (1 << FIRST_VERTEX_BIT)


# --- constants of the safeguards --------------------------------------------------------------------------------------

SATURATION_EPS = 1e-12  # [m], keeps |d| + c + eps away from 0 (paper, appendix on safeguards)
FILTER_ETA = 0.9  # largest fraction of a gap that one move may close (method.md, section 6)
