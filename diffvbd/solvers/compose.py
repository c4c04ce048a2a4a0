"""Any sequence of block updates as one differentiable function: forward as written, backward in reverse."""

# pyright: reportIncompatibleMethodOverride=false
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.autograd import Function

from .. import ops
from .._common.checks import check_count, fail
from .._common.context import Scope, checking

Rows = Tensor | slice | None
Tensors = tuple[Tensor, ...]
Bars = tuple[Tensor | None, ...]


class BlockUpdate:
    """One update of a block: reads the whole state, writes only its own rows.

    Subclasses set ``rows`` and write ``update``; a hand-derived ``vjp`` replaces the automatic one. Both are pure and
    deterministic functions of their arguments: the backward puts the old rows back and takes it that the same update
    made the new ones. Inside :func:`diffvbd.testing.debug_checks` the backward repeats each update to see that it did.

    Attributes:
        rows: For each state tensor the rows that the update writes: distinct indices [n] (int64), a slice, or None
            where it writes nothing.
        dim: The dimension that rows count along: -2 for states [..., rows, components], -1 for vectors [..., rows].

    Source: paper, eq. 6.
    """

    rows: tuple[Rows, ...]
    dim: int = -2

    def update(self, state: Tensors, parameters: Tensors) -> Bars:
        """New rows of each state tensor [..., n, c] or [..., n], None where ``rows`` is None.

        Its arguments stay as they are; what it returns may be a view of them. Whatever wants a gradient is among them:
        rows that require grad through another tensor raise RuntimeError.
        """
        raise NotImplementedError

    def vjp(self, state: Tensors, rows_bar: Bars, parameters: Tensors) -> tuple[Bars, Bars]:
        """Transposed derivative of :meth:`update`, the default by torch autograd through this one update.

        Its arguments stay as they are.

        Args:
            state: The state before the update.
            rows_bar: Adjoints of the new rows, as ``update`` returns them.
            parameters: Those that want a gradient have ``requires_grad``.

        Returns:
            What the update adds to the adjoint of each state tensor (that tensor's shape, None for zero), and of each
            parameter (a shape that sums to the parameter's, None for zero).
        """
        # Leaves of a graph of their own: whoever calls this has its graph already, and only one block is in this one.
        with torch.enable_grad():
            state = tuple(t.detach().requires_grad_() for t in state)
            parameters = tuple(p.detach().requires_grad_(p.requires_grad) for p in parameters)
            new = _tuple(self.update(state, parameters))
        # Rows that come from neither state nor parameters have no graph, and autograd would refuse them.
        made = [(rows, bar) for rows, bar in zip(new, rows_bar, strict=True) if rows is not None and rows.requires_grad]
        inputs = [t for t in (*state, *parameters) if t.requires_grad]
        if not made:
            return (None,) * len(state), (None,) * len(parameters)
        rows, bars = zip(*made, strict=True)
        found = iter(torch.autograd.grad(rows, inputs, bars, allow_unused=True))
        out = [next(found) if t.requires_grad else None for t in (*state, *parameters)]
        return tuple(out[: len(state)]), tuple(out[len(state) :])


class Update(BlockUpdate):
    """A block update of plain functions.

    Args:
        function: ``function(state, parameters)`` returns the new rows of each state tensor, as a tuple like state; a
            single tensor stands for a tuple of one.
        rows: Rows per state tensor, indices of shape [n] or a slice, see :class:`BlockUpdate`; what is no tuple stands
            for a tuple of one.
        dim: -2 or -1.
        vjp: ``vjp(state, rows_bar, parameters)``; None: torch autograd.

    Raises:
        TypeError: function or vjp cannot be called.
    """

    def __init__(
        self,
        function: Callable[[Tensors, Tensors], Any],
        rows: Rows | tuple[Rows, ...],
        dim: int = -2,
        vjp: Callable[[Tensors, Bars, Tensors], tuple[Bars, Bars]] | None = None,
    ) -> None:
        for name, value in (("function", function), ("vjp", vjp)):
            if not callable(value) and not (name == "vjp" and value is None):
                raise TypeError(f"{name}: expected a function, got {type(value).__name__}")
        self.function, self.rows, self.dim, self.hand_written = function, _tuple(rows), dim, vjp

    def update(self, state: Tensors, parameters: Tensors) -> Bars:
        return self.function(state, parameters)

    def vjp(self, state: Tensors, rows_bar: Bars, parameters: Tensors) -> tuple[Bars, Bars]:
        if self.hand_written is None:
            return super().vjp(state, rows_bar, parameters)
        return self.hand_written(state, rows_bar, parameters)


class Solver:
    """The composition of block updates, one sweep after another; see :func:`compose`."""

    def __init__(self, updates: Iterable[BlockUpdate]) -> None:
        if not isinstance(updates, Iterable):
            raise TypeError(f"updates: expected a sequence of BlockUpdate, got {type(updates).__name__}")
        self.updates = tuple(updates)
        # Rows are looked at here, once: on CUDA a look waits for the device, and there is a call for each step.
        reach: dict[tuple[int, int], int] = {}  # (state tensor, dim) -> rows that it must have
        slices: dict[tuple, tuple[int, int, int, slice]] = {}  # the first update of each slice of a state tensor
        for n, update in enumerate(self.updates):
            _check_update(n, update)
            if len(update.rows) != len(self.updates[0].rows):
                fail(f"updates[{n}].rows", f"{len(self.updates[0].rows)} entries, as updates[0] has", len(update.rows))
            for k, rows in enumerate(update.rows):
                if rows is None:
                    continue
                least = int(rows.max()) + 1 if isinstance(rows, Tensor) and rows.numel() else 0
                reach[k, update.dim] = max(reach.get((k, update.dim), 0), least)
                if isinstance(rows, slice):
                    slices.setdefault((k, update.dim, rows.start, rows.stop, rows.step), (n, k, update.dim, rows))
        self._reach, self._slices = reach, tuple(slices.values())

    def __call__(
        self, state: Tensor | Sequence[Tensor], parameters: Tensor | Sequence[Tensor] = (), *, sweeps: int
    ) -> Any:
        """The state after ``sweeps`` sweeps; differentiable in state and parameters.

        Args:
            state: A tensor or a tuple of floating tensors, [..., n, c] or [..., n]; never written to.
            parameters: A tensor or a tuple of tensors that every update is given. They may broadcast over the leading
                dimensions of the state: their gradients are summed to their shapes.
            sweeps: K >= 0; 0 returns a copy of the state.

        Returns:
            The structure of state.

        Raises:
            ValueError, TypeError: Naming the argument, or the update whose rows or adjoints do not fit.
            RuntimeError: An update uses a tensor that requires grad and is neither state nor parameter. In a backward
                inside :func:`diffvbd.testing.debug_checks`: an update makes other rows when it is repeated.
            NotImplementedError: In the backward, for second derivatives.
        """
        single = isinstance(state, Tensor)
        tensors, given = _tensors("state", state), _tensors("parameters", parameters)
        sweeps = check_count("sweeps", sweeps)
        if self.updates and len(tensors) != len(self.updates[0].rows):
            fail("state", f"{len(self.updates[0].rows)} tensors, as the updates write", len(tensors))
        for (k, dim), rows in self._reach.items():
            shape = list(tensors[k].shape)
            if len(shape) < -dim:
                fail(f"state[{k}]", f"at least {-dim} dimensions (updates have dim={dim})", f"shape {shape}")
            if shape[dim] < rows:
                fail(f"state[{k}]", f"at least {rows} rows in dimension {dim}", f"shape {shape}")
        for n, k, dim, rows in self._slices:
            size = tensors[k].shape[dim]
            if size and not range(*rows.indices(size)):
                fail(f"updates[{n}].rows", f"some of the {size} rows of state[{k}] in dimension {dim}", rows)
        out = _Sweeps.apply(self.updates * sweeps, torch.is_grad_enabled(), len(tensors), *tensors, *given)
        return out[0] if single else out


def compose(updates: Iterable[BlockUpdate]) -> Solver:
    """The solver that runs ``updates`` in order, sweep by sweep, with the exact adjoint of what it executes.

    Args:
        updates: The block updates of one sweep. Their rows are read here; on CUDA this waits for the device.

    Raises:
        TypeError, ValueError: For what is no :class:`BlockUpdate` or has unusable rows.

    Source: paper, Theorem 1.
    """
    return Solver(updates)


# --- rows -------------------------------------------------------------------------------------------------------------


def _tuple(value: Any) -> tuple:
    return tuple(value) if isinstance(value, (tuple, list)) else (value,)


def _at(rows: Tensor | slice, dim: int) -> tuple:
    return (..., rows, *(slice(None),) * (-1 - dim))


def _read(update: BlockUpdate, tensors: Sequence[Tensor]) -> list[Tensor | None]:
    """Copies of an update's rows."""
    found: list[Tensor | None] = []
    for rows, t in zip(update.rows, tensors, strict=True):
        here = None if rows is None else t[_at(rows, update.dim)]
        found.append(here.clone() if here is not None and isinstance(rows, slice) else here)  # indexing has copied
    return found


def _write(update: BlockUpdate, tensors: Sequence[Tensor], values: Sequence[Tensor | None]) -> None:
    for rows, t, value in zip(update.rows, tensors, values, strict=True):
        if rows is not None and value is not None:
            t[_at(rows, update.dim)] = value


def _versions(tensors: Iterable[Tensor | None]) -> list[int]:
    """Versions, which tell of a write in place. Inference tensors have none."""
    return [t._version for t in tensors if t is not None and not t.is_inference()]


def _updated(update: BlockUpdate, state: Sequence[Tensor], parameters: Tensors, recording: bool = False) -> Bars:
    """New rows of an update, once they fit what they replace, in memory of their own."""
    versions = _versions((*state, *parameters))
    # State and parameters are detached then, so that rows require grad through what the update closes over.
    with torch.set_grad_enabled(recording):
        new = _tuple(update.update(tuple(state), parameters))
    if versions != _versions((*state, *parameters)):
        raise ValueError(f"update of {_name(update)}: expected new rows as its result, got arguments written in place")
    if len(new) != len(state):
        fail(f"update of {_name(update)}", f"{len(state)} tensors of rows (None where it writes none)", len(new))
    for k, (value, rows, t) in enumerate(zip(new, update.rows, state, strict=True)):
        if (value is None) != (rows is None):
            fail(f"update of {_name(update)}", f"{'None' if rows is None else 'rows'} for state[{k}]", value)
        if value is None or rows is None:
            continue
        shape = list(t.shape)
        count = rows.numel() if isinstance(rows, Tensor) else len(range(*rows.indices(shape[update.dim])))
        shape[update.dim] = count
        if not isinstance(value, Tensor) or list(value.shape) != shape or value.dtype != t.dtype:
            got = f"{value.dtype}, shape {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            fail(f"update of {_name(update)}", f"{t.dtype}, shape {shape} for the rows of state[{k}]", got)
        if recording and value.requires_grad:
            raise RuntimeError(f"update of {_name(update)}: expected rows of state and parameters alone, got rows that "
                               "require grad through another tensor; give it through parameters, or detach it"
                               )  # fmt: skip
    # Rows of several tensors are written one after another, so a view of the state would see what stands before it.
    return tuple(None if value is None else value.clone() if _shares(value, state) else value for value in new)


def _shares(value: Tensor, state: Sequence[Tensor]) -> bool:
    """True if a value lies in the memory of a state tensor."""
    return any(value.untyped_storage().data_ptr() == t.untyped_storage().data_ptr() for t in state)


def _restore(update: BlockUpdate, state: list[Tensor], old: Sequence[Tensor | None], parameters: Tensors) -> None:
    """Puts the old rows back; under debug_checks() sees that the update makes of them what it has made."""
    made = _read(update, state) if checking() else None
    _write(update, state, old)
    if made is None:
        return
    for one, two in zip(made, _updated(update, state, parameters), strict=True):
        if one is not None and two is not None and not torch.allclose(one, two, rtol=0, atol=0, equal_nan=True):
            raise RuntimeError(f"update of {_name(update)}: expected the rows that it made in the forward, got others "
                               "from the same state and parameters; updates must be pure and deterministic"
                               )  # fmt: skip


def _transposed(update: BlockUpdate, state: Sequence[Tensor], rows_bar: Bars, parameters: Tensors) -> tuple[Bars, Bars]:
    """The vjp of an update, which must leave its arguments as they are."""
    versions = _versions((*state, *rows_bar, *parameters))
    found = update.vjp(tuple(state), rows_bar, parameters)
    if versions != _versions((*state, *rows_bar, *parameters)):
        raise ValueError(f"vjp of {_name(update)}: expected adjoints as its result, got arguments written in place")
    return found


def _add(update: BlockUpdate, what: str, total: list, found: Any, like: Sequence[Tensor]) -> None:
    """Adds adjoints to ``total``, in the order of the calls; a parameter's are summed to its shape."""
    found = _tuple(found)
    for k, bar in enumerate(found):
        if bar is not None and not isinstance(bar, Tensor):
            raise TypeError(f"vjp of {_name(update)}: expected a tensor or None for {what}[{k}], "
                            f"got {type(bar).__name__}")  # fmt: skip
    if len(found) != len(total):
        fail(f"vjp of {_name(update)}", f"{len(total)} adjoints of {what}", len(found))
    for k, (bar, t) in enumerate(zip(found, like, strict=True)):
        if bar is None or (what == "parameters" and not t.requires_grad):
            continue
        lead = bar.dim() - t.dim()
        fits = lead >= 0 and all(n in (1, m) for n, m in zip(t.shape, bar.shape[lead:], strict=True))
        if not fits or bar.dtype != t.dtype or (what == "state" and bar.shape != t.shape):
            fail(f"vjp of {_name(update)}", f"{t.dtype}, shape {list(t.shape)} for {what}[{k}]",
                 f"{bar.dtype}, shape {list(bar.shape)}")  # fmt: skip
        # Summed in a fixed order, unlike torch's own sum on CUDA: equal runs have equal gradients, to the bit.
        bar = ops.sum_to(bar, (1,) * lead + tuple(t.shape)).reshape(t.shape)
        total[k] = bar if total[k] is None else total[k] + bar


# --- checks -----------------------------------------------------------------------------------------------------------


def _name(update: BlockUpdate) -> str:
    return type(update).__name__


def _tensors(name: str, value: Any) -> Tensors:
    value = _tuple(value)
    for k, t in enumerate(value):
        if not isinstance(t, Tensor):
            raise TypeError(f"{name}[{k}]: expected a tensor, got {type(t).__name__}")
        if name == "state" and not t.is_floating_point():
            raise TypeError(f"state[{k}]: expected a floating dtype, got {t.dtype}")
    return value


def _check_update(n: int, update: Any) -> None:
    """Check of rows before there is a state."""
    if not isinstance(update, BlockUpdate):
        raise TypeError(f"updates[{n}]: expected a BlockUpdate, such as Update(...), got {type(update).__name__}")
    if update.dim not in (-1, -2):
        fail(f"updates[{n}].dim", "-1 or -2", update.dim)
    given = getattr(update, "rows", None)
    if not isinstance(given, tuple):
        raise TypeError(f"updates[{n}].rows: expected a tuple (per state tensor), got {type(given).__name__}")
    for rows in given:
        if isinstance(rows, Tensor):
            if rows.dtype != torch.int64 or rows.dim() != 1:
                fail(f"updates[{n}].rows", "int64 indices of shape [n]", f"{rows.dtype} of shape {list(rows.shape)}")
            # Of two writes to one row the tape would keep what was there before both, the state only one of them.
            if rows.unique().numel() != rows.numel() or bool((rows < 0).any()):
                fail(f"updates[{n}].rows", "distinct indices >= 0", rows.tolist())
        elif isinstance(rows, slice):
            if rows.step is not None and not (isinstance(rows.step, int) and rows.step > 0):
                fail(f"updates[{n}].rows", "a slice with a step > 0", rows)
        elif rows is not None:
            raise TypeError(f"updates[{n}].rows: expected indices, a slice or None, got {type(rows).__name__}")


# --- the two directions -----------------------------------------------------------------------------------------------


class _Sweeps(Function):
    """The executed updates, S = S_n ... S_2 S_1; on the tape only the rows that each of them replaced."""

    @staticmethod
    def forward(ctx: Any, updates: tuple[BlockUpdate, ...], recording: bool, count: int, *tensors: Tensor) -> Tensors:
        # A copy, which updates are written into: what the caller gave stays, as autograd and the caller expect.
        state, parameters = [t.clone() for t in tensors[:count]], tensors[count:]
        # Without a gradient to come there is no tape, however many sweeps.
        tape, keep, detached = [], recording and any(ctx.needs_input_grad), tuple(p.detach() for p in parameters)
        for update in updates:
            new = _updated(update, state, detached, recording)
            tape += _read(update, state) if keep else []
            _write(update, state, new)
        # All of it through autograd, which then sees whether a parameter was changed in place before the backward.
        ctx.save_for_backward(*state, *parameters, *tape)
        ctx.updates, ctx.count, ctx.given, ctx.scope = updates, count, len(parameters), Scope()
        return tuple(state)

    @staticmethod
    def backward(ctx: Any, *state_bar: Tensor) -> tuple:
        # A Function of its own, so that a second derivative raises; made of torch operations it would be a silent zero.
        with ctx.scope.resumed():
            bars = _ReversedSweeps.apply(ctx.updates, ctx.count, ctx.given, *state_bar, *ctx.saved_tensors)
        needs = ctx.needs_input_grad[3:]
        return (None, None, None, *(bar if need else None for bar, need in zip(bars, needs, strict=True)))


class _ReversedSweeps(Function):
    """(dS)^T = (dS_1)^T ... (dS_n)^T: each factor is the vjp of one update at the state that it saw."""

    @staticmethod
    def forward(ctx: Any, updates: tuple[BlockUpdate, ...], count: int, given: int, *tensors: Tensor) -> Bars:
        state_bar, state = ([t.clone() for t in part] for part in (tensors[:count], tensors[count : 2 * count]))
        parameters, tape = tensors[2 * count : 2 * count + given], list(tensors[2 * count + given :])
        parameter_bar: list[Tensor | None] = [None] * given
        for update in reversed(updates):
            _restore(update, state, tape[-count:], parameters)  # the state before the update, to the bit
            del tape[-count:]
            rows_bar = _read(update, state_bar)
            # The old rows matter only through what the update made of them, which its vjp returns.
            _write(update, state_bar, [None if bar is None else torch.zeros_like(bar) for bar in rows_bar])
            to_state, to_parameters = _transposed(update, state, tuple(rows_bar), parameters)
            _add(update, "state", state_bar, to_state, state)
            _add(update, "parameters", parameter_bar, to_parameters, parameters)
        return (*state_bar, *parameter_bar)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> NoReturn:
        raise NotImplementedError("diffvbd.solvers: second derivatives are not supported (create_graph, hessian)")
