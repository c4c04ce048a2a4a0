"""Two tets with a sphere, a capsule and a plane; a detection is brute force over all of their pairs."""

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.model.system import system_of
from diffvbd.reference import distance
from diffvbd.reference.scene import build_layout, build_scene
from diffvbd.testing import generator

FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
EDGES = np.array(list(itertools.combinations(range(4), 2)))
DHAT = 0.6


def two_tets(gap: float = 0.03) -> dv.TetMesh:
    """A tet whose tip points down at another one's upper face; generic, so that no two distances tie."""
    lower = np.array([[0.0, 0, 0], [1, 0.02, 0.1], [0.1, -0.05, 1.1], [0.33, -0.9, 0.4]])
    upper = np.array([[0.3, gap, 0.42], [1.1, 0.95, 0.2], [-0.3, 0.8, 0.1], [0.2, 0.9, 1.2]])
    tets = np.array([[0, 1, 2, 3], [4, 5, 6, 7]])
    points = np.concatenate((lower, upper))
    corners = points[tets]
    negative = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    tets[negative] = tets[negative][:, [0, 2, 1, 3]]
    return dv.TetMesh(points, tets)


SPHERE, CAPSULE = [[0.1, 0.42, 0.75]], [[-0.4, -0.55, 0.3], [0.7, -0.5, -0.45]]  # beside the upper and the lower tet
PLANE = [[0.0, -0.95, 0.0], [0.0, -0.95, 1.0], [1.0, -0.95, 0.03]]
COLLIDERS = torch.tensor(SPHERE + CAPSULE + PLANE, dtype=torch.float64)
RADII = torch.tensor([0.0] * 8 + [0.08, 0.1, 0.1, 0, 0, 0], dtype=torch.float64)  # of all corner points


def stand_in(model: dv.Model, **changes: Any) -> Any:
    """A model with what the step with contact reads."""
    names = ("tets", "rest_points", "density", "pinned", "color_ptr", "color_vertices", "energies", "saturation")
    model = system_of(model, dv.VBD(0.01, 1))
    values = {name: getattr(model, name) for name in (*names, "regularization", "relaxation", "block", "coarse")}
    values |= {"rigid": False, "starts_from": "predictor"}
    detections = changes.pop("detections", 1)
    barrier = {"name": "pair", "kappa": 200.0, "dhat": DHAT, "damping": 3.0, "detections": detections}
    values |= {
        "body": torch.tensor([0] * 4 + [1] * 4),
        "contact": SimpleNamespace(**barrier),
        "friction": SimpleNamespace(name="friction", coefficient=0.4, velocity=0.05),
        "collider_points": COLLIDERS,
        "surface_of_contact": SimpleNamespace(radius=RADII),
        "plane_points": torch.tensor([False] * 3 + [True] * 3),
    }
    return SimpleNamespace(**(values | changes))


def considered() -> list[tuple[list[int], int]]:
    """(corners, kind) of all pairs of different bodies."""
    pairs: list[tuple[list[int], int]] = []
    for a, b in ((0, 4), (4, 0)):
        pairs += [([a + p, *(b + face)], distance.POINT_TRIANGLE) for p in range(4) for face in FACES]
    pairs += [([*e, *(4 + f)], distance.EDGE_EDGE) for e in EDGES for f in EDGES]
    sphere, (c, d), plane = 8, (9, 10), [11, 12, 13]
    for a in (0, 4):
        pairs += [([s, *(a + face)], distance.POINT_TRIANGLE) for s in (sphere, c, d) for face in FACES]
        pairs += [([*(a + e), c, d], distance.EDGE_EDGE) for e in EDGES]
        pairs += [([a + p, *plane], distance.POINT_PLANE) for p in range(4)]
    return pairs


def detect(model: Any, x: Tensor, before: Tensor, now: Tensor) -> reference.Substep:
    """Brute force over `considered`, x [B, V, 3], colliders [B, Vc, 3]; lists what may come closer than dhat, too."""
    pairs = considered()
    corners, kind = torch.tensor(np.array([c for c, _ in pairs])), torch.tensor([k for _, k in pairs])
    radius = model.surface_of_contact.radius
    second = torch.where(kind == distance.EDGE_EDGE, corners[:, 2], corners[:, 1])
    offset = radius[corners[:, 0]] + radius[second]
    rest = torch.cat((model.rest_points, model.collider_points))[corners]
    edges = ((rest[:, 1] - rest[:, 0]) ** 2).sum(-1), ((rest[:, 3] - rest[:, 2]) ** 2).sum(-1)
    measure = torch.where(kind == distance.EDGE_EDGE, 1e-3 * edges[0] * edges[1], 1.0)
    rows, constants = [], []
    for b in range(len(x)):
        points = torch.cat((x[b], torch.where(model.plane_points[:, None], now[b], before[b])))
        gap = distance.distance(kind, points[corners]) - offset
        listed = gap < model.contact.dhat + 0.1
        tail = torch.stack((kind, torch.full_like(kind, b)), 1)
        rows.append(torch.cat((corners, tail), 1)[listed])
        constants.append(torch.stack((torch.full_like(gap, model.contact.dhat), offset, measure), 1)[listed])
    fractions, corrections = torch.ones(x.shape[:2]), torch.tensor([1.0, -1.0]).expand(2, len(x), 2, 2)
    return reference.Substep(torch.cat(rows), torch.cat(constants), x.new_zeros((len(x), 2, 3)), fractions,
                             fractions < 1, corrections)  # fmt: skip


def scene_of(model: Any, x: Tensor, parameters: dict[str, Any] | None = None) -> Any:
    return build_scene(model, build_layout(model), x, mu=1e4, lam=2e4, time_step=0.01, rest_points=None, density=None,
                       parameters=parameters)  # fmt: skip


def moved_state(model: Any, size: float = 0.02) -> Tensor:
    return model.rest_points + size * torch.as_tensor(generator("state").standard_normal((8, 3)))
