"""A number that remembers where it came from: stands in for a tensor while one step is recorded.

Torch hands every function that meets a ``Scalar`` to its ``__torch_function__``, and what an effect calls as a method
arrives by attribute; both end in one table, ``FUNCTIONS``. What is not in it is ``Untraceable``, and so is everything
that asks for a value: a Python ``if`` on a tensor, ``item()``, ``float()``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from idm_env.compiled.scalar.graph import STATIC, Graph, Node


class Untraceable(Exception):  # noqa: N818  (a property of a step, met and passed on, not a fault)
    """A step that cannot be recorded; the message names the effect and the function."""


class Unordered(Untraceable):
    """Links that are not the order of positions, as after a crash: torch does such a step, and no other for that."""


class Scalar:
    """One node of a graph, in the clothes of a tensor with no dimension."""

    __slots__ = ("graph", "node")

    def __init__(self, graph: Graph, node: Node) -> None:
        self.graph = graph
        self.node = node

    # -- what tensors tell of themselves -------------------------------------------------------------------------

    dtype = torch.float64
    device = torch.device("cpu")
    requires_grad = False
    shape = torch.Size(())
    ndim = 0

    def dim(self) -> int:
        """Return 0."""
        return 0

    def size(self) -> torch.Size:
        """Return the empty size."""
        return self.shape

    def suspected(self) -> None:
        """Remember that an effect of the user's own has made this: its NaN is to be told."""
        self.graph.suspects.append(value_of(self.graph, self))

    def __bool__(self) -> bool:
        raise _refused(self.graph, "a Python `if` (or `and`, `or`, `not`) on a tensor; use torch.where")

    def _valued(self, *_: Any) -> Any:
        raise _refused(self.graph, "the value of a tensor (item, float, int, len or an index)")

    __float__ = __int__ = __index__ = __len__ = __iter__ = __getitem__ = item = tolist = numpy = _valued

    def __hash__(self) -> int:
        return id(self.node)

    # -- what tensors do -----------------------------------------------------------------------------------------

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function is torch.Tensor.where:
            args = _condition_first(*args)
        return _apply(getattr(function, "__name__", str(function)), args, kwargs or {})

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name not in FUNCTIONS:
            raise _refused(self.graph, f"Tensor.{name}")
        if name == "where":
            return lambda condition, other: _apply(name, (condition, self, other), {})
        return lambda *args, **kwargs: _apply(name, (self, *args), kwargs)


def _condition_first(a: Any, condition: Any, b: Any) -> tuple[Any, Any, Any]:
    """Return the arguments of the method ``a.where(condition, b)`` as those of the function."""
    return condition, a, b


def _refused(graph: Graph, what: str) -> Untraceable:
    where = f"effect '{graph.note}'" if graph.note else "the simulator"
    return Untraceable(f"{where} uses {what}")


def _apply(name: str, args: Any, kwargs: dict[str, Any]) -> Scalar:
    graph = next(a for a in (*_flat(args), *kwargs.values()) if isinstance(a, Scalar)).graph
    plain = name.strip("_")
    if plain not in FUNCTIONS:
        raise _refused(graph, f"torch.{plain}")
    kind = next((x for x in (*args, kwargs.get("dtype")) if isinstance(x, torch.dtype)), torch.float64)
    if kind == torch.bool and plain == "to":
        plain = "bool"
    elif not kind.is_floating_point:
        raise _refused(graph, f"torch.{plain} to {kind}")
    args = [x for x in args if not isinstance(x, torch.dtype)]
    numbers = {k: v for k, v in kwargs.items() if k not in ("dtype", "device", "out")}
    numbers = {k: v for k, v in numbers.items() if not (k == "inplace" and v is False)}
    keywords = {k: _node(graph, v) if isinstance(v, (Scalar, torch.Tensor)) else v for k, v in numbers.items()}
    try:
        return Scalar(graph, FUNCTIONS[plain](graph, *(_node(graph, a) for a in args), **keywords))
    except TypeError as error:
        raise _refused(graph, f"torch.{plain} in a form that is not recorded ({error})") from None


def _flat(args: Any) -> list[Any]:
    return [x for a in args for x in (a if isinstance(a, (tuple, list)) else (a,))]


def _node(graph: Graph, value: Any) -> Any:
    """Return the node of a number, a scalar, or a tensor of one element; anything else as it is."""
    if isinstance(value, Scalar):
        return value.node
    if isinstance(value, torch.Tensor):
        if value.numel() != 1:
            raise _refused(graph, f"a tensor of shape {tuple(value.shape)} of its own")
        return graph.constant(float(value))
    return graph.constant(value) if isinstance(value, (bool, int, float)) else value


# -- the table ---------------------------------------------------------------------------------------------------

Rule = Callable[..., Node]


def _number(graph: Graph, value: Any) -> Node:
    return value if isinstance(value, Node) else graph.constant(value)


def _one(op: str) -> Rule:
    return lambda graph, a: graph.node(op, a)


def _clamp_min(graph: Graph, a: Node, min: Any) -> Node:
    return graph.node("clamp_min", a, _number(graph, min))


def _clamp_max(graph: Graph, a: Node, max: Any) -> Node:
    return graph.node("clamp_max", a, _number(graph, max))


def _clamp(graph: Graph, a: Node, min: Any = None, max: Any = None) -> Node:
    low = a if min is None else _clamp_min(graph, a, min)
    return low if max is None else _clamp_max(graph, low, max)


def _add(graph: Graph, a: Node, b: Node, *, alpha: float = 1) -> Node:
    return graph.add(a, b if alpha == 1 else graph.mul(graph.constant(alpha), b))


def _sub(graph: Graph, a: Node, b: Node, *, alpha: float = 1) -> Node:
    return graph.sub(a, b if alpha == 1 else graph.mul(graph.constant(alpha), b))


def _truth(graph: Graph, a: Node) -> Node:
    return a if a.boolean else graph.compare("ne", a, graph.constant(0.0))


def _where(graph: Graph, condition: Node, a: Node, b: Node) -> Node:
    return graph.select(_truth(graph, condition), _value(graph, a), _value(graph, b))


def _value(graph: Graph, a: Node) -> Node:
    return graph.select(a, graph.constant(1.0), graph.constant(0.0)) if a.boolean else a


def _remainder(graph: Graph, a: Node, b: Node) -> Node:
    # A division, not a product with 1/b: 49 · (1/49) is less than 1.
    return graph.sub(a, graph.mul(graph.node("floor", graph.node("div", a, b)), b))


def _softplus(graph: Graph, a: Node, beta: Any = 1.0, threshold: Any = 20.0) -> Node:
    scale, most = _number(graph, beta), _number(graph, threshold)
    x = graph.mul(a, scale)
    # Beyond the threshold the exponential is not needed, and would overflow.
    safe = graph.node("clamp_max", x, most)
    soft = graph.div(graph.node("log1p", graph.node("exp", safe)), scale)
    return graph.select(graph.compare("gt", x, most), a, soft)


def _lerp(graph: Graph, a: Node, b: Node, weight: Node) -> Node:
    return graph.add(a, graph.mul(weight, graph.sub(b, a)))


def _constant_like(value: float) -> Rule:
    return lambda graph, a, *_, **__: graph.constant(value)


def _same(graph: Graph, a: Node, *_: Any, **__: Any) -> Node:
    return _value(graph, a)


def _not(graph: Graph, a: Node) -> Node:
    truth = _truth(graph, a)
    return truth.args[0] if truth.op == "not" else graph.node("not", truth)


def _comparison(op: str) -> Rule:
    return lambda graph, a, b: graph.compare(op, _value(graph, a), _value(graph, b))


def _reversed(rule: Rule) -> Rule:
    return lambda graph, a, b: rule(graph, b, a)


def _joined(op: str) -> Rule:
    return lambda graph, a, b: graph.node(op, _truth(graph, a), _truth(graph, b))


def _arithmetic(rule: Rule) -> Rule:
    """Truth values count as 0 and 1 in arithmetic."""
    return lambda graph, a, b, **k: rule(graph, _value(graph, a), _value(graph, b), **k)


def _norm_pow(graph: Graph, a: Node, b: Any = None, exponent: Any = None) -> Node:
    return graph.pow(a, _number(graph, exponent if b is None else b))


_ONE: tuple[str, ...] = ("abs", "cos", "detach", "exp", "expm1", "floor", "log", "log1p", "relu", "sigmoid", "sign")
_ONE += ("sin", "sqrt", "tanh")
_TWO: dict[str, Callable[..., Node]] = {"add": _add, "sub": _sub, "mul": Graph.mul, "div": Graph.div}
FUNCTIONS: dict[str, Rule] = {
    **{op: _one(op) for op in _ONE},
    **{op: _comparison(op) for op in ("gt", "ge", "lt", "le", "eq", "ne")},
    **{op: _joined(op) for op in ("and", "or")},
    **{op: _arithmetic(rule) for op, rule in _TWO.items()},
    "remainder": _arithmetic(_remainder),
    "pow": _norm_pow,
    "rpow": lambda graph, a, b: graph.pow(b, a),
    **{f"r{op}": _arithmetic(_reversed(rule)) for op, rule in _TWO.items()},
    "neg": Graph.neg,
    "square": lambda graph, a: graph.mul(a, a),
    "reciprocal": lambda graph, a: graph.div(graph.constant(1.0), a),
    "rsqrt": lambda graph, a: graph.div(graph.constant(1.0), graph.node("sqrt", a)),
    "softplus": _softplus,
    "lerp": _lerp,
    "isfinite": lambda graph, a: graph.compare("eq", graph.sub(a, a), graph.constant(0.0)),
    "clamp": _clamp,
    "clamp_min": _clamp_min,
    "clamp_max": _clamp_max,
    "minimum": lambda graph, a, b: graph.node("minimum", a, b),
    "maximum": lambda graph, a, b: graph.node("maximum", a, b),
    "where": _where,
    "invert": _not,
    "bool": _truth,
    **dict.fromkeys(("zeros_like", "new_zeros"), _constant_like(0.0)),
    **dict.fromkeys(("ones_like", "new_ones"), _constant_like(1.0)),
    **dict.fromkeys(("full_like", "new_tensor"), lambda graph, a, value, **_: _number(graph, value)),
    **dict.fromkeys(
        ("expand", "expand_as", "to", "type_as", "contiguous", "clone", "float", "double", "broadcast_to"), _same
    ),
}
"""Torch function or method → how its nodes are made. Methods and operators have the same names."""
_OTHERS: dict[str, tuple[str, ...]] = {"abs": ("absolute",), "neg": ("negative",), "sub": ("subtract",)}
_OTHERS |= {"mul": ("multiply",), "clamp": ("clip",)}
_OTHERS |= {"div": ("divide", "true_divide", "truediv"), "rdiv": ("rtruediv",), "remainder": ("mod",)}
_OTHERS |= {"gt": ("greater",), "lt": ("less",), "and": ("logical_and", "rand"), "or": ("logical_or", "ror")}
_OTHERS |= {"invert": ("logical_not", "bitwise_not")}
FUNCTIONS |= {other: FUNCTIONS[name] for name, others in _OTHERS.items() for other in others}


def _operator(name: str, symbol: str) -> None:
    def method(self: Scalar, *others: Any) -> Any:
        if any(not isinstance(x, (Scalar, torch.Tensor, bool, int, float)) for x in others):
            return NotImplemented
        return _apply(name, (self, *others), {})

    setattr(Scalar, f"__{symbol}__", method)


_ARITHMETIC = ("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv", "mod", "pow", "rpow", "neg", "abs")
_LOGIC = ("gt", "ge", "lt", "le", "eq", "ne", "and", "or", "rand", "ror", "invert")
for _symbol in (*_ARITHMETIC, *_LOGIC):
    _operator(_symbol, _symbol)


def value_of(graph: Graph, x: Any) -> Node:
    """Return the node of what a step returned: a scalar, a number, or a tensor of one element."""
    node = _node(graph, x)
    if not isinstance(node, Node):
        raise _refused(graph, f"a result of type {type(x).__name__}")
    return _value(graph, node)


def static(graph: Graph, name: str) -> Scalar:
    """Return a parameter."""
    return Scalar(graph, graph.input(name, level=STATIC))
