"""A graph with regions printed as straight-line Python over local names, for a loop over one vehicle.

What depends on parameters alone is printed apart (``constants``), to stand before the loop over time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from idm_env.scalar.graph import DYNAMIC, Node, Slot, TimeStep
from idm_env.scalar.regions import Regions
from idm_env.scalar.source import _FORMS, Constants

_CHOICES = {
    "relu": "choose({0} < 0.0, 0.0, {0})", "clamp_min": "choose({0} < {1}, {1}, {0})",
    "clamp_max": "choose({0} > {1}, {1}, {0})", "maximum": "choose({0} > {1}, {0}, {1})",
    "minimum": "choose({0} < {1}, {0}, {1})", "select": "choose({0}, {1}, {2})",
    "sign": "choose({0} > 0.0, 1.0, choose({0} < 0.0, -1.0, 0.0))",
}  # fmt: skip
"""Choices as calls of ``choose(condition, a, b)``: branches would cost numba seconds to compile."""

Read = Callable[[Slot], str]
"""How an input is read: an expression."""


class Straight:
    """Prints several lists of writes (name, node) that share what depends on parameters alone."""

    def __init__(self, graph: Regions, read: Read) -> None:
        self._graph, self._read = graph, read
        self.varying = Constants()
        self._prefix, self._calls = "t", True
        self._kept: dict[Node, str] = {}

    def lines(self, writes: Sequence[tuple[str, Node]], prefix: str = "t", *, calls: bool = True) -> list[str]:
        """Return lines that compute and write what changes with every step.

        Names begin with ``prefix``: a name that is set once in a function costs its compiler much less. ``calls``
        writes choices as calls, which compile quicker and run slower than branches.
        """
        self._prefix, self._calls = prefix, calls
        live = self._live([node for _, node in writes], stop=True)
        for node in live:
            if self._is_kept(node) and node not in self._kept:
                self._kept[node] = f"c{self._graph.serial[node]}"
        names: dict[Node, str] = dict(self._kept)
        made = self._print([n for n in live if n not in self._kept], names)
        return [*made, *(f"{place} = {self._name(node, names)}" for place, node in writes)]

    def constants(self) -> list[str]:
        """Return lines that compute what the printed lines need of parameters alone; call it last."""
        wanted = list(self._kept)
        names: dict[Node, str] = {}
        self._prefix, self._calls = "u", True
        return self._print(self._live(wanted, stop=False), names, self._kept)

    def loads(self) -> list[str]:
        """Return lines that name what depends on the time step, from an array ``k``; call it last."""
        return [f"k{i} = k[{i}]" for i in range(len(self.varying.values))]

    @staticmethod
    def _is_kept(node: Node) -> bool:
        return node.level < DYNAMIC and node.op not in ("constant", "input") and not node.boolean

    def _live(self, outputs: Sequence[Node], stop: bool) -> list[Node]:
        seen: set[Node] = set()
        stack = list(outputs)
        while stack:
            node = stack.pop()
            if node in seen:
                continue
            seen.add(node)
            if not (stop and self._is_kept(node)):
                stack += node.args
        return sorted(seen, key=self._graph.serial.__getitem__)

    def _print(self, live: list[Node], names: dict[Node, str], fixed: dict[Node, str] | None = None) -> list[str]:
        graph, lines, note = self._graph, [], ""
        inside: dict[int, list[str]] = {}
        merges: dict[int, list[Node]] = {}
        for node in live:
            if node.op == "merge":
                assert isinstance(node.label, int)
                merges.setdefault(node.label, []).append(node)
        done: set[int] = set()
        for node in live:
            if node.op == "merge":
                region = node.label
                assert isinstance(region, int)
                if region in done:
                    continue
                done.add(region)
                same = merges[region]
                for m in same:
                    names[m] = (fixed or {}).get(m, f"{self._prefix}{graph.serial[m]}")
                lines += [f"{names[m]} = {self._name(m.args[2], names)}" for m in same]
                block = inside.get(region, [])
                block = [*block, *(f"{names[m]} = {self._name(m.args[1], names)}" for m in same)]
                lines += [f"if {self._name(node.args[0], names)}:  # {block_note(node)}", *(f"    {x}" for x in block)]
                continue
            if node.op in ("constant", "input") or node.boolean:
                continue
            target = inside.setdefault(graph.region[node], []) if node in graph.region else lines
            if node.note != note and target is lines:
                note = node.note
                lines.append(f"# {note or 'motion'}")
            text = self._text(node, names)
            names[node] = (fixed or {}).get(node, f"{self._prefix}{graph.serial[node]}")
            target.append(f"{names[node]} = {text}")
        # Of a region that only fixes constants nothing is merged.
        for region, block in inside.items():
            if region not in done:
                lines += [f"if {self._name(graph.guards[region], names)}:", *(f"    {x}" for x in block)]
        return lines

    def _name(self, node: Node, names: dict[Node, str]) -> str:
        if node in names:
            return names[node]
        if node.op == "constant":
            assert isinstance(node.label, float)
            if isinstance(node.label, TimeStep):
                return f"k{self.varying.index(node.label)}"
            return repr(float(node.label)) if node.label >= 0 else f"({float(node.label)!r})"
        if node.op == "input":
            assert isinstance(node.label, Slot)
            return self._read(node.label)
        assert node.boolean, node
        return f"({self._text(node, names)})"

    def _text(self, node: Node, names: dict[Node, str]) -> str:
        arguments = [self._name(a, names) for a in node.args]
        if node.op == "past":
            return f"h[max(now - int({arguments[0]}), 0), {node.label}]"
        if node.op == "table":
            return f"curve(p, {node.label}, tables, {arguments[0]})"
        form = (_CHOICES.get(node.op) if self._calls else None) or _FORMS[node.op]
        return form.format(*arguments, zero="0.0", one="1.0")


def block_note(node: Node) -> str:
    """Return the effect that a merge belongs to."""
    return node.args[1].note or node.note
