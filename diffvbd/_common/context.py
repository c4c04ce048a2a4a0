"""State inside a ``with``, for the thread or task that is in it: debug_checks(), record(), refine() and silence().

Each is a context variable. A compiled step cannot read one; it reads a plain global beside it, which torch.compile
guards, and so sees what any thread is inside of.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import threading
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor

_peek = torch._C._functorch.peek_interpreter_stack  # pyright: ignore[reportAttributeAccessIssue]
F = TypeVar("F", bound=Callable[..., Any])

_checking: ContextVar[bool] = ContextVar("diffvbd.debug_checks", default=False)
_recording: ContextVar[tuple[tuple[str, list[Any]], ...]] = ContextVar("diffvbd.record", default=())


class MorePairs(RuntimeError):
    """A step of a checkpointed segment has made room for more pairs; the segment is to begin again."""


class Finer(NamedTuple):
    """Refinement of rollouts inside dv.refine."""

    steps: int  # times as many, of a time step so much shorter
    sweeps: int  # times as many
    ran: list[tuple[int, float]]  # of each rollout: its steps before that, and the share of forces left over
    others: bool = False  # plain sweeps in place of coarse corrections, or the other way round
    mesh: bool = False  # of eight tets for each


_in_segment: ContextVar[bool] = ContextVar("diffvbd.segment", default=False)
_refining: ContextVar[Finer | None] = ContextVar("diffvbd.refine", default=None)
_silent: ContextVar[bool] = ContextVar("diffvbd.silent", default=False)
_lock = threading.Lock()
_checked_by = 0  # threads and tasks inside debug_checks()
_any_checking = False
_recorders: tuple[tuple[str, list[Any]], ...] = ()  # of all threads and tasks


def checking() -> bool:
    """Whether debug_checks() is on."""
    return _any_checking and (torch.compiler.is_compiling() or _checking.get())


def looks_at(value: Tensor) -> bool:
    """Whether values may be looked at now. On CUDA that waits for the device; compiled and transformed ones cannot."""
    if torch.compiler.is_compiling():
        return False
    return _peek() is None and (checking() or not value.is_cuda)


def is_captured(value: Tensor) -> bool:
    """Whether work on it is being captured into a CUDA graph, which can neither read a value nor raise."""
    return value.is_cuda and not torch.compiler.is_compiling() and torch.cuda.is_current_stream_capturing()


def may_copy(value: Tensor) -> bool:
    """Whether a value on CUDA may be copied to the host while the device works on."""
    return value.is_cuda and not torch.compiler.is_compiling() and not is_captured(value) and not transformed()


def transformed() -> bool:
    """Whether a transform of torch.func is under way. Under torch.compile one may be, unseen."""
    if torch.compiler.is_compiling():
        return False
    return _peek() is not None


def refuse_transforms(name: str) -> None:
    """Raises inside torch.func.grad, vmap and the like, before torch says what it means to itself."""
    if transformed():
        raise NotImplementedError(f"diffvbd: torch.func transforms of {name} are not supported")


def refuse_forward_mode() -> None:
    """Raises inside torch.func.jvp, jacfwd and hessian, before torch asks for what no user can write."""
    if transformed():
        known = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
        # any level: hessian differentiates forward what it has differentiated in reverse
        if any(level.key() == known.TransformType.Jvp for level in known.get_interpreter_stack()):
            raise NotImplementedError(
                "diffvbd: derivatives in forward mode (torch.func.jvp, jacfwd, hessian) are not supported; take "
                "reverse mode: torch.autograd.grad or backward()"
            )


def not_compiled(function: F) -> F:
    """torch.compiler.disable for calls in compiled code. Others pass it by: it loads the compiler, which takes a
    second."""
    try:
        from torch._compile import _disable_dynamo as disable
    except ImportError:
        disable = torch.compiler.disable
    disabled = disable(function)

    @functools.wraps(function)
    def either(*args: Any, **options: Any) -> Any:
        return disabled(*args, **options) if torch.compiler.is_compiling() else function(*args, **options)

    return cast(F, either)


def recorders(kind: str = "contact") -> tuple[list[Any], ...]:
    """The lists that record("contact"), or record("subspace"), has given."""
    given = _recorders if torch.compiler.is_compiling() else _recording.get()
    return tuple(found for of, found in given if of == kind)


def refinement() -> Finer | None:
    """Inside dv.refine: how rollouts run. It compiles nothing."""
    return None if torch.compiler.is_compiling() else _refining.get()


def refuse_refinement(name: str) -> None:
    """Raises inside dv.refine, which follows rollouts only."""
    if refinement() is not None:
        raise NotImplementedError(
            f"refine: expected a loss that steps by dv.rollout, which is refined; it calls {name}"
        )


@contextlib.contextmanager
def inside(variable: ContextVar[Any], value: Any) -> Iterator[None]:
    """Inside, a context variable has a value."""
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def _count(change: int) -> None:
    global _checked_by, _any_checking
    with _lock:
        _checked_by += change
        _any_checking = _checked_by > 0


@contextlib.contextmanager
def checks(enabled: bool) -> Iterator[None]:
    """Inside, checking() is ``enabled``."""
    change = int(enabled) - int(_checking.get())
    _count(change)
    try:
        with inside(_checking, enabled):
            yield
    finally:
        _count(-change)


@contextlib.contextmanager
def record_to(found: list[Any], kind: str = "contact") -> Iterator[None]:
    """Inside, recorders(kind) has ``found``."""
    global _recorders
    with _lock:
        _recorders = (*_recorders, (kind, found))
    try:
        with inside(_recording, (*_recording.get(), (kind, found))):
            yield
    finally:
        with _lock:
            _recorders = tuple(r for r in _recorders if r[1] is not found)


@contextlib.contextmanager
def unheard() -> Iterator[None]:
    """Inside, steps are recorded nowhere and not checked: they are none of the caller's."""
    with inside(_checking, False), inside(_recording, ()):
        yield


def is_silent() -> bool:
    """Whether nobody would hear a warning, so that nothing need be looked at for one."""
    return not torch.compiler.is_compiling() and _silent.get()


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Inside, nothing is warned of."""
    with inside(_silent, True), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def in_segment() -> bool:
    """Whether the steps of a checkpointed segment are made for the first time: none may run again by itself, since its
    first attempt has saved tensors that the segment would not save in the backward."""
    return not torch.compiler.is_compiling() and _in_segment.get()


def segment() -> contextlib.AbstractContextManager[None]:
    """Inside, in_segment() is True."""
    return inside(_in_segment, True)


def refined(finer: Finer | None) -> contextlib.AbstractContextManager[None]:
    """Inside, refinement() is ``finer``; None: a refined rollout runs as it stands."""
    return inside(_refining, finer)


class Scope:
    """Context of the code that makes one. A backward may run in another thread, as torch's own on CUDA does;
    inside ``resumed()`` what held in the forward holds there, too."""

    def __init__(self) -> None:
        self.checking, self.recorders = checking(), _recorders if torch.compiler.is_compiling() else _recording.get()

    @contextlib.contextmanager
    def resumed(self) -> Iterator[None]:
        known = _recording.get()
        more = tuple(r for r in self.recorders if all(r[1] is not k[1] for k in known))
        with inside(_checking, _checking.get() or self.checking), inside(_recording, (*known, *more)):
            yield


# --- constants --------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def lasting_tensors() -> Iterator[None]:
    """Inside (or in a function that it decorates) tensors are made on the CPU unless a device is named, without a
    graph, and as ordinary ones: those of torch.inference_mode() could never take part in a backward."""
    with torch.inference_mode(False), torch.no_grad(), torch.device("cpu"):
        yield


def lasting(value: Any) -> Any:
    """``value`` with ordinary tensors in place of those of torch.inference_mode(), in tuples, dicts and dataclasses
    too."""
    if isinstance(value, Tensor):
        return value.clone() if value.is_inference() else value
    if isinstance(value, dict):
        return {key: lasting(each) for key, each in value.items()}
    if type(value) in (tuple, list):
        return type(value)(lasting(each) for each in value)
    if isinstance(value, tuple) and hasattr(value, "_fields"):  # a NamedTuple
        return type(value)(*(lasting(each) for each in value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kept = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        made = {name: lasting(each) for name, each in kept.items()}
        if any(made[name] is not kept[name] for name in kept):
            out = copy.copy(value)
            out.__dict__.update(made)  # as it is: its own checks have passed
            return out
    return value


# --- named tuples with some of their values changed -------------------------------------------------------------------

Tuple = TypeVar("Tuple", bound=tuple)


def replaced(values: Tuple, **changes: Any) -> Tuple:
    """As ``values._replace(**changes)``, which torch.compile of torch 2.11 cannot follow."""
    given: Any = values
    return type(values)(**{**given._asdict(), **changes})
