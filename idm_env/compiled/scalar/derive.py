"""Derivatives of a graph of scalars, as further nodes of the same graph.

At kinks the derivative is the one that torch takes: ``relu`` and ``abs`` 0, ``clamp`` 1, ``minimum`` and ``maximum`` of
equal numbers one half each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from idm_env.compiled.scalar.graph import Graph, Node, ordered

Share = tuple[int, Node]
"""Which argument gets how much of a result's adjoint."""


def _masked(graph: Graph, op: str, a: Node, b: Node, g: Node) -> Node:
    """All of g where a and b compare so, else nothing."""
    return graph.select(graph.compare(op, a, b), g, graph.constant(0.0))


def _larger(graph: Graph, a: Node, b: Node, g: Node) -> Node:
    """All of g where a > b, half of it where they are equal."""
    half = graph.mul(g, graph.constant(0.5))
    return graph.select(graph.compare("gt", a, b), g, _masked(graph, "eq", a, b, half))


def _chosen(graph: Graph, a: Node, b: Node, g: Node) -> list[Share]:
    """To the first argument all of g where a > b, to the second where b > a."""
    return [(0, _larger(graph, a, b, g)), (1, _larger(graph, b, a, g))]


def _clamped(graph: Graph, node: Node, g: Node, inside: str, beyond: str) -> list[Share]:
    x, bound = node.args
    return [(0, _masked(graph, inside, x, bound, g)), (1, _masked(graph, beyond, x, bound, g))]


def _div(graph: Graph, node: Node, g: Node) -> list[Share]:
    part = graph.div(g, node.args[1])
    return [(0, part), (1, graph.neg(graph.mul(part, node)))]


def _pow(graph: Graph, node: Node, g: Node) -> list[Share]:
    a, b = node.args
    zero = graph.constant(0.0)
    lower = graph.node("pow", a, graph.sub(b, graph.constant(1.0)))
    # The power 0 is constant, at a base of 0 as well, where the product below is no number.
    by_base = graph.select(graph.compare("eq", b, zero), zero, graph.mul(graph.mul(g, b), lower))
    # 0 to a positive power: the logarithm is infinite, the product's limit is 0.
    log = graph.node("log", graph.select(graph.compare("eq", a, graph.constant(0.0)), graph.constant(1.0), a))
    return [(0, by_base), (1, graph.mul(graph.mul(g, node), log))]


def _abs(graph: Graph, node: Node, g: Node) -> list[Share]:
    (x,), zero = node.args, graph.constant(0.0)
    return [(0, graph.select(graph.compare("gt", x, zero), g, _masked(graph, "lt", x, zero, graph.neg(g))))]


def _select(graph: Graph, node: Node, g: Node) -> list[Share]:
    condition, zero = node.args[0], graph.constant(0.0)
    return [(1, graph.select(condition, g, zero)), (2, graph.select(condition, zero, g))]


RULES: dict[str, Callable[[Graph, Node, Node], list[Share]]] = {
    "add": lambda graph, node, g: [(0, g), (1, g)],
    "sub": lambda graph, node, g: [(0, g), (1, graph.neg(g))],
    "mul": lambda graph, node, g: [(0, graph.mul(g, node.args[1])), (1, graph.mul(g, node.args[0]))],
    "div": _div,
    "neg": lambda graph, node, g: [(0, graph.neg(g))],
    "pow": _pow,
    "abs": _abs,
    "select": _select,
    "sqrt": lambda graph, node, g: [(0, graph.mul(g, graph.div(graph.constant(0.5), node)))],
    "exp": lambda graph, node, g: [(0, graph.mul(g, node))],
    "expm1": lambda graph, node, g: [(0, graph.mul(g, graph.add(node, graph.constant(1.0))))],
    "log": lambda graph, node, g: [(0, graph.div(g, node.args[0]))],
    "log1p": lambda graph, node, g: [(0, graph.div(g, graph.add(node.args[0], graph.constant(1.0))))],
    "tanh": lambda graph, node, g: [(0, graph.mul(g, graph.sub(graph.constant(1.0), graph.mul(node, node))))],
    "sigmoid": lambda graph, node, g: [(0, graph.mul(g, graph.mul(node, graph.sub(graph.constant(1.0), node))))],
    "sin": lambda graph, node, g: [(0, graph.mul(g, graph.node("cos", node.args[0])))],
    "cos": lambda graph, node, g: [(0, graph.neg(graph.mul(g, graph.node("sin", node.args[0]))))],
    "relu": lambda graph, node, g: [(0, _masked(graph, "gt", node.args[0], graph.constant(0.0), g))],
    "clamp_min": lambda graph, node, g: _clamped(graph, node, g, "ge", "lt"),
    "clamp_max": lambda graph, node, g: _clamped(graph, node, g, "le", "gt"),
    "maximum": lambda graph, node, g: _chosen(graph, node.args[0], node.args[1], g),
    "minimum": lambda graph, node, g: _chosen(graph, node.args[1], node.args[0], g),
    "floor": lambda graph, node, g: [],
    "sign": lambda graph, node, g: [],
    "detach": lambda graph, node, g: [],
}
"""Operation → the adjoints of its arguments from that of its result."""


def adjoint(graph: Graph, outputs: Sequence[Node], seeds: Sequence[Node]) -> dict[Node, Node]:
    """Return the adjoint of every leaf that the outputs depend on: Σ seed · ∂output/∂leaf."""
    order = [node for node in ordered(outputs) if not node.boolean]
    moving = _moving(order)
    parts: dict[Node, Node] = {}

    def give(node: Node, part: Node) -> None:
        if node in moving:
            parts[node] = graph.add(parts[node], part) if node in parts else part

    for output, seed in zip(outputs, seeds, strict=True):
        give(output, seed)
    for node in reversed(order):
        g = parts.get(node)
        if g is None or not node.args or node.op == "input":
            continue
        graph.note = node.note
        for index, part in RULES[node.op](graph, node, g):
            if node.args[index] in moving:
                give(node.args[index], part)
    return {node: g for node, g in parts.items() if node.op == "input"}


def _moving(order: Sequence[Node]) -> set[Node]:
    """Return the nodes that depend on a leaf: constants and truth values need no adjoint."""
    moving: set[Node] = set()
    for node in order:
        if node.op == "input" or any(a in moving for a in node.args):
            moving.add(node)
    return moving
