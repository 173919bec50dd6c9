"""A graph with regions printed as straight-line Python for rows of drivers (``kernels.emitted.inlined``).

What depends on parameters alone is printed apart (``constants``), into an array ``c``, before the loop over time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from idm_env.compiled.scalar.graph import DYNAMIC, Leaf, Node, TimeStep
from idm_env.compiled.scalar.regions import Regions
from idm_env.compiled.scalar.source import _FORMS, Constants

Read = Callable[[Leaf], str]
"""How an input is read: an expression."""


class Straight:
    """Prints several lists of writes (name, node) that share what depends on parameters alone."""

    def __init__(self, graph: Regions, read: Read) -> None:
        self._graph, self._read = graph, read
        self.varying = Constants()
        self._cells: dict[Node, str] = {}

    @property
    def kept(self) -> int:
        """Numbers in ``c``."""
        return len(self._cells)

    def lines(self, writes: Sequence[tuple[str, Node]]) -> list[str]:
        """Return lines that compute and write what changes with every step."""
        live = self._live([node for _, node in writes], stop=True)
        for node in live:
            if self._is_fixed(node) and node not in self._cells:
                self._cells[node] = f"c[{len(self._cells)}]"
        names: dict[Node, str] = dict(self._cells)
        text = self._print([n for n in live if n not in self._cells], names)
        return [*text, *(f"{place} = {self._name(node, names)}" for place, node in writes)]

    def constants(self) -> list[str]:
        """Return lines that compute what the printed lines need of parameters alone; call it last."""
        return self._print(self._live(list(self._cells), stop=False), {}, self._cells)

    def leaves(self, outputs: Sequence[Node], flags: Collection[str]) -> set[Leaf]:
        """Return the inputs that outputs depend on where only these flags are not 0."""

        def read(node: Node) -> tuple[Node, ...]:
            is_off = node.op == "merge" and node.args[0].label.name not in flags  # type: ignore[union-attr]
            return node.args[2:] if is_off else node.args

        return {node.label for node in _reached(outputs, read) if isinstance(node.label, Leaf)}

    @staticmethod
    def _is_fixed(node: Node) -> bool:
        return node.level < DYNAMIC and node.op not in ("constant", "input") and not node.boolean

    def _live(self, outputs: Sequence[Node], stop: bool) -> list[Node]:
        reached = _reached(outputs, lambda node: () if stop and self._is_fixed(node) else node.args)
        return sorted(reached, key=self._graph.serial.__getitem__)

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
                block = inside.get(region, [])
                for m in merges[region]:
                    outside, within = (self._name(m.args[k], names) for k in (2, 1))
                    names[m] = name = (fixed or {}).get(m, f"t{graph.serial[m]}")
                    lines.append(f"{name} = {outside}")
                    block = [*block, f"{name} = {within}"]
                guard = self._name(node.args[0], names)
                lines += [f"if {guard}:  # {block_note(node)}", *(f"    {x}" for x in block)]
                continue
            if node.op in ("constant", "input") or node.boolean:
                continue
            target = inside.setdefault(graph.region[node], []) if node in graph.region else lines
            if node.note != note and target is lines:
                note = node.note
                lines.append(f"# {note or 'motion'}")
            text = self._text(node, names)
            names[node] = (fixed or {}).get(node, f"t{graph.serial[node]}")
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
                return f"k[{self.varying.index(node.label)}]"
            return constant_text(node.label)
        if node.op == "input":
            assert isinstance(node.label, Leaf)
            return self._read(node.label)
        assert node.boolean, node
        return f"({self._text(node, names)})"

    def _text(self, node: Node, names: dict[Node, str]) -> str:
        arguments = [self._name(a, names) for a in node.args]
        if node.op == "past":
            return f"recall(h, now, {arguments[0]}, {node.label}, index[LANE])"
        if node.op == "table":
            return f"curve(phi, index[DRIVER], {node.label}, tables, {arguments[0]})"
        if node.op == "pow":
            return f"power({arguments[0]}, {arguments[1]})"
        return _FORMS[node.op].format(*arguments, zero="0.0", one="1.0")


def _reached(outputs: Sequence[Node], read: Callable[[Node], Sequence[Node]]) -> set[Node]:
    """Return outputs and all nodes below them; ``read`` gives the arguments of each."""
    seen: set[Node] = set()
    stack = list(outputs)
    while stack:
        node = stack.pop()
        if node not in seen:
            seen.add(node)
            stack += read(node)
    return seen


def constant_text(value: float) -> str:
    """Return a constant as Python text, in which infinity and NaN have no names."""
    text = repr(float(value)).replace("inf", "1e999").replace("nan", "1e999 - 1e999")
    return text if value >= 0 else f"({text})"


def block_note(node: Node) -> str:
    """Return the effect that a merge belongs to."""
    return node.args[1].note or node.note
