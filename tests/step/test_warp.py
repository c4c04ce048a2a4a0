"""Claim: arrays of NVIDIA Warp and tensors share their memory by DLPack, and gradients pass through kernels of Warp."""

from typing import Any

import numpy as np
import pytest
import torch

import diffvbd as dv
from diffvbd.testing import relative_error, tolerance

wp = pytest.importorskip("warp", reason="needs warp-lang, which no extra of diffvbd has")
wp.config.quiet = True
wp.init()

MESH = dv.mesh.beam(4, 2, 2)
MODEL = dv.Model(MESH, pinned=MESH.points[:, 0] == MESH.points[:, 0].min())
STEP = {"mu": 1e4, "lam": 1e4, "solver": dv.VBD(0.01, 4)}


@wp.kernel
def drag(v: wp.array(dtype=wp.vec3d), k: wp.float64, force: wp.array(dtype=wp.vec3d)):  # pyright: ignore
    i = wp.tid()
    force[i] = -k * wp.length(v[i]) * v[i]


class Drag(torch.autograd.Function):
    """The kernel as a function of tensors v [V, 3] m/s and k [kg/m]; returns forces [V, 3] N."""

    @staticmethod
    def forward(ctx: Any, v: torch.Tensor, k: float) -> torch.Tensor:
        ctx.v, ctx.tape = wp.from_dlpack(v.detach().contiguous(), dtype=wp.vec3d), wp.Tape()
        ctx.v.requires_grad = True
        ctx.force = wp.empty(len(ctx.v), dtype=wp.vec3d, device=ctx.v.device, requires_grad=True)
        with ctx.tape:
            wp.launch(drag, len(ctx.v), inputs=[ctx.v, k], outputs=[ctx.force], device=ctx.v.device)
        return torch.from_dlpack(ctx.force).clone()

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        ctx.tape.backward(grads={ctx.force: wp.from_dlpack(grad.contiguous(), dtype=wp.vec3d)})
        return torch.from_dlpack(ctx.v.grad).clone(), None


def test_memory_is_shared_both_ways() -> None:
    x = MODEL.rest_points
    positions = wp.from_dlpack(x, dtype=wp.vec3d)
    assert positions.ptr == x.data_ptr() and positions.shape == (MESH.num_vertices,)
    forces = wp.zeros(MESH.num_vertices, dtype=wp.vec3d, device="cpu")
    tensor = torch.from_dlpack(forces)
    assert tensor.data_ptr() == forces.ptr and tensor.shape == x.shape and tensor.dtype == x.dtype
    forces.fill_(wp.vec3d(0.0, 1.0, 0.0))
    assert tensor[:, 1].min() == 1


def test_a_step_takes_what_warp_wrote() -> None:
    x, v = MODEL.rest_points, torch.zeros_like(MODEL.rest_points)
    values = np.linspace(-1.0, 1.0, MESH.num_vertices * 3).reshape(-1, 3)
    given = wp.array(values, dtype=wp.vec3d, device="cpu")
    found = dv.step(MODEL, x, v, force=torch.from_dlpack(given), **STEP)
    wanted = dv.step(MODEL, x, v, force=torch.as_tensor(values), **STEP)
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))


def test_gradients_pass_through_a_kernel() -> None:
    grads = []
    for force in (lambda v: Drag.apply(v, 0.3), lambda v: -0.3 * v.norm(dim=-1, keepdim=True) * v):
        v = torch.linspace(-1.0, 2.0, MESH.num_vertices * 3, dtype=torch.float64).reshape(-1, 3).requires_grad_()
        x, after = dv.step(MODEL, MODEL.rest_points, v, force=force(v), **STEP)
        (x.square().sum() + after.square().sum()).backward()
        grads.append(v.grad)
    assert grads[0].abs().max() > 0
    assert relative_error(*grads) < tolerance("adjoint")


def test_an_array_in_place_of_a_tensor_says_how_to_share_it() -> None:
    array = wp.zeros(MESH.num_vertices, dtype=wp.vec3d, device="cpu")
    x = MODEL.rest_points
    hint = r"got array: torch.from_dlpack\(array\) is a tensor in the same memory"
    with pytest.raises(TypeError, match="x: expected a tensor of shape .*" + hint):
        dv.step(MODEL, array, x, **STEP)
    with pytest.raises(TypeError, match="force: expected a tensor, " + hint):
        dv.step(MODEL, x, x, force=array, **STEP)
