"""What the autograd functions of all operators share: no second derivatives, arguments, transforms."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

from ..scopes import transformed


def raw_backward(ctx: Any, *grads: Tensor) -> NoReturn:
    raise NotImplementedError("diffvbd: the raw operators are not differentiable; call diffvbd.step")


def no_second_derivative() -> NoReturn:
    raise NotImplementedError(
        "diffvbd: second derivatives of a step are not supported (create_graph, hessian), nor is "
        "torch.autograd.functional.jvp, which differentiates a backward: take torch.autograd.grad or backward() once"
    )


def no_transforms() -> NoReturn:
    raise NotImplementedError(
        "diffvbd: torch.func transforms and batched gradients (is_grads_batched) of a step with contact are not "
        "supported"
    )


def is_batched(grad: Tensor) -> bool:
    """Whether these are the gradients of torch.func.vmap or of is_grads_batched, which no vmap of a Function sees."""
    known = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return not torch.compiler.is_compiling() and (known.is_batchedtensor(grad) or known.is_legacy_batchedtensor(grad))


def not_batched(grad: Tensor) -> None:
    """Raises for batched gradients of a step with contact."""
    if is_batched(grad):
        no_transforms()


def shapes_of(name: str) -> Callable[[Callable], Callable]:
    """Registers the shapes of an operator without execution, for tensors of one device: torch asks for them, too, where
    some are on the meta device, and then what comes back would be as if all were."""

    def register(shapes: Callable) -> Callable:
        def checked(*arguments: Any) -> Any:
            given = (t for a in arguments for t in (a if isinstance(a, list) else (a,)))
            devices = {t.device for t in given if isinstance(t, Tensor)}
            if len(devices) > 1:
                names = sorted(str(device) for device in devices)
                raise ValueError(f"diffvbd::{name}: expected tensors on one device, got {', '.join(names)}")
            return shapes(*arguments)

        torch.library.register_fake(f"diffvbd::{name}", checked)
        return shapes

    return register


class _Given:
    """Arguments that were all given by position: what torch.autograd.Function.apply reads of inspect.BoundArguments."""

    def __init__(self, args: tuple) -> None:
        self.args, self.kwargs = args, {}

    def apply_defaults(self) -> None:
        pass


class _Ready(inspect.Signature):
    def bind(self, *args: Any, **kwargs: Any) -> Any:
        complete = not kwargs and len(args) == len(self.parameters)
        return _Given(args) if complete else super().bind(*args, **kwargs)


def ready_signature(*functions: type[Function]) -> None:
    """apply() binds its arguments to the signature of forward at every call: a third of a small step's host time,
    which goes with the number of arguments. All are given by position, so there is nothing to bind."""
    for function in functions:
        parameters = inspect.signature(function.forward).parameters.values()
        function.forward.__signature__ = _Ready(list(parameters))  # type: ignore[attr-defined]


class Direct(Function):
    """A Function whose arguments are all given by position, and which torch.compile never meets: apply() does what
    torch's own does where no transforms are active, but for binding and looking at each argument."""

    @classmethod
    def apply(cls, *args: Any) -> Any:
        if transformed():
            return super().apply(*args)
        return super(Function, cls).apply(*args)  # pyright: ignore[reportAttributeAccessIssue]


class Backward(Function):
    """The backward of a Function, as one that has no derivative of its own. Compiled autograd traces through it, which
    it could not through the apply() of Direct."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        ready_signature(cls)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        no_second_derivative()


def distinct(*tensors: Tensor | None) -> list[Tensor | None]:
    """Contiguous, and none of them twice, which torch.compile refuses."""
    out: list[Tensor | None] = []
    for t in tensors:
        t = t if t is None else t.contiguous()
        out.append(t.view_as(t) if t is not None and any(t is other for other in out) else t)
    return out


def of_inputs(out: Any, needs: Sequence[bool], others: int) -> tuple:
    """Gradients of what needs one, in the order of a forward's arguments, of which ``others`` more follow."""
    given = iter(out if isinstance(out, tuple) else (out,))
    return tuple(next(given) if need else None for need in needs) + (None,) * others


def one_by_one(function: Any, size: int, in_dims: tuple, args: tuple) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    """A vmap that applies a function to one member of the batch after another."""
    members = []
    for i in range(size):
        own = [a.select(d, i) if isinstance(a, Tensor) and d is not None else a
               for a, d in zip(args, in_dims, strict=True)]  # fmt: skip
        out = function.apply(*own)
        members.append(out if isinstance(out, tuple) else (out,))
    stacked = tuple(torch.stack(parts) for parts in zip(*members, strict=True))
    return stacked, (0,) * len(stacked)


def fold_scenes(tensor: Tensor, dim: int | None, size: int, scenes: int) -> Tensor:
    """[1 | B, ...] with a vmapped dimension of ``size`` -> [1 | size B, ...], for functions with a scene dimension."""
    if dim is None:
        if tensor.shape[0] == 1:
            return tensor
        return tensor.expand(size, *tensor.shape).reshape(size * tensor.shape[0], *tensor.shape[1:])
    tensor = tensor.movedim(dim, 0)
    return tensor.expand(size, scenes, *tensor.shape[2:]).reshape(size * scenes, *tensor.shape[2:])
