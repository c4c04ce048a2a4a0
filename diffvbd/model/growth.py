"""How many sweeps keep the vibrations of stiff bodies from growing, from one step to the next.

A vibration far shorter than a step should be gone after it. K sweeps leave a share of it, an eigenvalue of the matrix of
these sweeps, of either sign or complex; the next step extrapolates from that, and its scheme lets it grow where the
share lies outside a region of the complex plane. The eigenvalues depend on the relaxation and on lam over mu.
"""

from __future__ import annotations

from bisect import bisect_left

RELAXATIONS = (1.0, 1.3, 1.5, 1.7)
RATIOS = (1.0, 2.0, 4.0, 9.0, 20.0, 60.0)  # lam / mu, Poisson's ratio 0.25, 0.33, 0.4, 0.45, 0.476, 0.492
MANY = 41  # more than 40

# Sweeps from which on none grows, for each relaxation and ratio [`stability.json`, python -m bench stability].
# ALL: of bodies that are held somewhere, all sweeps over-relaxed; BUT_LAST: the same but the last; FREE: of free bodies;
# COARSE: with coarse corrections.
Table = tuple[tuple[int, ...], ...]
ALL: dict[str, Table] = {
    "ImplicitEuler": ((1, 1, 1, 1, 2, 6), (2, 2, 2, 3, 5, 15), (3, 3, 3, 5, 9, 25), (4, 5, 6, 10, 41, 41)),
    "BDF2": ((1, 1, 1, 3, 6, 20), (3, 4, 4, 5, 10, 31), (4, 5, 6, 8, 16, 41), (7, 9, 13, 38, 41, 41)),
    "SDIRK2": ((7, 4, 4, 7, 17, 41), (10, 12, 13, 16, 25, 41), (11, 12, 15, 22, 41, 41), (14, 17, 24, 41, 41, 41)),
}
BUT_LAST: dict[str, Table] = ALL
FREE: dict[str, Table] = ALL
COARSE: dict[str, Table] = ALL


def least_sweeps(tables: tuple[dict[str, Table], ...], scheme: str, relaxation: float, ratio: float) -> int:
    """The most that one of the tables asks for; MANY: more than they know."""
    row = min(bisect_left(RELAXATIONS, relaxation), len(RELAXATIONS) - 1)
    column = min(bisect_left(RATIOS, ratio), len(RATIOS) - 1)
    return max(table[scheme][row][column] for table in tables)
