"""Find the size of a dress from the height of its hem (paper, appendix "Additional inverse problems").

An A-line dress of 924 vertices, a shell of two layers, hangs from its neck at 1.45 m; it starts from its rest shape and
sinks for 35 steps. Given is one number, the height of the hem at the end for a dress of size s = 0.910. Adam moves
log s from 0.45, where the hem is about at the waist, on the squared difference of the two heights [m^2]. The gradient
goes through the rest shape, that is through rest metric and mass, and through the initial positions.

What the size scales: the paper multiplies "all rest-pose radii" by s and calls the dress of 0.45 too short. Radii are
therefore taken from the center of the neck, so s is the size of the whole cut, while the cloth keeps its thickness.
A factor on the distances from the dress's axis alone hardly moves the hem: by half a centimeter from 0.45 to 0.91, and
not always the same way.

Where it starts: at the shape of size s, unstretched, with the neck held as wide as it is cut. The paper says that s
enters through the rest metric rather than through the initial state. But a dress of size 0.45 that starts in the shape
of size 1 snaps together from 2.2 times its length, which 40 sweeps a step do not resolve: the height of its hem is then
a rough function of s below 0.6, and the loss has local minima. From its own shape the hem falls steadily with s, by 0.7
to 1.0 m per unit.

Other choices: layers 1 cm apart, 100 kg/m^3, mu = lam = 10 kPa; h = 1/60 s, as 35 steps end at the 0.58 s of the
paper's figure; K = 40 with relaxation 1.7, which leaves the hem of the target 3 cm below that of converged steps, at
0.661 m (the paper: 0.654 m); the hem is the mean of the last ring of both layers. The run ends when the loss is 1e-10
of the first one, or after 80 iterations, the paper's count. The sweeps start from the predictor, as in the paper.
"""

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd.tasks.cloth import few_sweeps, mean_weights, ring_of_vertices
from diffvbd.tasks.problem import Problem, Settings, Stage
from diffvbd.tasks.report import pictures

TRUE_SIZE, START_SIZE = 0.910, 0.45
NECK, THICKNESS = 1.45, 0.01  # [m]
DENSITY = 100.0  # [kg/m^3]
MU = LAM = 1e4  # [Pa]
TIME_STEP = 1 / 60  # [s]
RELAXATION = 1.7
VIEW = (6.0, 32.0)  # of the pictures [degrees]


def problem(settings: Settings) -> Problem:
    (around, rings), steps, sweeps, iterations = ((22, 21), 35, 40, 80)
    if settings.quick:
        (around, rings), steps, sweeps, iterations = ((8, 6), 15, 15, 40)
    mesh = dv.mesh.dress(around, rings, THICKNESS, neck_height=NECK)
    ring = ring_of_vertices(mesh, around, rings)
    model = dv.Model(mesh, density=DENSITY, pinned=ring == 0).to(settings.device)
    solver = dv.VBD(TIME_STEP, sweeps, relaxation=RELAXATION, start="predictor")
    v = torch.zeros_like(model.rest_points)
    hem = mean_weights(ring == rings - 1, v)
    neck = torch.tensor((0.0, NECK, 0.0), dtype=v.dtype, device=v.device)

    @few_sweeps()
    def simulate(size: Tensor) -> Tensor:
        """Positions [m] after each step, shape [steps + 1, V, 3]."""
        shape = cut(model.rest_points, size, neck)
        return dv.rollout(model, shape, v, solver, steps=steps, mu=MU, lam=LAM, rest_points=shape).x

    def height(size: Tensor) -> Tensor:
        return hem @ simulate(size)[-1, :, 1]

    start = torch.tensor(START_SIZE, dtype=v.dtype, device=v.device)
    true = torch.full_like(start, TRUE_SIZE)
    with torch.no_grad():
        target = height(true)
    log_size = start.log().requires_grad_()

    @torch.no_grad()
    def motions() -> dict[str, Tensor]:
        return {"initial": simulate(start), "target": simulate(true), "recovered": simulate(log_size.exp())}

    return Problem(
        name="dress-size",
        parameters={"log_size": log_size},
        stages=[
            Stage(loss=lambda: (height(log_size.exp()) - target).square(), iterations=iterations, learning_rate=0.05,
                  tolerance=1e-10, capturable=True)
        ],
        estimates=lambda: {"size": log_size.exp().item()},
        truth={"size": TRUE_SIZE},
        protocol={"start_size": START_SIZE, "around": around, "rings": rings, "thickness": THICKNESS, "neck": NECK,
                  "density": DENSITY, "mu": MU, "lam": LAM, "steps": steps, "time_step": TIME_STEP, "sweeps": sweeps,
                  "relaxation": RELAXATION, "target_height": target.item()},
        **pictures(mesh.surface, motions, TIME_STEP, [0, steps // 2, steps], {"size": TRUE_SIZE}, view=VIEW),
    )  # fmt: skip


def cut(shell: Tensor, size: Tensor, center: Tensor) -> Tensor:
    """A shell of two layers [V, 3], its middle surface scaled about a center by `size`, its thickness kept."""
    inner, outer = shell.chunk(2)
    middle, half = 0.5 * (inner + outer), 0.5 * (outer - inner)
    scaled = center + size * (middle - center)
    return torch.cat([scaled - half, scaled + half])
