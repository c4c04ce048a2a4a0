"""Claim: a tape stays with the graph of its step, step_backward names what it cannot use, and batched gradients of a
step with contact say that there are none."""

import copy
import io
import pickle
import re
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers.bad_input import STEP, model_of, raises
from helpers.two_boxes import STEP as CONTACT_STEP
from helpers.two_boxes import two_boxes
from torch import Tensor

import diffvbd as dv
from diffvbd.checks import name_value


def forward(device: str, **options: Any) -> tuple[Tensor, dv.Tape]:
    model = model_of(device)
    x, _, tape = dv.step_forward(model, model.rest_points, 0 * model.rest_points, **(STEP | options))
    return x, tape


@pytest.mark.parametrize(
    "store",
    [pickle.dumps, copy.deepcopy, copy.copy, lambda tape: torch.save(tape, io.BytesIO())],
    ids=["pickle", "deepcopy", "copy", "save"],
)
def test_a_tape_is_not_stored_or_copied(device: str, store: Callable[[dv.Tape], Any]) -> None:
    x, tape = forward(device)
    with pytest.raises(TypeError, match="Keep the states .* and run step_forward again"):
        store(tape)
    with pytest.raises(TypeError, match="Tape: expected"):
        store({"tapes": [tape]}) if store is not copy.copy else store(tape)  # pyright: ignore[reportArgumentType]
    assert dv.step_backward(tape, torch.ones_like(x))["x"].any()  # this one still works


def test_a_tape_without_a_graph_is_refused(device: str) -> None:
    x, tape = forward(device)
    lost = dv.Tape(tape.inputs, (tape.outputs[0].detach(), tape.outputs[1].detach()))
    for grads in ((torch.ones_like(x),), ()):
        with pytest.raises(RuntimeError, match="tape: expected one with the graph.*run step_forward again"):
            dv.step_backward(lost, *grads)


def test_steps_that_move_with_nothing_have_gradients_of_zero(device: str) -> None:
    """Without sweeps the material is read by nobody, and without wrt there is no gradient to give."""
    x, tape = forward(device, wrt=("mu",), sweeps=0)
    assert torch.equal(dv.step_backward(tape, torch.ones_like(x))["mu"], torch.zeros_like(x[0, 0]))
    x, tape = forward(device, wrt=())
    assert dv.step_backward(tape, torch.ones_like(x)) == {}


@pytest.mark.parametrize("name", ["grad_x", "grad_v"])
def test_adjoints_are_like_the_states(device: str, name: str) -> None:
    x, tape = forward(device)
    one = torch.ones_like(x)
    nested = torch.nested.as_nested_tensor([one, one])
    for bad, got in [
        (1.0, "float"), ([1.0], "list"), (one.cpu().numpy(), "ndarray"), (one.float(), "float32"),
        (one.to("meta"), "meta"), (one.to_sparse(), "sparse_coo"), (nested, "nested"), (one[None], r"\[1, 8, 3\]"),
        (one[0, 0], r"\[\]"),
    ]:  # fmt: skip
        raises(lambda bad=bad: dv.step_backward(tape, **{name: bad}), name, got)
    assert dv.step_backward(tape, **{name: one})["x"].any()


@pytest.mark.parametrize("tape", [None, {}, (1, 2), torch.ones(8, 3)])
def test_only_a_tape_is_a_tape(tape: Any) -> None:
    raises(lambda: dv.step_backward(tape, torch.ones(8, 3)), "tape", type(tape).__name__)


def test_a_bad_value_that_requires_grad_is_named_without_a_warning() -> None:
    value = torch.tensor([1.0, -2.5], dtype=torch.float64, requires_grad=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        raises(lambda: name_value("mass", "numbers > 0", value, value > 0), "mass", re.escape("-2.5 at [1]"))


@pytest.mark.parametrize("options", [{}, {"detections": 2}])
@pytest.mark.parametrize("kind", ["is_grads_batched", "vmap"])
def test_batched_gradients_of_a_step_with_contact_say_so(device: str, options: dict[str, Any], kind: str) -> None:
    model = two_boxes(device, **options)
    x = model.rest_points.clone().requires_grad_()
    for out in dv.step(model, x, torch.zeros_like(x), **CONTACT_STEP):
        rows = torch.ones((2, *x.shape), dtype=x.dtype, device=device)
        with pytest.raises(NotImplementedError, match="batched gradients .* of a step with contact are not supported"):
            if kind == "vmap":
                torch.func.vmap(lambda row, out=out: torch.autograd.grad(out, x, row, retain_graph=True)[0])(rows)
            else:
                torch.autograd.grad(out, x, rows, is_grads_batched=True, retain_graph=True)
        assert torch.autograd.grad(out, x, rows[0], retain_graph=True)[0].any()
