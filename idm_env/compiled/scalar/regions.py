"""Graphs with parts that are computed only where an effect is at work: what discovery's loop over a catalogue needs.

An effect behind a flag is wrapped: its hook runs, for real, while the graph notes that all nodes made meanwhile belong
to a region; what the hook changed is merged with what was there before. Nodes of a region are not shared with what lies
outside it, because outside nobody may have computed them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from idm_env.compiled.scalar.graph import CONSTANT, DYNAMIC, STATIC, Graph, Leaf, Node
from idm_env.compiled.scalar.scalar import Scalar, value_of
from idm_env.effects.base import Effect


@dataclass
class Regions(Graph):
    """A graph that knows in which order its nodes were made (``serial``) and in which region (``region``)."""

    serial: dict[Node, int] = field(default_factory=dict)
    region: dict[Node, int] = field(default_factory=dict)
    guards: list[Node] = field(default_factory=list)
    _scopes: list[dict[tuple[object, ...], Node]] = field(default_factory=lambda: [{}])

    def node(self, op: str, *args: Node, label: Leaf | float | int | None = None, level: int | None = None) -> Node:
        """Return the node of this operation on these nodes."""
        key = (op, *(id(a) for a in args), label, type(label))
        for scope in self._scopes:
            if key in scope:
                return scope[key]
        level = max((a.level for a in args), default=CONSTANT) if level is None else level
        node = Node(op, args, label, level, self.note)
        # Inputs and constants cost nothing to read and belong to nobody.
        free = op in ("input", "constant")
        (self._scopes[0] if free else self._scopes[-1])[key] = node
        self.serial[node] = len(self.serial)
        if len(self._scopes) > 1 and not free:
            self.region[node] = len(self.guards) - 1
        return node

    @contextmanager
    def within(self, flag: str) -> Iterator[int]:
        """Put all nodes that are made inside into a new region, which is computed where the flag is not 0.

        ValueError inside another region.
        """
        if len(self._scopes) > 1:
            raise ValueError("regions do not nest.")
        self.guards.append(self.input(flag, level=STATIC))
        self._scopes.append({})
        try:
            yield len(self.guards) - 1
        finally:
            self._scopes.pop()

    def merged(self, region: int, inside: Node, outside: Node) -> Node:
        """Return ``inside`` where the region is computed, ``outside`` elsewhere."""
        if inside is outside:
            return outside
        return self.node("merge", self.guards[region], inside, outside, label=region)


class _Tabled(dict[str, Any]):
    """Parameters of an effect with a curve: the loop looks its values up, in a table of numbers."""

    def __init__(self, values: dict[str, Any], graph: Graph, number: int) -> None:
        super().__init__(values)
        self._graph, self._number = graph, number

    def table(self, x: Any) -> Scalar:
        """Return the curve at x."""
        place = value_of(self._graph, x)
        return Scalar(self._graph, self._graph.node("table", place, label=self._number, level=DYNAMIC))


_BEFORE: dict[str, Callable[[str, Any], Any]] = dict.fromkeys(("perceive", "adapt", "limit"), lambda _, first: first)
_BEFORE |= dict.fromkeys(("accelerate", "initial_memory"), lambda _, scene: 0.0)
_BEFORE |= {"remember": lambda name, scene: scene.memory[name]}
"""Hooks, and what there is without them: of the effect's name and the hook's first argument."""


class Flagged:
    """An effect behind a flag: a duck with the effect's name, hooks and needs."""

    def __init__(self, effect: Effect, graph: Regions, flag: str, table: int | None) -> None:
        self.effect, self._graph, self._flag, self._table = effect, graph, flag, table

    def __getattr__(self, name: str) -> Any:
        content = getattr(self.effect, name)
        return partial(self._run, name, content) if name in _BEFORE else content

    def _run(self, name: str, hook: Callable[..., Any], *args: Any) -> Any:
        (*scenes, p), before = args, _BEFORE[name](self.effect.name, args[0])
        if self._table is not None:
            p = _Tabled(p, self._graph, self._table)
        with self._graph.within(self._flag) as region:
            after = hook(*scenes, p)
            after = _nodes(self._graph, after, before)
        return self._merge(region, after, before)

    def _merge(self, region: int, after: Any, before: Any) -> Any:
        if after is before:
            return before
        if isinstance(after, tuple):
            return type(after)(*(self._merge(region, a, b) for a, b in zip(after, before, strict=True)))  # type: ignore[call-arg]
        graph = self._graph
        return Scalar(graph, graph.merged(region, after.node, value_of(graph, before)))


def _nodes(graph: Graph, after: Any, before: Any) -> Any:
    """Make scalars of the numbers that a hook may have put in place of others, while its region is open."""
    if after is before:
        return after
    if isinstance(after, tuple):
        return type(after)(*(_nodes(graph, a, b) for a, b in zip(after, before, strict=True)))  # type: ignore[call-arg]
    return Scalar(graph, value_of(graph, after))
