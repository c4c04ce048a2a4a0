"""A Model in a line of text."""

from __future__ import annotations

from typing import Any


def describe(model: Any) -> str:
    safeguards = [f"relaxation={model.relaxation:g}"] if model.relaxation != 1 else []
    safeguards += [f"saturation={model.saturation:g} m"] if model.saturation is not None else []
    safeguards += [f"regularization={model.regularization:g} kg"] if model.regularization else []
    safeguards += ["rigid=False"] if not model.rigid and not model.touches else []
    safeguards += [f'start="{model.start}"'] if model.start != "auto" else []
    safeguards += [f"coarse={model.coarse}"] if model.coarse is not None else []
    return (
        f"Model({model.num_vertices} vertices, {model.num_tets} tets, {int(model._pinned.sum())} pinned, "
        f"{model.num_colors} colors, mass {float(model._mass.sum()):.4g} kg, "
        f"energies=({', '.join(map(repr, model.energies))})"
        f"{f', {len(model.colliders)} colliders' if model.colliders else ''}"
        f"{''.join(', ' + s for s in safeguards)}, {model.dtype}, {model.device})"
    )
