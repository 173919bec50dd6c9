"""A step as a graph of scalars: what the recorder writes, ``derive`` differentiates and ``source`` prints.

Nodes are shared: the same operation on the same nodes is one node. A node's level says how often it changes: with
nothing (``CONSTANT``), with parameters only (``STATIC``), or with every step (``DYNAMIC``).
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

CONSTANT, STATIC, DYNAMIC = 0, 1, 2

BOOLEAN = frozenset({"gt", "ge", "lt", "le", "eq", "ne", "and", "or", "not"})
COSTLY = frozenset({"div", "sqrt", "exp", "expm1", "log", "log1p", "pow", "tanh", "sigmoid", "sin", "cos"})
"""Operations worth taking out of the loop over time where they depend on parameters alone."""


class TimeStep(float):
    """The time step, and what Python makes of it: constants that are kept apart from others of the same value.

    So a printed text does not depend on whether Δt happens to equal some constant of an effect.
    """

    @staticmethod
    def _method(name: str) -> Callable[..., Any]:
        def method(self: float, *others: Any) -> Any:
            if not all(isinstance(x, (int, float)) for x in others):
                return NotImplemented
            return TimeStep(getattr(float, name)(float(self), *map(float, others)))

        return method

    __add__, __radd__, __sub__, __rsub__ = map(_method, ("__add__", "__radd__", "__sub__", "__rsub__"))
    __mul__, __rmul__, __truediv__, __rtruediv__ = map(_method, ("__mul__", "__rmul__", "__truediv__", "__rtruediv__"))
    __neg__, __pow__ = map(_method, ("__neg__", "__pow__"))


class Leaf(NamedTuple):
    """A number that a step reads: its name, and whose it is: 0 one's own, 1 the leader's, 2 his leader's, −1 behind."""

    name: str
    shift: int = 0


@dataclass(frozen=True, eq=False)
class Node:
    """One operation; ``label`` is an input's ``Leaf`` or a constant's value, ``note`` the effect that asked for it."""

    op: str
    args: tuple[Node, ...]
    label: Leaf | float | int | None
    level: int
    note: str

    @property
    def boolean(self) -> bool:
        """Whether this is a truth value."""
        return self.op in BOOLEAN


@dataclass
class Graph:
    """Makes nodes, each once, with what follows from the arithmetic of constants folded in."""

    note: str = ""
    suspects: list[Node] = field(default_factory=list)
    """What effects of the user's own have made, which may be NaN."""
    _nodes: dict[tuple[object, ...], Node] = field(default_factory=dict)

    def node(self, op: str, *args: Node, label: Leaf | float | int | None = None, level: int | None = None) -> Node:
        """Return the node of this operation on these nodes."""
        key = (op, *(id(a) for a in args), label, type(label))
        node = self._nodes.get(key)
        if node is None:
            level = max((a.level for a in args), default=CONSTANT) if level is None else level
            node = self._nodes[key] = Node(op, args, label, level, self.note)
        return node

    def constant(self, value: float) -> Node:
        """Return a constant."""
        return self.node("constant", label=value if isinstance(value, float) else float(value))

    def input(self, name: str, shift: int = 0, level: int = DYNAMIC) -> Node:
        """Return the node of an input by name."""
        return self.node("input", label=Leaf(name, shift), level=level)

    # -- arithmetic ----------------------------------------------------------------------------------------------

    def add(self, a: Node, b: Node) -> Node:
        """Return a + b."""
        if _is(a, 0.0):
            return b
        if a.op == b.op == "select" and a.args[0] is b.args[0] and any(_is(x, 0.0) for x in (*a.args, *b.args)):
            # What falls on one number from both sides of a choice is one choice.
            return self.select(a.args[0], self.add(a.args[1], b.args[1]), self.add(a.args[2], b.args[2]))
        return a if _is(b, 0.0) else self.node("add", a, b)

    def sub(self, a: Node, b: Node) -> Node:
        """Return a − b."""
        return a if _is(b, 0.0) else self.neg(b) if _is(a, 0.0) else self.node("sub", a, b)

    def mul(self, a: Node, b: Node) -> Node:
        """Return a b."""
        if _is(a, 1.0):
            return b
        return a if _is(b, 1.0) else self.node("mul", a, b)

    def neg(self, a: Node) -> Node:
        """Return −a."""
        if a.op == "constant":
            return self.constant(-_number(a))
        return a.args[0] if a.op == "neg" else self.node("neg", a)

    def div(self, a: Node, b: Node) -> Node:
        """Return a / b, as a product with 1 / b where b holds for many steps: a division costs ten products."""
        if b.op == "constant" and a.level == DYNAMIC:
            return self.mul(a, self.constant(1.0 / _number(b)))
        if b.level == STATIC and a.level == DYNAMIC:
            return self.mul(a, self.node("div", self.constant(1.0), b))
        return self.node("div", a, b)

    def pow(self, a: Node, b: Node) -> Node:
        """Return a to the power of b; by products where b is a small whole number."""
        if b.op == "constant" and _number(b) in (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0):
            whole, result = int(_number(b)), None
            while whole:
                if whole & 1:
                    result = a if result is None else self.mul(result, a)
                whole >>= 1
                a = self.mul(a, a) if whole else a
            assert result is not None
            return result
        if b.op == "constant" and _number(b) == 0.5:
            return self.node("sqrt", a)
        return self.node("pow", a, b)

    # -- choices -------------------------------------------------------------------------------------------------

    def select(self, condition: Node, a: Node, b: Node) -> Node:
        """Return a where the condition holds, else b.

        Conjunctions become selections of selections, because loops with plain selections vectorise.
        """
        if a is b:
            return a
        if condition.op in _COMPARED and condition.args[0].op == condition.args[1].op == "constant":
            return a if _COMPARED[condition.op](*(_number(x) for x in condition.args)) else b
        if condition.op == "not":
            return self.select(condition.args[0], b, a)
        if condition.op == "and":
            first, second = condition.args
            return self.select(first, self.select(second, a, b), b)
        if condition.op == "or":
            first, second = condition.args
            return self.select(first, a, self.select(second, a, b))
        return self.node("select", condition, a, b)

    def compare(self, op: str, a: Node, b: Node) -> Node:
        """Return a truth value: gt, ge, lt, le, eq or ne."""
        return self.node(op, a, b)

    def again(self, node: Node, args: Sequence[Node]) -> Node:
        """Return the same operation on other nodes."""
        if node.op in ("add", "sub", "mul", "neg", "div", "pow", "select"):
            return getattr(self, node.op)(*args)
        return self.node(node.op, *args, label=node.label, level=node.level if node.op == "past" else None)

    def shifted(self, node: Node, by: int) -> Node:
        """Return the same expression of the vehicle ``by`` places ahead (negative: behind)."""
        return self.renamed(node, lambda slot: Leaf(slot.name, slot.shift + by))

    def renamed(self, node: Node, change: Callable[[Leaf], Leaf]) -> Node:
        """Return the same expression with other slots read."""
        done: dict[Node, Node] = {}
        for each in ordered([node]):
            if each.op == "input":
                assert isinstance(each.label, Leaf)
                done[each] = self.input(*change(each.label), each.level)
            elif each.args:
                done[each] = self.node(each.op, *(done[a] for a in each.args), label=each.label)
            else:
                done[each] = each
        return done[node]


_COMPARED: dict[str, Callable[[float, float], bool]] = {
    name: getattr(operator, name) for name in ("gt", "ge", "lt", "le", "eq", "ne")
}


def _is(node: Node, value: float) -> bool:
    return node.op == "constant" and node.label == value


def _number(node: Node) -> float:
    assert isinstance(node.label, float)
    return node.label


def ordered(outputs: Iterable[Node]) -> list[Node]:
    """Return all nodes that the outputs need, every node after those that it needs itself."""
    seen: set[Node] = set()
    order: list[Node] = []
    stack: list[tuple[Node, bool]] = [(node, False) for node in reversed(list(outputs))]
    while stack:
        node, ready = stack.pop()
        if ready:
            order.append(node)
        elif node not in seen:
            seen.add(node)
            stack.append((node, True))
            stack += [(a, False) for a in reversed(node.args) if a not in seen]
    return order


def inputs_of(outputs: Sequence[Node]) -> list[Leaf]:
    """Return the slots that the outputs read, in order."""
    slots = [node.label for node in ordered(outputs) if node.op == "input"]
    return sorted({slot for slot in slots if isinstance(slot, Leaf)})


def hoisted(graph: Graph, outputs: Sequence[Node], name: str = "hoisted") -> tuple[list[Node], list[Node]]:
    """Take what depends on parameters alone out of the outputs, where it costs more than a load.

    Returns the outputs with inputs ``name0``, ``name1``, … in place of those expressions, and the expressions.
    """
    order = ordered(outputs)
    costly: set[Node] = set()
    for node in order:
        if node.level == STATIC and (node.op in COSTLY or any(a in costly for a in node.args)):
            costly.add(node)
    rows: list[Node] = []
    for node in order:
        if node.level == DYNAMIC:
            rows += [a for a in node.args if a in costly and a not in rows]
    rows += [node for node in outputs if node in costly and node not in rows]
    places = {node: graph.input(f"{name}{i}", level=STATIC) for i, node in enumerate(rows)}
    return replaced(graph, outputs, places), rows


def replaced(graph: Graph, outputs: Sequence[Node], places: Mapping[Node, Node]) -> list[Node]:
    """Return the outputs with some nodes replaced by others."""
    done = dict(places)
    for node in ordered(outputs):
        if node not in done:
            note, graph.note = graph.note, node.note
            changed = any(done[a] is not a for a in node.args)
            done[node] = graph.again(node, [done[a] for a in node.args]) if changed else node
            graph.note = note
    return [done[node] for node in outputs]
