"""The step inside torch's own machinery: compile, checkpoint, autocast, copies of a Model, opcheck."""

import copy
import io
import pickle
from typing import Any

import pytest
import torch
from helpers.marks import slow
from helpers.small_step import (
    ARGUMENTS,
    STEP,
    assert_same,
    gradients,
    loss,
    run_step,
    scalar,
    small_inputs,
    small_model,
)
from torch import Tensor
from torch.utils.checkpoint import checkpoint

import diffvbd as dv
from diffvbd import ops
from diffvbd.adjoint.contact_lag import no_pairs
from diffvbd.contact.detection import detect
from diffvbd.model.rest import shape_gradients
from diffvbd.step.coarse import coarse_parts
from diffvbd.step.rigid_contact import bodies_of
from diffvbd.testing import relative_error, tolerance

# --- torch.compile ----------------------------------------------------------------------------------------------------


@pytest.fixture
def fresh_compiler() -> None:
    torch._dynamo.reset()


def compiled_gradients(device: str, backend: str, names: tuple[str, ...], plain: bool, **options: Any) -> None:
    if plain:
        options["energies"] = (dv.StableNeoHookean(),)
    model = small_model(device, **options)
    arguments = {k: t for k, t in small_inputs(model).items() if k in names}
    expected = gradients(model, arguments)
    run = torch.compile(lambda a: loss(model, a), fullgraph=True, backend=backend)
    leaves = {k: t.clone().requires_grad_() for k, t in arguments.items()}
    value = run(leaves)
    actual = dict(zip(leaves, torch.autograd.grad(value, list(leaves.values())), strict=True))
    assert relative_error(value, loss(model, arguments)) <= tolerance("formula")
    assert_same(actual, expected)


def test_compile_of_a_plain_step(device: str, fresh_compiler: None) -> None:
    compiled_gradients(device, "aot_eager", ("x", "v", "mu", "lam"), plain=True)


@pytest.mark.slow  # the next one has them all, too
def test_compile_of_a_step_with_every_argument(device: str, fresh_compiler: None) -> None:
    compiled_gradients(device, "aot_eager", ARGUMENTS, plain=False)


def test_compile_of_a_step_with_coarse_corrections(device: str, fresh_compiler: None) -> None:
    compiled_gradients(device, "aot_eager", ARGUMENTS, plain=False, coarse=dv.CoarseSpace(functions=4, groups=1))


@pytest.mark.slow
def test_compile_with_inductor(device: str, fresh_compiler: None) -> None:
    compiled_gradients(device, "inductor", ARGUMENTS, plain=False)


@pytest.mark.parametrize("pinned", [[0, 1], slow([])], ids=["pinned", "free"])
def test_compile_of_a_step_without_gradients(device: str, fresh_compiler: None, pinned: list[int]) -> None:
    model = small_model(device, pinned=pinned)
    arguments = small_inputs(model)
    with torch.no_grad():
        x, v = torch.compile(lambda a: run_step(model, a), fullgraph=True, backend="aot_eager")(arguments)
    expected = run_step(model, arguments)
    assert torch.equal(x, expected[0]) and torch.equal(v, expected[1])


@pytest.mark.parametrize("batched", [False, True])
def test_compile_of_one_tensor_as_two_arguments(device: str, fresh_compiler: None, batched: bool) -> None:
    model = small_model(device, energies=(dv.StableNeoHookean(),))
    inputs = small_inputs(model)
    x, v = (inputs[k].expand(2, -1, -1).contiguous() if batched else inputs[k] for k in ("x", "v"))
    modulus = inputs["mu"][None] if batched else inputs["mu"]

    def run(modulus: Tensor) -> Tensor:
        return scalar(*dv.step(model, x, v, mu=modulus, lam=modulus, **STEP))

    grads = []
    for function in (run, torch.compile(run, fullgraph=True, backend="aot_eager")):
        leaf = modulus.clone().requires_grad_()
        grads += torch.autograd.grad(function(leaf), leaf)
    assert grads[0].abs().max() > 1e-3
    assert relative_error(grads[1], grads[0]) <= tolerance("formula")


@pytest.mark.parametrize("every", [slow(None), 2])
def test_compile_of_a_rollout(device: str, fresh_compiler: None, every: Any) -> None:
    model = small_model(device)
    inputs = small_inputs(model)

    def run(v: Tensor, mu: Tensor, force: Tensor) -> Tensor:
        trajectory = dv.rollout(model, inputs["x"], v, steps=3, mu=mu, lam=2.0, force=dv.per_step(force),
                                checkpoint_every=every, **STEP)  # fmt: skip
        return scalar(trajectory.x[-1], trajectory.v[-1]) + trajectory.x.square().sum()

    values = {"v": inputs["v"], "mu": inputs["mu"], "force": torch.stack([k * inputs["force"] for k in (1, 2, 3)])}
    results = []
    for function in (run, torch.compile(run, fullgraph=True, backend="aot_eager")):
        leaves = {k: t.clone().requires_grad_() for k, t in values.items()}
        results.append(dict(zip(values, torch.autograd.grad(function(**leaves), list(leaves.values())), strict=True)))
    assert_same(results[1], results[0])
    arrays = (getattr(model.mesh, name) for name in ("points", "tets", "body", "volume"))
    assert not any(array.flags.writeable for array in arrays)  # as torch.compile makes those it meets


# --- checkpoint, autocast, copies -------------------------------------------------------------------------------------


@pytest.mark.parametrize("reentrant", [False, True])
def test_checkpoint(device: str, reentrant: bool) -> None:
    model = small_model(device)
    inputs = small_inputs(model)
    leaves = {k: t.clone().requires_grad_() for k, t in inputs.items()}
    names = list(leaves)

    def run(*values: Tensor) -> tuple[Tensor, Tensor]:
        return run_step(model, dict(zip(names, values, strict=True)))

    scalar(*checkpoint(run, *leaves.values(), use_reentrant=reentrant)).backward()
    assert_same({k: t.grad for k, t in leaves.items()}, gradients(model, inputs), 0.0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_autocast_changes_nothing(device: str, dtype: torch.dtype) -> None:
    model = small_model(device, dtype)
    inputs = small_inputs(model)
    expected = run_step(model, inputs)
    slopes = gradients(model, inputs)
    with torch.autocast(device, dtype=torch.bfloat16):
        actual = run_step(model, inputs)
        cast = gradients(model, inputs)
        rebuilt = small_model(device, dtype)
    assert actual[0].dtype == dtype
    assert torch.equal(actual[0], expected[0]) and torch.equal(actual[1], expected[1])
    assert_same(cast, slopes, 0.0)
    assert torch.equal(rebuilt.mass, model.mass)


def saved_and_loaded(model: dv.Model) -> dv.Model:
    buffer = io.BytesIO()
    torch.save(model, buffer)
    return torch.load(io.BytesIO(buffer.getvalue()), weights_only=False)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)), saved_and_loaded])
def test_copies_of_a_model_compute_the_same(device: str, copied: Any) -> None:
    model = small_model(device, saturation=0.3, relaxation=1.2)
    inputs = small_inputs(model)
    twin = copied(model)
    assert twin is not model and twin._mass.data_ptr() != model._mass.data_ptr()
    assert repr(twin) == repr(model)
    for a, b in zip(run_step(twin, inputs), run_step(model, inputs), strict=True):
        assert torch.equal(a, b)
    assert_same(gradients(twin, inputs), gradients(model, inputs), 0.0)


def test_a_model_survives_two_backwards_and_copies(device: str) -> None:
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=-0.2, kappa=2.0, dhat=0.5), dv.Anchor(0.7))
    model = dv.Model(dv.mesh.cube(), density=2.0, pinned=[0], energies=energies, device=device)
    twin = pickle.loads(pickle.dumps(copy.deepcopy(model)))
    assert repr(twin) == repr(model)
    x = (model.rest_points + 0.01).requires_grad_()
    slopes = []
    for _ in range(2):
        out = dv.step(model, x, torch.zeros_like(x), mu=3.0, lam=2.0, **STEP)
        slopes += torch.autograd.grad(scalar(*out), x)
    assert slopes[0].abs().max() > 0 and torch.equal(slopes[0], slopes[1])


# --- raw operators ----------------------------------------------------------------------------------------------------


def raw_arguments(device: str, policy: int) -> dict[str, tuple[Any, ...]]:
    """Arguments of every raw operator, in the order of its schema."""
    model = small_model(device)
    inputs = small_inputs(model)
    settings = model.settings(0.3, 2, scenes=1)  # sizes, energies, data_count, numbers, sweeps, launch
    assert len(settings.launch) == (4 if device == "cuda" else 0)
    x, y = inputs["x"][None], (inputs["x"] + 0.1 * inputs["v"])[None]
    given = ops.SweepFields(x, x, y, inputs["mu"][None], inputs["lam"][None], model.mass[None], model._packed_rest,
                            model._energy_data)  # fmt: skip
    fields = ops.as_list(given, x)
    sweep = (*fields, model._plan, *settings, policy, -1, True)
    x, tape, cut, corrections = torch.ops.diffvbd.sweep(*sweep)
    tets, star_ptr, star = model._topology
    points = model.rest_points[None].contiguous()
    corners = torch.ops.diffvbd.tet_gather(points, tets)
    arguments = {
        "sweep": sweep,
        "pack_rest": (torch.rand(1, model.num_tets, 7).to(x), model._plan, model._sizes),
        "tet_gather": (points, tets),
        "star_sum": (corners, star_ptr, star, False),
        "row_sum": (inputs["x"],),
    }
    if policy != ops.NO_TAPE:
        bars = (torch.ones_like(x), x, tape, corrections, cut)
        arguments["sweep_backward"] = (*fields, *bars, model._plan, *settings, policy, [True] * 5)
    if policy == ops.FULL_TAPE:  # those that know no tape, once
        arguments |= coarse_arguments(device) | start_arguments(device)
        arguments |= rise_arguments(device)
    return arguments | (fused_arguments(policy) if device == "cuda" else {})


def start_arguments(device: str) -> dict[str, tuple[Any, ...]]:
    """The same of the start of a part of a step with contact: two boxes that go through each other."""
    boxes = [dv.mesh.box(2, 0.2), dv.mesh.box(2, 0.2).translate((0.02, 0.208, 0.03))]
    model = dv.Model(dv.mesh.join(boxes), energies=(dv.PairBarrier(dhat=0.02),), device=device)
    surface, barrier = model.surface_of_contact, model.contact
    assert surface is not None and barrier is not None
    x, none = model.rest_points[None].contiguous(), model.rest_points.new_empty((0,))
    points = x.new_empty((1, 0, 3))
    room = torch.full((1, surface.bodies + 1), 0.1, dtype=x.dtype, device=device)
    listed = detect(x, none, points, points, surface, barrier, 2000, room)[:4]
    move, u = torch.zeros_like(x), x.new_zeros((1, surface.bodies, 3))
    move[0, 8:, 1] = -0.05
    held, body, planes = surface.held, surface.body, x.new_tensor([[0.0, 1.0, 0.0, 0.19, 1e3, 0.02, 0.0]])
    bodies = (held, surface.held_bodies, body, surface.body_order, surface.body_ptr)
    filtered, own_room, share = (
        (planes, none, *bodies, 0.9),
        torch.full_like(x[..., 0], 0.1),
        x.new_ones((1, len(held))),
    )
    floor, frames, stopped = (x, u, move, planes, none, *bodies[:1], *bodies[3:]), room[:, 1:], room[:, 1:] > 1
    whole, state = (u, move, frames), torch.zeros_like(own_room, dtype=torch.uint8)
    advance = (x, move, u, x, none, points, points, held, body, own_room, x, own_room, *listed, True, False)
    share, _ = torch.ops.diffvbd.contact_advance(*advance)
    assert 0 < share[0, 8:].min() < 1 and (share[0, :8] == 1).all()
    mass, data = model.mass[None], model._energy_data
    own = (x, x, x + move, mass, data, none, *bodies_of(model), points, points, x.new_ones((1,)), *listed)
    touching = (*own, none, *no_pairs(x, 0)[:1], *no_pairs(x, 0)[2:], none, x, own_room)
    numbers, everyone = (model._data_count, 0.01, 1e-3), (body.new_empty((0,), dtype=torch.bool), False)
    points_of = torch.cat([move, torch.zeros_like(points)], 1)
    centers, motion, factor, groups = torch.ops.diffvbd.contact_rigid_system(*touching, *numbers, *everyone)
    share_of = torch.ops.diffvbd.contact_rigid_move(*touching, centers, motion, *numbers, everyone[0])[1]
    made = [[t] for t in (x, motion, share_of, factor, groups)]
    assert motion.abs().max() > 0 and share_of.max() > 0 and torch.isfinite(factor).all()
    return {
        "contact_rigid_system": (*touching, *numbers, *everyone),
        "contact_rigid_move": (*touching, centers, motion, *numbers, everyone[0]),
        "contact_rigid_backward": (*touching, points_of, points_of, groups, *numbers),
        "contact_rigid_reverse": (*touching, *made, move, *numbers, True),
        "contact_above_floor": floor,
        "contact_above_floor_backward": (move, *floor, True),
        "contact_frames": (x, move, u, move, move, frames, room, room, *bodies),
        "contact_bends": (x, move, *whole, frames, stopped, room, *filtered),
        "contact_hold": (move, state, state > 0),
        "contact_held_up": (x, move, share, state, *bodies),
        "contact_falls": (x, move, move, *whole, share, state, *filtered),
        "contact_start": (x, move, move, *whole, share, share, stopped, *filtered),
        "contact_start_backward": (move, x, move, move, *whole, share, share, *filtered, True),
        "contact_advance": advance,
        "contact_keep": (torch.arange(len(listed[0]), device=device) % 3 == 0, *listed, False),
        "contact_narrow": (x, none, points, own_room, *listed[:3]),
    }


def coarse_arguments(device: str) -> dict[str, tuple[Any, ...]]:
    """The same of the matrix of a coarse space and of what it is made of."""
    mesh = dv.mesh.cube(4, size=0.3)
    model = dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, coarse=dv.CoarseSpace(functions=8), device=device)
    plan, x = model._coarse_plan, model.rest_points[None].contiguous()
    moduli = torch.full((1, 1), 1e4, dtype=x.dtype, device=device)
    parts = coarse_parts(model, moduli, moduli, None, None, None)
    given = (x, parts.stiffness, parts.mass, plan.plan, plan.moments, plan.volume)
    last = (plan.sizes, 0.3)
    factor = torch.ops.diffvbd.coarse_matrix(*given, *last, True)
    out = {"coarse_matrix": (*given, *last, True), "coarse_matrix_backward": (*given, torch.ones_like(factor), *last)}
    tets = shape_gradients(model.rest_points[model.tets][None])
    sums = (moduli.expand(-1, model.num_tets).contiguous(), moduli, *tets, plan.plan, plan.weights)
    rest = (plan.plan, plan.weights, plan.sizes)
    return out | {
        "coarse_stiffness": (*sums, plan.sizes),
        "coarse_stiffness_backward": (*sums, torch.ones_like(parts.stiffness), plan.sizes, True),
        "coarse_mass": (model.mass[None], *rest),
        "coarse_mass_backward": (torch.ones_like(parts.mass), *rest),
    }


def rise_arguments(device: str) -> dict[str, tuple[Any, ...]]:
    """The same of the potentials of bodies."""
    mesh = dv.mesh.cube(3, size=0.3)
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(-0.1), dv.PairBarrier())
    model = dv.Model(mesh, energies=energies, device=device)
    moving, x = model._moving, model.rest_points[None].contiguous()
    material = x.new_full((1, *moving.tet.shape, 2), 1e4).transpose(-1, -2).contiguous()
    of = model._other_bodies.of
    given = (x, 1.1 * x, x, x, model.mass[None], model._energy_data, x.new_empty((0,)), material, moving.rest,
             moving.order, moving.ptr, of, moving.corner, moving.block_ptr)  # fmt: skip
    return {"potential_rise": (*given, model._data_count, 0.3)}


def fused_arguments(policy: int) -> dict[str, tuple[Any, ...]]:
    """The same of the operators that only CUDA has; their only energy is that of the tets."""
    model = small_model("cuda", energies=(dv.StableNeoHookean(),))
    inputs = {name: value[None] for name, value in small_inputs(model).items()}
    state = (inputs["x"], inputs["v"], inputs["force"], inputs["prescribed"])  # a force is as good an acceleration
    fields = [*state, inputs["mu"], inputs["lam"], model.mass[None], model._packed_rest]
    settings = model.settings(0.3, 2, scenes=1)
    step = (*fields, model._plan, *settings, policy)
    x, v, tape = torch.ops.diffvbd.fused_step(*step)
    arguments: dict[str, tuple[Any, ...]] = {"fused_step": step}
    if policy != ops.NO_TAPE:
        bars, wants = (torch.ones_like(x), torch.ones_like(v)), [True] * 7
        arguments["fused_step_backward"] = (*fields, *bars, x, tape, model._plan, *settings, policy, wants)
    return arguments


@pytest.mark.parametrize("policy", [ops.NO_TAPE, ops.COMPACT_TAPE, ops.FULL_TAPE])
def test_opcheck_of_the_raw_operators(device: str, policy: int) -> None:
    for name, arguments in raw_arguments(device, policy).items():
        torch.library.opcheck(getattr(torch.ops.diffvbd, name).default, arguments)


@pytest.mark.parametrize("lanes", ops.LANES.values(), ids=ops.LANES)
def test_opcheck_of_the_plan(lanes: int) -> None:
    """It is built on the CPU, for either device, and has no shapes without execution: they follow from the colors."""
    model = small_model("cpu")
    arguments = (model.rest_points, model.tets, ~model.pinned, lanes)
    torch.library.opcheck(torch.ops.diffvbd.build_plan.default, arguments, test_utils="test_schema")


def test_raw_operators_refuse_to_be_differentiated(device: str) -> None:
    for name, arguments in raw_arguments(device, ops.FULL_TAPE).items():
        own = next(i for i, t in enumerate(arguments) if isinstance(t, Tensor) and t.is_floating_point())
        first = arguments[own].clone().requires_grad_()
        out = getattr(torch.ops.diffvbd, name)(*arguments[:own], first, *arguments[own + 1 :])
        out = next(t for t in out if t.is_floating_point()) if isinstance(out, (tuple, list)) else out
        with pytest.raises(NotImplementedError, match="call diffvbd.step"):
            out.sum().backward()
