"""Every function that can be recorded has torch's value and torch's gradient, at kinks as well."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from idm_env.compiled.scalar.derive import RULES, adjoint
from idm_env.compiled.scalar.graph import BOOLEAN, Graph, Node, ordered
from idm_env.compiled.scalar.scalar import FUNCTIONS, Scalar, Untraceable, value_of

EVALUATED: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "pow": lambda a, b: a**b,
    "abs": abs,
    "detach": lambda a: a,
    "relu": lambda a: max(a, np.float64(0.0)),
    "sigmoid": lambda a: 1.0 / (1.0 + np.exp(-a)),
    "clamp_min": lambda a, b: b if a < b else a,
    "clamp_max": lambda a, b: b if a > b else a,
    "maximum": max,
    "minimum": min,
    "select": lambda c, a, b: a if c else b,
    "gt": lambda a, b: a > b,
    "ge": lambda a, b: a >= b,
    "lt": lambda a, b: a < b,
    "le": lambda a, b: a <= b,
    "eq": lambda a, b: a == b,
    "ne": lambda a, b: a != b,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
    "not": lambda a: not a,
    **{n: getattr(np, n) for n in ("sqrt", "exp", "expm1", "log", "log1p", "tanh", "sin", "cos", "floor", "sign")},
}
"""Operation of a graph → its meaning."""


def evaluate(outputs: list[Node], values: dict[str, float]) -> list[float]:
    """Return the values of nodes, without any printing."""
    done: dict[Node, Any] = {}
    with np.errstate(all="ignore"):
        for node in ordered(outputs):
            if node.op == "input":
                done[node] = np.float64(values[node.label.name])  # type: ignore[union-attr]
            elif node.op == "constant":
                done[node] = np.float64(node.label)  # type: ignore[arg-type]
            else:
                done[node] = EVALUATED[node.op](*(done[a] for a in node.args))
    return [float(done[node]) for node in outputs]


def recorded(function: Callable[..., Any], values: tuple[float, ...]) -> tuple[float, list[float]]:
    """Return value and gradient of a function by a graph."""
    graph = Graph()
    leaves = [graph.input(f"x{i}") for i in range(len(values))]
    output = value_of(graph, function(*(Scalar(graph, leaf) for leaf in leaves)))
    found = adjoint(graph, [output], [graph.constant(1.0)])
    parts = [found.get(leaf, graph.constant(0.0)) for leaf in leaves]
    value, *gradient = evaluate([output, *parts], {f"x{i}": x for i, x in enumerate(values)})
    return value, gradient


def by_torch(function: Callable[..., Any], values: tuple[float, ...]) -> tuple[float, list[float]]:
    """Return value and gradient by torch."""
    leaves = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in values]
    output = torch.as_tensor(function(*leaves)).to(torch.float64)
    if not output.requires_grad:
        return float(output), [0.0] * len(values)
    found = torch.autograd.grad(output, leaves, allow_unused=True)
    return float(output), [0.0 if g is None else float(g) for g in found]


def check(function: Callable[..., Any], values: tuple[float, ...]) -> None:
    """Assert that both agree wherever torch's value is a number."""
    expected, slopes = by_torch(function, values)
    if not math.isfinite(expected):
        return
    got, found = recorded(function, values)
    assert got == pytest.approx(expected, rel=1e-13, abs=1e-13), values
    for mine, other in zip(found, slopes, strict=True):
        if math.isnan(other):
            assert math.isnan(mine), values
        else:
            assert mine == pytest.approx(other, rel=1e-12, abs=1e-12), values


ONE: dict[str, Callable[..., Any]] = {
    **{
        name: getattr(torch, name)
        for name in (
            "abs",
            "absolute",
            "sign",
            "sqrt",
            "rsqrt",
            "exp",
            "expm1",
            "log",
            "log1p",
            "tanh",
            "sigmoid",
            "sin",
            "cos",
            "floor",
            "relu",
            "neg",
            "negative",
            "reciprocal",
            "square",
            "zeros_like",
            "ones_like",
            "detach",
            "clone",
        )
    },
    "softplus": torch.nn.functional.softplus,
    "softplus, sharp": lambda x: torch.nn.functional.softplus(x, beta=3.0, threshold=2.0),
    "relu, functional": torch.nn.functional.relu,
    "isfinite": lambda x: torch.where(torch.isfinite(x / x.floor()), x, -x),
    "clamp": lambda x: x.clamp(-0.5, 1.0),
    "clip": lambda x: torch.clip(x, min=0.5),
    "clamp_min": lambda x: x.clamp_min(0.5),
    "clamp_max": lambda x: torch.clamp_max(x, 0.5),
    "full_like": lambda x: x * torch.full_like(x, 3.0),
    "new_tensor": lambda x: x + x.new_tensor(3.0),
    "new_zeros": lambda x: x + x.new_zeros(()) + x.new_ones(()),
    "add with alpha": lambda x: torch.add(x, x, alpha=2.5),
    "subtract with alpha": lambda x: torch.sub(2.0 * x, x, alpha=0.5),
    "from the right": lambda x: (1.0 - x) + 2.0 * x + 1.0 / (x * x + 1.0) + (3.0 + x) + torch.rsub(x, 2.0),
    "multiply": lambda x: torch.multiply(x, x),
    "divide": lambda x: torch.divide(x, 4.0) + torch.true_divide(x, 8.0),
    "subtract": lambda x: torch.subtract(x, 3.0),
    "detached factor": lambda x: x.detach() * x,
    **{f"power {n}": lambda x, n=n: x**n for n in (0, 0.0, 1, 2, 3, 4, 6, 8, 12, 16, 5, 0.5, -1, 2.7, -0.5)},
    **{f"pow of {b}": lambda x, b=b: torch.pow(b, x) for b in (0.0, 0.5, 1.0, 2.0)},
    "rpow": lambda x: 2.0**x,
    "remainder": lambda x: torch.remainder(x, 1.5),
    "modulo": lambda x: x % 0.7,
    "where": lambda x: torch.where(x > 0.5, x * x, -x),
    "where, number": lambda x: torch.where(x >= 0.5, 2.0, x),
    "method where": lambda x: x.where(x < 0.5, x * 3.0),
    "truth as number": lambda x: (x > 0.0) * x + (x <= 0.0).to(x.dtype) + 2.0 * (x != 1.0).double(),
    "not": lambda x: torch.where(~(x > 0.0), x, 2.0 * x) + torch.where(torch.logical_not(x > 1.0), x, 0.0),
    "bool": lambda x: torch.where(x.bool(), 3.0 * x, x - 1.0),
    "to bool": lambda x: x.to(torch.bool) * 5.0 * torch.ones_like(x),
    "shape": lambda x: x.expand_as(x).contiguous().broadcast_to(x.shape).type_as(x),
    "tensor of one element": lambda x: x * torch.tensor(2.0, dtype=torch.float64),
}
TWO: dict[str, Callable[..., Any]] = {
    "add": torch.add,
    "sub": lambda x, y: x - y,
    "mul": torch.mul,
    "div": torch.div,
    "quotient with a square": lambda x, y: x / (y * y + 0.5),
    "pow": torch.pow,
    "minimum": torch.minimum,
    "maximum": torch.maximum,
    "remainder": torch.remainder,
    "clamp by tensors": lambda x, y: torch.clamp(x, min=y, max=y + 1.0),
    "clamp_min by a tensor": lambda x, y: torch.clamp(x, min=y),
    "lerp": lambda x, y: torch.lerp(x, y, 0.3),
    "lerp by a tensor": lambda x, y: torch.lerp(x, 2.0 * y, y),
    "where": lambda x, y: torch.where(x > y, x, y * y),
    "and": lambda x, y: torch.where((x > 0.0) & (y > 0.0), x * y, x + y),
    "or": lambda x, y: torch.where((x > 0.0) | (y >= 1.0), x * y, x + y),
    "logical": lambda x, y: torch.where(torch.logical_and(x > y, torch.logical_or(x < 2.0, y < 0.0)), x, y),
    "comparisons": lambda x, y: torch.where(torch.greater(x, y), x, 0.0) + torch.where(torch.less(x, y), y, 0.0),
    "equal": lambda x, y: torch.where(x == y, 2.0 * x, x * y) + torch.where(torch.ne(x, y), x, y),
    "of comparisons": lambda x, y: torch.where((x > 0.0) == (y > 0.0), x, y),
    "ballistic": lambda x, y: torch.where(x + y < 0, 0.5 * x * x / torch.where(x + y < 0, -y, 1.0), x + 0.5 * y),
    "shared": lambda x, y: torch.sqrt(torch.relu(x * y) + 1.0) * torch.exp(-x.abs()) + torch.tanh(x * y) / (1 + y * y),
}
POINTS = (-2.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 30.0)


@pytest.mark.parametrize("name", ONE)
def test_functions_of_one_number(name: str) -> None:
    for x in POINTS:
        check(ONE[name], (x,))


@pytest.mark.parametrize("name", TWO)
def test_functions_of_two_numbers(name: str) -> None:
    for x, y in product(POINTS, POINTS):
        check(TWO[name], (x, y))


@settings(max_examples=50)
@given(name=st.sampled_from(sorted(ONE)), other=st.sampled_from(sorted(TWO)), x=st.floats(-6, 6), y=st.floats(-6, 6))
def test_compositions_at_random(name: str, other: str, x: float, y: float) -> None:
    """A function of one number within one of two."""
    x, y = round(x, 3), round(y, 3)
    if not math.isfinite(by_torch(ONE[name], (x,))[0]):
        return
    inner = by_torch(ONE[name], (x,))
    if all(math.isfinite(g) for g in inner[1]) and abs(inner[0]) < 1e3:
        check(lambda a, b: torch.tanh(TWO[other](ONE[name](a), b)), (x, y))


@pytest.mark.parametrize("period", [49.0, 1200.0, 0.125])
def test_a_remainder_jumps_where_torch_jumps(period: float) -> None:
    """``a · (1/49)`` is less than one at a = 49."""
    for times in range(1, 50):
        check(lambda x: torch.remainder(x, period), (period * times,))


def test_every_function_is_tested() -> None:
    """Whoever adds a function adds its line above."""
    asked: set[str] = set()

    class Asked(dict):  # type: ignore[type-arg]
        def __getitem__(self, key: str) -> Any:
            asked.add(key)
            return super().__getitem__(key)

    table = Asked(FUNCTIONS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("idm_env.compiled.scalar.scalar.FUNCTIONS", table)
        for function in ONE.values():
            recorded(function, (0.7,))
        for function in TWO.values():
            recorded(function, (0.7, 0.3))
    # The same rule under another name, as torch or Python calls it.
    known = {id(FUNCTIONS[name]) for name in asked}
    spare = {"rdiv", "rtruediv", "rand", "ror", "radd", "rmul", "invert", "bitwise_not", "ge", "mod", "float", "to"}
    missing = {name for name, rule in FUNCTIONS.items() if name not in asked and id(rule) not in known}
    assert missing <= spare, missing - spare
    assert set(EVALUATED) - BOOLEAN == set(RULES)


def refused(function: Callable[..., Any]) -> str:
    graph = Graph(note="mine")
    with pytest.raises(Untraceable) as caught:
        function(Scalar(graph, graph.input("x")))
    return str(caught.value)


def test_what_cannot_be_recorded_says_so() -> None:
    """Named: the effect and the function."""
    assert refused(lambda x: 1.0 if x > 0 else 0.0) == (
        "effect 'mine' uses a Python `if` (or `and`, `or`, `not`) on a tensor; use torch.where"
    )
    assert refused(lambda x: x > 0 and x < 1).startswith("effect 'mine' uses a Python `if`")
    assert refused(lambda x: torch.erf(x)) == "effect 'mine' uses torch.erf"
    assert refused(lambda x: x.cumsum(-1)) == "effect 'mine' uses Tensor.cumsum"
    for value in (lambda x: x.item(), lambda x: float(x), lambda x: int(x), lambda x: x[..., 0], len, list):
        assert "the value of a tensor" in refused(value)
    assert "a tensor of shape (3,) of its own" in refused(lambda x: x * torch.ones(3))
    assert "in a form that is not recorded" in refused(lambda x: torch.where(x > 0))
    assert "torch.int64" in refused(lambda x: x.to(torch.int64))
    assert "torch.int32" in refused(lambda x: torch.full_like(x, 1.5, dtype=torch.int32))
