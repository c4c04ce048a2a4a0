"""One autograd function for all operators: a row says what runs, what its reverse is, and what is differentiated.

A Differentiable serves plain calls, torch.func and torch.compile. Where nothing is differentiated it only runs. The
reverse of a Linear is another Linear, so that it may be differentiated any number of times. `direct` has the operators
as they are, for a forward or reverse.
"""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function, forward_ad

from .._common.context import transformed
from .load import raw

Bars = Sequence[Tensor | None]  # adjoints; None where there is none
# reverse(bars of the outputs, what was saved, the arguments that are no tensors, which inputs need one): an adjoint for
# each input that needs one, in a shape that sums to the input's; others may be missing or anything.
Reverse = Callable[[Bars, Sequence[Any], tuple, Sequence[bool]], Bars]
Vmap = Callable[..., tuple[Any, Any]]  # as torch.autograd.Function.vmap


class Direct:
    """Operators of a library such as torch.ops.diffvbd, without a pass through torch's autograd where nothing would be
    differentiated: inside the forward of a Function and under no_grad. Half of what a call costs beside its work."""

    def __init__(self, library: Any) -> None:
        self._library = library

    def __getattr__(self, name: str) -> Callable[..., Any]:
        operator = getattr(self._library, name).default

        def call(*args: Any) -> Any:
            if torch.is_grad_enabled() or torch.compiler.is_compiling() or transformed():
                return operator(*args)
            with torch._C._AutoDispatchBelowAutograd():
                return operator(*args)

        if not torch.compiler.is_compiling():
            setattr(self, name, call)  # is found before this the next time
        return call


direct = Direct(raw)


def no_second_derivative() -> NoReturn:
    raise NotImplementedError(
        "diffvbd: second derivatives of a step are not supported (create_graph, hessian), nor is "
        "torch.autograd.functional.jvp, which differentiates a backward: take torch.autograd.grad or backward() once"
    )


_peek = torch._C._functorch.peek_interpreter_stack  # pyright: ignore[reportAttributeAccessIssue]
CONTACT = "torch.func transforms and batched gradients (is_grads_batched) of a step with contact are not supported"


def is_batched(grad: Tensor) -> bool:
    """Whether these are the gradients of torch.func.vmap or of is_grads_batched, which no vmap of a Function sees."""
    known = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return not torch.compiler.is_compiling() and (known.is_batchedtensor(grad) or known.is_legacy_batchedtensor(grad))


class _Given:
    """Arguments that were all given by position: what torch.autograd.Function.apply reads of inspect.BoundArguments."""

    def __init__(self, args: tuple) -> None:
        self.args, self.kwargs = args, {}

    def apply_defaults(self) -> None:
        pass


class _Ready(inspect.Signature):
    """apply() binds its arguments to the signature of forward at every call: a third of a small step's host time."""

    def bind(self, *args: Any, **kwargs: Any) -> Any:
        return _Given(args)


def _of_arity(count: int, function: Callable[..., Any]) -> Any:
    """The function with so many arguments of its own, which torch.compile counts."""
    names = ", ".join(f"a{i}" for i in range(count))
    out = eval(f"lambda {names}: function({names})", {"function": function})
    out.__signature__ = _Ready(list(inspect.signature(out).parameters.values()))
    return staticmethod(out)


def no_transforms(message: str = CONTACT) -> NoReturn:
    raise NotImplementedError(f"diffvbd: {message}")


def not_batched(grad: Tensor) -> None:
    """Raises for batched gradients of a step with contact."""
    if is_batched(grad):
        no_transforms()


class Differentiable:
    """An operator with its adjoint; called like ``run``.

    Args:
        run: Of all arguments, by position: a tensor or a tuple of tensors.
        reverse: See Reverse.
        arguments: How many there are.
        inputs: How many of these may be differentiated: the first ones.
        outputs: How many of what it returns are differentiable: the first ones.
        saved: Of arguments and outputs, what the reverse reads, inputs first. Default: ``tensors`` arguments.
        tensors: How many arguments are tensors, or None: the first ones. Default: ``inputs``.
        rest: Of arguments, what else the reverse reads. Default: those that are not ``tensors``.
        vmap: Of the whole, or what says that there is none; then gradients are not batched either where ``batched`` is
            False.
        vmap_reverse: Of the reverse, default: one after another.
    """

    def __init__(
        self,
        run: Callable[..., Any],
        reverse: Reverse,
        *,
        arguments: int,
        inputs: int,
        outputs: int = 1,
        tensors: int | None = None,
        saved: Callable[[tuple, tuple], Sequence[Any]] | None = None,
        rest: Callable[[tuple], tuple] | None = None,
        vmap: Vmap | str = CONTACT,
        vmap_reverse: Vmap | None = None,
        batched: bool = False,
    ) -> None:
        self.run, self.count = run, inputs
        count, first = inputs, inputs if tensors is None else tensors
        refuses = vmap if isinstance(vmap, str) else CONTACT

        def reversed_(*args: Any) -> tuple[Tensor, ...]:
            *given, rest, needs = args
            bars = [g if g is None else g.contiguous() for g in given[:outputs]]
            out = reverse(bars, given[outputs:], rest, needs)
            return tuple(in_shape(bar, t) for bar, t, need in zip(out, given[outputs:], needs, strict=False)
                         if need and t is not None)  # fmt: skip

        class _Reverse(Function):
            forward = staticmethod(reversed_)

            @staticmethod
            def backward(ctx: Any, *grads: Any) -> NoReturn:
                no_second_derivative()

            @staticmethod
            def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
                pass

            @staticmethod
            def vmap(info: Any, in_dims: tuple, *args: Any) -> Any:
                if vmap_reverse is not None:
                    return vmap_reverse(_Reverse.apply, info, in_dims, *args)
                return one_by_one(_Reverse, info.batch_size, in_dims, args)

        reversed_.__signature__ = _Ready()  # type: ignore[attr-defined]

        class _Forward(Function):
            forward = _of_arity(arguments, run)

            @staticmethod
            def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
                made = output if isinstance(output, tuple) else (output,)
                ctx.save_for_backward(*(inputs[:first] if saved is None else saved(inputs, made)))
                ctx.rest = inputs[first:] if rest is None else rest(inputs)
                if made[outputs:]:  # torch.compile takes no empty mark of a function with one output
                    ctx.mark_non_differentiable(*made[outputs:])
                ctx.set_materialize_grads(False)

            @staticmethod
            def backward(ctx: Any, *grads: Tensor | None) -> tuple:
                kept = ctx.saved_tensors  # once: a checkpoint gives them once
                given = [g for g in grads[:outputs] if g is not None]
                if not given:
                    return (None,) * arguments
                if not batched and any(is_batched(g) for g in given):
                    no_transforms(refuses)
                needs = ctx.needs_input_grad[:count]
                args = (*grads[:outputs], *kept, ctx.rest, needs)
                differentiated = torch.is_grad_enabled() or _peek() is not None or forward_ad._current_level >= 0
                work = _Reverse.apply if differentiated and not torch.compiler.is_compiling() else reversed_
                out = iter(work(*args))
                return tuple(next(out) if need else None for need in needs) + (None,) * (arguments - count)

            @staticmethod
            def vmap(info: Any, in_dims: tuple, *args: Any) -> Any:
                if isinstance(vmap, str):
                    no_transforms(refuses)
                return vmap(_Forward.apply, info, in_dims, *args)

        self.function = _Forward

    def __call__(self, *args: Any) -> Any:
        if torch.compiler.is_compiling() or _peek() is not None or forward_ad._current_level >= 0:
            return self.function.apply(*args)
        if torch.is_grad_enabled():
            for t in args[: self.count]:
                if t is not None and t.requires_grad:
                    # what apply() does where no transforms are active, but for looking at each argument
                    return super(Function, self.function).apply(*args)  # pyright: ignore[reportAttributeAccessIssue]
        with torch._C._AutoDispatchBelowAutograd():  # half of what a call of an operator costs beside its work
            return self.run(*args)


def in_shape(bar: Tensor | None, t: Tensor) -> Tensor:
    """An adjoint in the shape of its input."""
    if bar is None or bar.numel() == 0:  # also of no scenes, where shapes may differ
        return torch.zeros_like(t)
    return sum_to(bar, t.shape)


class Linear:
    """A linear function of its first argument; called like ``run``.

    Args:
        run: Of a tensor and constants.
        transpose: Of its adjoint, the shape of the tensor, and the constants: the tensor's adjoint.
        arguments: How many there are, with the tensor.
        vmap: Of the info of torch.autograd.Function.vmap, the tensor with the batch first, and the constants; None:
            there is none.
    """

    def __init__(self, run: Callable[..., Tensor], transpose: Callable[..., Tensor], arguments: int,
                 vmap: Callable[..., Tensor] | None = None) -> None:  # fmt: skip
        class _Function(Function):
            forward = _of_arity(arguments, run)

            @staticmethod
            def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
                ctx.shape, ctx.constants = tuple(inputs[0].shape), inputs[1:]

            @staticmethod
            def backward(ctx: Any, *grads: Tensor) -> tuple:
                return (transpose(grads[0], ctx.shape, *ctx.constants), *(None,) * (arguments - 1))

            @staticmethod
            def vmap(info: Any, in_dims: tuple, values: Tensor, *constants: Any) -> tuple[Tensor, int]:
                if vmap is None:
                    no_transforms()
                return vmap(info, values.movedim(in_dims[0], 0), *constants), 0

        self.function, self.run = _Function, run

    def __call__(self, *args: Any) -> Tensor:
        if torch.compiler.is_compiling() or _peek() is not None or forward_ad._current_level >= 0:
            return self.function.apply(*args)
        if torch.is_grad_enabled() and args[0].requires_grad:
            return self.function.apply(*args)
        return self.run(*args)


def _rows_of_batch(info: Any, values: Tensor) -> Tensor:
    return _row_sum(values.flatten(0, 1)).unflatten(0, values.shape[:2])


# [rows, columns] -> [rows], summed in an order that depends on nothing but the shape.
_row_sum = Linear(lambda values: direct.row_sum(values.contiguous()),
                  lambda bar, shape: bar[:, None].expand(-1, shape[1]), 1, _rows_of_batch)  # fmt: skip


def sum_to(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Sums the dimensions in which ``shape`` has 1 (same number of dimensions), in a fixed order."""
    if tensor.shape == shape:
        return tensor
    reduced = [d for d, n in enumerate(shape) if n == 1 and tensor.shape[d] != 1]
    if not reduced:
        return tensor
    kept = [d for d in range(tensor.dim()) if d not in reduced]
    rows, columns = (math.prod([tensor.shape[d] for d in dims]) for dims in (kept, reduced))
    return _row_sum(tensor.permute(*kept, *reduced).reshape(rows, columns)).reshape(shape)


def distinct(*tensors: Tensor | None) -> list[Tensor | None]:
    """Contiguous, and for torch.compile, which refuses that, none of them twice."""
    out: list[Tensor | None] = []
    if not torch.compiler.is_compiling():
        return [t if t is None else t.contiguous() for t in tensors]
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


def folded(size: int, tensors: tuple, in_dims: tuple, full: int) -> tuple[list[Any], int]:
    """Tensors of vmap with its dimension folded into that of scenes, and the scenes of a member. The first ``full``
    have the shape of positions afterwards."""
    given = [(t, d) for t, d in zip(tensors, in_dims, strict=False)]
    counts = [(t if d is None else t.movedim(d, 0)[0]).shape[0] for t, d in given if t is not None and t.numel() > 0]
    scenes = max(counts, default=1)
    out: list[Any] = [t if t is None or t.numel() == 0 else fold_scenes(t, d, size, scenes) for t, d in given]
    shape = (size * scenes, *out[0].shape[1:])
    out[:full] = [t.expand(shape).contiguous() for t in out[:full]]
    return out, scenes
