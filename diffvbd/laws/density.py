"""An energy density psi(I1, I2, J, I4) given as text: parsed by sympy, with its derivatives, as C++ and as torch.

sympy is imported at the first law.
"""

from __future__ import annotations

import ast
import hashlib
import keyword
import math
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._common.checks import fail

INVARIANTS = ("I1", "I2", "J", "I4")
STRETCHES = "trU"  # the sum of the principal stretches, a function of the first three
FUNCTIONS = ("log", "exp", "sqrt")
ROOT = "root_of"
LEAST_VOLUME = 0.1  # J below which psi is its Taylor polynomial of second order in J; twin of kLeastVolume in csrc
PAIRS = [(i, k) for i in range(4) for k in range(i, 4)]


class _Invariants(NamedTuple):
    """What functions of the density read; ``below``: how far J is below its least."""

    i1: Tensor
    i2: Tensor
    j: Tensor
    i4: Tensor
    below: Tensor


class Density:
    """psi and what is derived from it.

    Attributes:
        text: As given.
        parameters: Names of its symbols that are no invariants, sorted.
        fibre: Whether it reads I4.
        second: Whether it reads I2 or trU.
        guarded: Whether it may be undefined at J <= 0.
        quadratic: Whether it is quadratic in the position of one vertex.
        edges: Whether a vertex must know the length of edges that it is no end of.
    """

    def __init__(self, text: str) -> None:
        self.text = " ".join(text.split()) if isinstance(text, str) else text
        self.psi, self.functions = _parsed(self.text)
        import sympy

        names = {s.name for s in self.psi.free_symbols}
        self.parameters = tuple(sorted(names - set(INVARIANTS)))
        self.invariants = [sympy.Symbol(name, real=True) for name in INVARIANTS]
        self.below = sympy.Symbol("below", real=True)
        i1, i2, j, i4 = self.invariants
        stretched = self.psi.has(self.functions[STRETCHES])
        self.fibre, self.second = self.psi.has(i4), self.psi.has(i2) or stretched
        self.guarded = not self.psi.replace(self.functions[STRETCHES], lambda *_: sympy.Symbol("t")).is_polynomial(j)
        bends = [self.psi.diff(a, b) for a in (i1, i2, i4) for b in self.invariants]
        self.quadratic = all(map(_is_zero, bends)) and not self._depends(self.psi.diff(j, 2))
        self.edges = self.second or self._depends(self.psi.diff(i1))

    def _depends(self, expression: Any) -> bool:
        return bool(expression.expand().free_symbols & set(self.invariants))

    @cached_property
    def derived(self) -> dict[str, list[Any]]:
        """psi and its derivatives by the invariants, by scale (of V, at fixed stiffness weights) and by parameters, of
        the psi that is continued below LEAST_VOLUME: J is the larger of the two, `below` the rest."""
        import sympy

        i1, i2, j, _ = self.invariants
        r = self.below if self.guarded else sympy.Integer(0)
        first, second = self.psi.diff(j), self.psi.diff(j, 2)
        value = self.psi + first * r + second * r**2 / 2
        slopes = [value.diff(s) for s in self.invariants]
        slopes[2] = first + second * r
        curvatures = [slopes[k].diff(self.invariants[i]) if i != 2 or k == 2 else slopes[2].diff(self.invariants[k])
                      for i, k in PAIRS]  # fmt: skip
        curvatures[PAIRS.index((2, 2))] = second
        for place, (i, k) in enumerate(PAIRS):
            if k == 2 and i != 2:
                curvatures[place] = slopes[2].diff(self.invariants[i])
        scale = -value + i1 * slopes[0] + 2 * i2 * slopes[1] + (j + r) * slopes[2]
        symbols = [sympy.Symbol(name, real=True) for name in self.parameters]
        return {"value": [value], "slopes": slopes, "curvatures": curvatures, "by_scale": [_short(scale)],
                "by_parameters": [value.diff(s) for s in symbols]}  # fmt: skip

    # --- as C++ -------------------------------------------------------------------------------------------------------

    @cached_property
    def header(self) -> str:
        """Source of struct Density, which csrc/energies/own_law.h includes."""
        flags = ("quadratic", "second", "fibre", "guarded", "edges")
        coupled = [not _is_zero(c) for c in self.derived["curvatures"]]
        bits = sum(1 << place for place, there in enumerate(coupled) if there)
        lines = [
            "// Generated from an energy density by diffvbd/laws/density.py.",
            f"// psi = {self.text}",
            "#pragma once",
            "namespace diffvbd {",
            "struct Density {",
            f"  static constexpr int parameters = {len(self.parameters)};",
            *(f"  static constexpr bool {flag} = {'true' if getattr(self, flag) else 'false'};" for flag in flags),
            "  DIFFVBD_FN static constexpr bool couples(int i, int k) {",
            f"    return {bits} >> curvature_place(i, k) & 1;",
            "  }",
            "  DIFFVBD_FN static constexpr bool couples(int i) {",
            "    return couples(i, 0) || couples(i, 1) || couples(i, 2) || couples(i, 3);",
            "  }",
        ]
        kinds = {"value": "S", "by_scale": "S", "slopes": "Slopes<S>", "curvatures": "Curvatures<S>"}
        for name, expressions in self.derived.items():
            argument, kind = (", S* out", "void") if name == "by_parameters" else ("", kinds[name])
            head = f"DIFFVBD_FN static {kind} {name}(const Invariants<S>& v, const R* p{argument}) {{"
            lines += ["  template <class S, class R>", f"  {head}"]
            statements, results = self._statements(expressions)
            lines += [f"    const auto {symbol} = {text};" for symbol, text in statements]
            results = [f"S({r})" for r in results]
            if name == "by_parameters":
                lines += [f"    out[{i}] = {r};" for i, r in enumerate(results)]
            else:
                listed = ", ".join(results)
                lines += [f"    return {results[0] if kind == 'S' else '{' + listed + '}'};"]
            lines += ["  }"]
        return "\n".join([*lines, "};", "}  // namespace diffvbd", ""])

    @cached_property
    def digest(self) -> str:
        return hashlib.sha256(self.header.encode()).hexdigest()[:16]

    def _statements(self, expressions: Sequence[Any]) -> tuple[list[tuple[str, str]], list[str]]:
        """Common subexpressions and results, as text that is C++ and Python alike."""
        import sympy

        names = dict(zip(self.invariants, ("v.i1", "v.i2", "v.j", "v.i4"), strict=True)) | {self.below: "v.below"}
        names |= {sympy.Symbol(name, real=True): f"p[{i}]" for i, name in enumerate(self.parameters)}
        shared, results = sympy.cse([_with_roots(e) for e in expressions], symbols=sympy.numbered_symbols("t"))
        statements = []
        for symbol, expression in shared:
            statements.append((symbol.name, _text(expression, names)))
            names[symbol] = symbol.name
        return statements, [_text(r, names) for r in results]

    # --- as torch -----------------------------------------------------------------------------------------------------

    def _function(self, expressions: Sequence[Any]) -> Callable[[Any, Sequence[Tensor]], list[Any]]:
        statements, results = self._statements(expressions)
        lines = [f"{symbol} = {text}" for symbol, text in statements]
        code = "\n    ".join(["def evaluate(v, p):", *lines, f"return [{', '.join(results)}]"])
        space: dict[str, Any] = {"R": float, "natural_log": torch.log, "exponential": torch.exp, "power": torch.pow,
                                 "square_root": torch.sqrt, "stretch_sum": stretch_sum}  # fmt: skip
        exec(code, space)
        return space["evaluate"]

    def function(self, name: str) -> Callable[[Sequence[Tensor], Sequence[Tensor]], list[Tensor]]:
        """derived[name] as a function of (I1, I2, J, I4) and of the parameters in their order."""
        raw = self._function(self.derived[name])

        def evaluate(invariants: Sequence[Tensor], parameters: Sequence[Tensor]) -> list[Tensor]:
            i1, i2, j, i4 = invariants
            below, at = torch.zeros_like(j), j
            if self.guarded:
                small = j < LEAST_VOLUME
                below, at = torch.where(small, j - LEAST_VOLUME, 0.0), torch.where(small, LEAST_VOLUME, j)
            v = _Invariants(i1, i2, at, i4, below)
            return [torch.as_tensor(r, dtype=j.dtype, device=j.device) for r in raw(v, parameters)]

        return evaluate

    @cached_property
    def value(self) -> Callable[[Sequence[Tensor], Sequence[Tensor]], list[Tensor]]:
        return self.function("value")

    @cached_property
    def slopes(self) -> Callable[[Sequence[Tensor], Sequence[Tensor]], list[Tensor]]:
        return self.function("slopes")

    @cached_property
    def curvatures(self) -> Callable[[Sequence[Tensor], Sequence[Tensor]], list[Tensor]]:
        return self.function("curvatures")

    @cached_property
    def _fibre_bend(self) -> Callable[[Any, Sequence[Tensor]], list[Any]]:
        return self._function([self.derived["curvatures"][PAIRS.index((3, 3))]])

    def fibre_modulus(self, parameters: Sequence[Tensor], one: Tensor) -> Tensor:
        """Stiffness along the fibre at F = I that I4 adds [Pa], 4 d2psi/dI4^2, where it is positive.

        one: Ones of any shape with which that of the result is broadcast.
        """
        (bend,) = self._fibre_bend(_Invariants(3 * one, 3 * one, one, one, 0 * one), parameters)
        return 4 * (one * bend).clamp(min=0)  # a number where nothing varies: no copy to the device

    @cached_property
    def at_rest(self) -> Callable[..., tuple[Tensor, Tensor, Tensor]]:
        """mu, lam and stress [Pa] of the law at F = I as a function of its parameters, without fibres: the second
        derivatives of psi by two principal stretches, and the first by one."""
        import sympy

        a, b, c = stretches = sympy.symbols("a b c", positive=True)
        i1, i2, j, i4 = self.invariants
        psi = self.psi.replace(self.functions[STRETCHES], lambda *_: a + b + c)
        squares = [s**2 for s in stretches]
        psi = psi.subs({i1: sum(squares), j: a * b * c, i4: 1,
                        i2: squares[0] * squares[1] + squares[1] * squares[2] + squares[2] * squares[0]})  # fmt: skip
        rest = {s: 1 for s in stretches}
        own, other, stress = (e.subs(rest) for e in (psi.diff(a, 2), psi.diff(a, b), psi.diff(a)))
        raw = self._function([_short((own - other + stress) / 2), _short(other - stress), stress])
        return lambda *parameters: tuple(raw(None, parameters))


def _parsed(text: str) -> tuple[Any, dict[str, Any]]:
    if not isinstance(text, str):
        raise TypeError(f"expression: expected text such as 'mu/2*(I1 - 3) - mu*log(J)', got {type(text).__name__}")
    try:
        import sympy
        from sympy.core.function import AppliedUndef
        from sympy.parsing.sympy_parser import parse_expr
    except ImportError:
        raise ImportError("diffvbd.law: expected sympy, which is not installed: pip install sympy") from None
    functions = {STRETCHES: _stretches()}
    i1, i2, j, _ = (sympy.Symbol(name, real=True) for name in INVARIANTS)
    known = {name: getattr(sympy, name) for name in FUNCTIONS} | {STRETCHES: functions[STRETCHES](i1, i2, j)}
    makers = {name: getattr(sympy, name) for name in ("Integer", "Float", "Rational", "Function")}
    makers["Symbol"] = lambda name: sympy.Symbol(name, real=True)
    shown = f"an energy density of {', '.join(INVARIANTS)}, {STRETCHES} and parameters"
    try:
        _check_formula(ast.parse(text, mode="eval").body)
        psi = sympy.sympify(parse_expr(text, local_dict=known, global_dict={**makers, "__builtins__": {}}))
        psi = psi if isinstance(psi, sympy.Expr) else None
    except Exception as error:  # sympy raises what Python's parser and its own classes raise
        reason = str(error).splitlines()[-1] if str(error) else type(error).__name__
        reserved = sorted(set(re.findall(r"\w+", text)) & set(keyword.kwlist))
        if reserved and isinstance(error, SyntaxError):
            reason = f"{', '.join(reserved)}: no name in Python"
        fail("expression", shown, f"{text!r} ({reason})")
    if psi is None:
        fail("expression", shown, repr(text))
    if unknown := sorted({f.func.__name__ for f in psi.atoms(AppliedUndef)}):
        fail("expression", f"no functions but {', '.join(FUNCTIONS)}", f"{unknown[0]}() in {text!r}")
    if psi.has(sympy.Abs, sympy.sign):
        fail("expression", "k in place of sqrt(k**2)", repr(text))
    if psi.has(sympy.zoo, sympy.nan, sympy.oo, sympy.I):
        fail("expression", shown, f"{text!r}, which is {psi}")
    if not psi.free_symbols & {sympy.Symbol(name, real=True) for name in INVARIANTS}:
        fail("expression", shown, f"{text!r}, which depends on none of them")
    return psi, functions


def _check_formula(node: ast.AST) -> None:
    """Raises for what is no formula: the text is evaluated, and Python's ``or`` or ``if`` would drop terms."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)):
        if isinstance(node.op, ast.Pow):
            inside = list(ast.walk(node.right))
            if any(isinstance(n, ast.Pow) for n in inside) and not any(isinstance(n, ast.Name) for n in inside):
                raise ValueError("a power of numbers as an exponent")
        parts = [node.left, node.right]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.UAdd, ast.USub)):
        parts = [node.operand]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        parts = [node.func, *node.args]
    elif isinstance(node, ast.Name) and "__" not in node.id:
        parts = []
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value != math.inf:
        parts = []
    else:
        power = ", a power is **" if isinstance(getattr(node, "op", None), ast.BitXor) else ""
        raise ValueError(f"{type(node).__name__}: {ast.unparse(node)}{power}")
    for part in parts:
        _check_formula(part)


def _stretches() -> Any:
    """trU as a function of I1, I2, J: the largest root s of s^4 - 2 I1 s^2 - 8 J s + I1^2 - 4 I2."""
    import sympy

    def fdiff(self: Any, argindex: int = 1) -> Any:
        i1, i2, j = self.args
        of_s = 4 * self**3 - 4 * i1 * self - 8 * j
        return (2 * (self**2 - i1), 4, 8 * self)[argindex - 1] / of_s

    return type(STRETCHES, (sympy.Function,), {"fdiff": fdiff, "nargs": 3, "is_real": True})


def stretch_sum(i1: Tensor, i2: Tensor, j: Tensor) -> Tensor:
    """tr U of F = R U: the sum of the principal stretches, of which one is negative where J is; differentiable three
    times, also where stretches are equal."""

    def newton(s: Tensor, i1: Tensor, i2: Tensor, j: Tensor) -> Tensor:
        inside = s * s - i1
        return s - (inside * inside - 4 * i2 - 8 * j * s) / (4 * s * inside - 8 * j)

    with torch.no_grad():
        s = (3 * i1).sqrt()
        for _ in range(12):
            s = newton(s, i1, i2, j)
    return newton(newton(s, i1, i2, j), i1, i2, j)


def _short(expression: Any) -> Any:
    """Expanded where that cancels terms."""
    expanded = expression.expand()
    return expanded if expanded.count_ops() <= expression.count_ops() else expression


def _with_roots(expression: Any) -> Any:
    """Powers p/q as p-th powers of q-th roots, so that many of them share a root."""
    import sympy

    root = sympy.Function(ROOT)
    return sympy.sympify(expression).replace(
        lambda e: e.is_Pow and e.exp.is_Rational and 2 < e.exp.q < 10, lambda e: root(e.base, e.exp.q) ** e.exp.p
    )


def _is_zero(expression: Any) -> bool:
    return expression == 0 or expression.expand() == 0


def _text(e: Any, names: dict[Any, str]) -> str:
    """An expression over the numbers R and S of csrc/energies/own_law.h."""
    if e in names:
        return names[e]
    if e.is_number:
        if not (e.is_real and e.is_finite):
            fail("expression", "an energy density with finite derivatives", f"one that is {e}")
        return f"R({float(e)!r})"
    if e.is_Add or e.is_Mul:
        joined = (" + " if e.is_Add else " * ").join(_text(a, names) for a in sorted(e.args, key=_constants_first))
        return f"({joined})"
    if e.is_Pow:
        base, exponent = _text(e.base, names), e.exp
        if exponent.is_Integer and 1 < abs(exponent) <= 16:
            power = "(" + " * ".join([base] * abs(int(exponent))) + ")"
            return power if exponent > 0 else f"(R(1) / {power})"
        if exponent == -1:
            return f"(R(1) / {base})"
        if exponent.is_Rational and exponent.q == 2 and abs(exponent.p) == 1:
            return f"square_root({base})" if exponent > 0 else f"(R(1) / square_root({base}))"
        if exponent.is_number:
            return f"power({base}, R({float(exponent)!r}))"
        return f"exponential({_text(exponent, names)} * natural_log({base}))"
    if e.func.__name__ == ROOT:
        return f"power({_text(e.args[0], names)}, R({1 / int(e.args[1])!r}))"
    function = {"log": "natural_log", "exp": "exponential", STRETCHES: "stretch_sum"}[e.func.__name__]
    return f"{function}({', '.join(_text(a, names) for a in e.args)})"


def _constants_first(e: Any) -> tuple[bool, str]:
    """Products of plain scalars come first, which cost less than those of numbers that carry derivatives."""
    return any(s.name in (*INVARIANTS, "below") or s.name.startswith("t") for s in e.free_symbols), str(e)
