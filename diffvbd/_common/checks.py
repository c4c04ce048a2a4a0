"""Checks of arguments: every failure names the argument, what was expected and what came."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import operator
from collections.abc import Callable, Iterable
from typing import Any, NoReturn, TypeVar

import numpy as np
import torch
from torch import Tensor

MODEL = "the Model's"
HELD = "numbers that {} can hold ({})"  # dtype, and whose it is
NUMBERS = (int, float, np.floating, np.integer)  # bool, which python counts among them, is checked apart
Kind = TypeVar("Kind", bound=type)
Function = TypeVar("Function", bound=Callable[..., Any])

OWNERS = {  # names that are easily given to another call, and which call has them
    **dict.fromkeys(("mesh", "pinned", "energies", "dtype", "device"), "an argument of dv.Model"),
    **dict.fromkeys(("time_step", "sweeps", "relaxation", "subspace", "integrator", "block", "start", "tape",
                     "saturation", "regularization"), "an argument of dv.VBD"),
    **dict.fromkeys(("steps", "duration", "save", "observe", "checkpoint_every", "history", "checks", "progress"),
                    "an argument of dv.rollout"),
    **dict.fromkeys(("tolerance", "max_sweeps", "check_every", "on_failure"), "an argument of dv.solve"),
    **dict.fromkeys(("errors", "energy", "contact"), "an argument of dv.Checks"),
    **dict.fromkeys(("dhat", "detections", "reach", "capacity", "kappa_per_area"), "an argument of dv.PairBarrier"),
    **dict.fromkeys(("mu", "lam", "young", "poisson", "force", "gravity", "prescribed", "rest_points"),
                    "an input of dv.step and dv.rollout"),
}  # fmt: skip
RENAMED = {  # names of earlier versions
    "coarse": 'dv.VBD(subspace="coarse")',
    "rigid": 'dv.VBD(subspace="rigid" or None)',
    "settings": "a dv.VBD, the argument solver",
    "parameters": "an input of its own for each parameter, as floor_kappa=",
    "estimate_errors": "dv.Checks(errors=True)",
    "check_start": "dv.Checks(start=)",
    "check_energy": "dv.Checks(energy=)",
    "check_contact": "dv.Checks(contact=)",
}


def fail(name: str, expected: str, got: Any) -> NoReturn:
    first, *more = f"{got}".split("\n")  # an array may take many lines
    # what was caught before this says no more
    raise ValueError(f"{name}: expected {expected}, got {first}{' ...' if more else ''}") from None


def where_it_is(name: str, known: Iterable[str]) -> str:
    """The end of a message on a name that a call does not have: what has it, or the nearest name of any call."""
    if name in RENAMED:
        return f": it is {RENAMED[name]} now"
    if name in OWNERS:
        return f", got {OWNERS[name]}"
    near = difflib.get_close_matches(name, OWNERS, 1, 0.75) or difflib.get_close_matches(name, known, 1)
    return f": is {near[0]!r} meant?" if near else ""


def names_checked(owner: str) -> Callable[[Function], Function]:
    """Decorator of a function whose unknown keywords raise a TypeError that says where they belong."""

    def decorated(function: Function) -> Function:
        known = tuple(name for name in inspect.signature(function).parameters if name != "self")

        @functools.wraps(function)
        def checked(*args: Any, **given: Any) -> Any:
            for name in given:
                if name not in known:
                    raise TypeError(f"{name}: expected an argument of {owner} ({', '.join(known) or 'it has none'})"
                                    f"{where_it_is(name, known)}")  # fmt: skip
            return function(*args, **given)

        return checked  # type: ignore[return-value]

    return decorated


def init_names_checked(kind: Kind) -> Kind:
    """The same for the constructor of a public class."""
    kind.__init__ = names_checked(f"dv.{kind.__name__}")(kind.__init__)  # type: ignore[misc]
    return kind


def check_kind(name: str, value: Any, kind: type) -> None:
    """Raises unless ``value`` is of a public class of diffvbd."""
    if not isinstance(value, kind):
        raise TypeError(f"{name}: expected a diffvbd.{kind.__name__}, got {kind_of(value)}")


def is_word(value: Any, *words: str) -> bool:
    """Whether a value is one of some words. An array is none: == would compare its numbers, one by one."""
    return isinstance(value, str) and value in words


def check_bool(name: str, value: Any) -> None:
    if not isinstance(value, bool):
        raise TypeError(f"{name}: expected a bool, got {type(value).__name__}")


def check_dtype(value: Any) -> None:
    """Raises unless ``value`` is a dtype that kernels compute in."""
    if not isinstance(value, torch.dtype) or value not in (torch.float64, torch.float32):
        raise TypeError(f"dtype: expected torch.float64 or torch.float32, got {value}")


def check_save(save: Any) -> Any:
    """Which frames a rollout saves."""
    if is_word(save, "all", "last"):
        return save
    if not isinstance(save, (int, np.integer)) or isinstance(save, bool) or save <= 0:
        fail("save", '"all", "last" or an integer > 0', repr(save))
    return int(save)


def check_function(name: str, function: Any, *arguments: str) -> None:
    """Raises unless ``function`` can be called with these arguments, by position; they are named in the error."""
    if not callable(function):
        raise TypeError(f"{name}: expected a function of {', '.join(arguments)}, got {type(function).__name__}")
    if torch.compiler.is_compiling():
        return
    try:
        signature = inspect.signature(function, follow_wrapped=False)  # of what is called, not of what it wraps
    except (TypeError, ValueError):  # of a builtin: calling it will tell
        return
    try:
        signature.bind(*arguments)
    except TypeError as error:
        raise TypeError(f"{name}: expected a function of {', '.join(arguments)}: {error}") from None
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    taken = [own for own, of in signature.parameters.items() if of.kind in kinds]
    if any(own in arguments and own != wanted for own, wanted in zip(taken, arguments, strict=False)):
        raise TypeError(f"{name}: expected a function of {', '.join(arguments)} in this order, got {', '.join(taken)}")


def check_tensor(name: str, value: Any, like: Tensor, what: str = "a number or a tensor", owner: str = MODEL) -> Tensor:
    """``value`` as a tensor of like's dtype and device; python numbers are converted, other tensors must match."""
    if not isinstance(value, Tensor):
        if isinstance(value, NUMBERS) and not isinstance(value, bool):
            number = to_float(name, value)
            try:
                return torch.full((), number, dtype=like.dtype, device=like.device)
            except RuntimeError:
                if abs(number) <= torch.finfo(like.dtype).max:
                    raise
                fail(name, HELD.format(like.dtype, owner), number)
        raise TypeError(f"{name}: expected {what}, got {kind_of(value)}")
    if value.layout != torch.strided or value.is_nested:
        check_dense(name, value)
    if value.dtype != like.dtype:
        raise TypeError(f"{name}: expected dtype {like.dtype} ({owner}), got {value.dtype}")
    if value.device != like.device:
        raise ValueError(f"{name}: expected device {like.device} ({owner}), got {value.device}")
    return value


def kind_of(value: Any) -> str:
    """The name of a value's type, and how arrays of other libraries become tensors."""
    shared = hasattr(value, "__dlpack__") and not isinstance(value, (Tensor, np.ndarray))
    hint = ": torch.from_dlpack(array) is a tensor in the same memory" if shared else ""
    return type(value).__name__ + hint


def check_dense(name: str, value: Tensor) -> None:
    """Raises for sparse and nested tensors, whose rows no kernel can read."""
    if value.is_nested:
        raise TypeError(f"{name}: expected a dense tensor, got a nested one: stack its parts to one shape")
    if value.layout != torch.strided:
        raise TypeError(f"{name}: expected a dense tensor, got layout {value.layout}: use .to_dense()")


def check_readable(name: str, value: Tensor) -> None:
    """Raises for tensors without values that can be copied: sparse, nested, meta."""
    check_dense(name, value)
    if value.is_meta:
        raise ValueError(f"{name}: expected values, got a tensor on the meta device, which has none")


def real_array(name: str, value: Any, wanted: str) -> Tensor:
    """Numbers, in an array, a tensor or nested sequences, as float64; shares memory and gradient with a tensor."""
    if isinstance(value, (tuple, list)) and any(isinstance(t, Tensor) and t.requires_grad for t in _leaves(value)):
        raise TypeError(f"{name}: expected {wanted}, got a {kind_of(value)} of tensors that require grad, which a copy "
                        "would lose: use torch.stack")  # fmt: skip
    if isinstance(value, Tensor):
        check_readable(name, value)
    try:
        array = torch.as_tensor(value, dtype=None if hasattr(value, "dtype") else torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(f"{name}: expected {wanted}, got a {kind_of(value)} that is none") from None
    if array.is_complex() or array.dtype == torch.bool:
        raise TypeError(f"{name}: expected {wanted} of real numbers, got dtype {array.dtype}")
    return array.to(torch.float64)


def _leaves(value: Any) -> Iterable[Any]:
    """What nested sequences hold."""
    if isinstance(value, (tuple, list)):
        for part in value:
            yield from _leaves(part)
    else:
        yield value


def to_float(name: str, value: Any) -> float:
    """A python or numpy number as a float; raises where it is too large for one."""
    try:
        return float(value)
    except OverflowError:
        fail(name, "a number that a float can hold", f"one of {value.bit_length()} bits")


def _fits(shape: tuple[int, ...], wanted: tuple[int, ...]) -> bool:
    if len(shape) > len(wanted):
        return False
    for a, b in zip(reversed(shape), reversed(wanted), strict=False):  # called in every step: no generator
        if a not in (1, b):
            return False
    return True


def check_broadcast(name: str, value: Tensor, shape: tuple[int, ...], scenes: int = 0) -> Tensor:
    """Raises unless value broadcasts to shape, whose first ``scenes`` dimensions count scenes."""
    got = tuple(value.shape)
    if not _fits(got, shape):
        hint, missing = "", len(shape) - len(got)
        each = (*got[:scenes], *(1,) * missing, *got[scenes:])  # as meant by who gives one value for each scene
        if scenes and missing > 0 and got[:scenes] == shape[:scenes] and _fits(each, shape):
            hint = f": one for each scene has shape {list(each)}"
        elif scenes and got and got[-1] == 1 and _fits(got[:-1], shape):
            hint = f": one for each scene has shape {list(got[:-1])}"
        elif len(got) > len(shape) and _fits(got[1:], shape):
            hint = f": in a rollout, per_step({name}) takes one for each step"
        fail(name, f"a shape that broadcasts to {list(shape)}", f"shape {list(got)}{hint}")
    return value


def check_count(name: str, value: Any, minimum: int = 0, maximum: int | None = None) -> int:
    if isinstance(value, bool):
        raise TypeError(f"{name}: expected an integer, got bool")
    try:
        value = operator.index(value)
    except TypeError:
        number = "" if hasattr(value, "shape") else f" {value!r}"  # an array would take many lines
        raise TypeError(f"{name}: expected an integer, got {type(value).__name__}{number}") from None
    if value < minimum:
        fail(name, f"an integer >= {minimum}", value)
    if maximum is not None and value > maximum:
        fail(name, f"an integer <= {maximum}", value)
    return value


def refuse_gradient(name: str, value: Any, instead: str = "") -> None:
    """Raises for a tensor that requires grad where numbers are copied, which would lose its gradient without a word."""
    if isinstance(value, Tensor) and value.requires_grad:
        hint = f" here: {instead}" if instead else ""
        raise TypeError(f"{name}: expected a number, got a tensor that requires grad: it is not differentiable{hint}")


def refuse_gradients(energy: Any) -> None:
    """Raises where a parameter of an energy is a tensor that requires grad: it is copied, a step takes it elsewhere."""
    for key in energy.parameters:
        refuse_gradient(key, getattr(energy, key), f"pass {input_name(energy, key)}= to a step or a rollout")


def input_name(energy: Any, key: str) -> str:
    """The keyword by which a step takes a parameter of an energy: floor_kappa, friction, pressure."""
    return energy.name if key in ("coefficient", energy.name) else f"{energy.name}_{key}"


def check_number(
    name: str, value: Any, wanted: str = "a finite number >= 0", dtype: torch.dtype = torch.float64
) -> float:
    """A finite number >= 0, in a Model's dtype, too; `wanted` for the message."""
    refuse_gradient(name, value)
    if isinstance(value, Tensor) and value.numel() == 1:
        value = value.detach().item()
    if isinstance(value, bool) or not isinstance(value, NUMBERS):
        raise TypeError(f"{name}: expected a number, got {type(value).__name__}")
    value = to_float(name, value)
    if not (math.isfinite(value) and value >= 0):
        fail(name, wanted, value)
    if value > torch.finfo(dtype).max:
        fail(name, HELD.format(dtype, MODEL), value)
    return float(value)


def check_positive(name: str, value: Any, unit: str = "", dtype: torch.dtype = torch.float64) -> float:
    """A finite number > 0, in a Model's dtype, too; its unit for the message."""
    wanted = f"a finite number > 0 {unit}".rstrip()
    number = check_number(name, value, wanted, dtype)
    if number == 0:
        fail(name, wanted, value)
    return number


def check_held(values: dict[str, Tensor], given: Any) -> dict[str, Tensor]:
    """`values` of attributes of `given`, where they are still finite in the Model's dtype."""
    for name, value in values.items():
        if not bool(torch.isfinite(value).all()):
            fail(name, HELD.format(value.dtype, MODEL), getattr(given, name))
    return values


def check_time_step(value: Any, dtype: torch.dtype) -> float:
    """h [s] > 0, with an h^2 that dtype can hold."""
    return check_square(check_positive("time_step", value, "s"), dtype)


def check_square(h: float, dtype: torch.dtype) -> float:
    """h [s], whose square dtype can hold: with less, forces and masses would vanish from a step."""
    limits = torch.finfo(dtype)
    if not limits.tiny <= h * h <= limits.max:
        fail("time_step", f"a number of seconds whose square lies between {limits.tiny:.1e} and {limits.max:.1e}", h)
    return h


def mask_or_indices(name: str, given: Any) -> Tensor:
    """A bool mask or indices of vertices as a tensor, its values not looked at."""
    try:
        out = given.detach() if isinstance(given, Tensor) else torch.as_tensor(given, device="cpu")
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise TypeError(f"{name}: expected a bool mask or integer indices, got {type(given).__name__}") from None
    check_readable(name, out)
    if out.dtype == torch.uint8 and out.numel():
        raise TypeError(
            f"{name}: expected a bool mask or indices of another dtype, got torch.uint8, which may mean either: use "
            ".bool() for a mask, .long() for indices"
        )
    if out.numel() and (out.is_floating_point() or out.is_complex()):
        raise TypeError(f"{name}: expected a bool mask or integer indices, got dtype {out.dtype}")
    return out


def vertex_mask(given: Any, num_vertices: int, name: str = "pinned") -> Tensor:
    """A bool mask or indices of vertices as a bool mask [V] on the CPU; None: no vertex."""
    if given is None:
        return torch.zeros(num_vertices, dtype=torch.bool, device="cpu")
    given = mask_or_indices(name, given).cpu()
    if given.dtype == torch.bool:
        if given.shape != (num_vertices,):
            fail(name, f"a mask of shape [{num_vertices}] or indices", f"a mask of shape {list(given.shape)}")
        return given.clone()
    index = given.to(torch.int64).reshape(-1)
    if index.numel() == num_vertices > 2 and int(index.max()) <= 1 and int(index.min()) >= 0:
        raise TypeError(f"{name}: expected a bool mask or indices, got {num_vertices} integers that are 0 or 1, which "
                        "may mean either: use .astype(bool) or .bool() for a mask")  # fmt: skip
    if index.numel() and (int(index.min()) < 0 or int(index.max()) >= num_vertices):
        fail(name, f"indices in [0, {num_vertices})", f"{int(index.min())}..{int(index.max())}")
    return torch.zeros(num_vertices, dtype=torch.bool, device="cpu").index_fill(0, index, True)


def name_value(name: str, expected: str, value: Tensor, good: Tensor, axes: tuple[str, ...] = ()) -> None:
    """Raises ValueError for the first value that is not good or not finite. axes: what its dimensions count."""
    good = good & torch.isfinite(value)
    if not bool(good.all()):
        at = (~good).nonzero()[0].tolist()
        got = float(value.detach()[tuple(at)])  # of a tensor that requires grad float() warns
        where = " of ".join(f"{axis} {k}" for axis, k in zip(axes[::-1], at[::-1], strict=True)) if axes else at
        raise ValueError(f"{name}: expected {expected}, got {got:g} at {where}") from None
