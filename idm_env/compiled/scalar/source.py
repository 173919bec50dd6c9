"""Graphs printed as loops over the vehicles of a workspace: straight-line code that LLVM turns into vector code.

A workspace ``w`` is one flat array of rows; a row is named in capitals in the printed text. Constants come from an
array ``k`` of the state's precision, because a Python literal would promote float32 to float64; so a printed text does
not depend on their values. Everything is read before anything is chosen, and choices are plain selections.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from idm_env.compiled.scalar.graph import Leaf, Node, ordered


class Write(NamedTuple):
    """Where a result goes: the text of its place, and whether it is added to what is there."""

    place: str
    node: Node
    adds: bool = False


@dataclass
class Constants:
    """Constants of all loops of one text, in the order in which they were met."""

    values: list[float] = field(default_factory=list)

    def index(self, value: float) -> int:
        """Return the place of a constant in ``k``."""
        for i, constant in enumerate(self.values):
            if constant == value and type(constant) is type(value) and str(constant) == str(value):
                return i
        self.values.append(value)
        return len(self.values) - 1


def word(slot: Leaf) -> str:
    """Return a slot as a Python name: ``speed``, ``speed_ahead``, ``speed_behind``, ``idm_time_gap``."""
    name = re.sub(r"\W+", "_", slot.name)
    where = {0: "", 1: "_ahead", -1: "_behind"}.get(slot.shift)
    return name + (
        where if where is not None else f"_ahead_{slot.shift}" if slot.shift > 0 else f"_behind_{-slot.shift}"
    )


def row(slot: Leaf) -> str:
    """Return the name of a slot's row."""
    return word(slot).upper()


_FORMS: dict[str, str] = {"add": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "div": "{0} / {1}", "neg": "-{0}"}
_FORMS |= {"pow": "{0} ** {1}", "abs": "abs({0})", "sqrt": "np.sqrt({0})", "exp": "exp({0})", "expm1": "np.expm1({0})"}
_FORMS |= {"log": "np.log({0})", "log1p": "log1p({0})", "tanh": "tanh({0})", "sin": "np.sin({0})", "cos": "np.cos({0})"}
_FORMS |= {"floor": "np.floor({0})", "detach": "{0}", "sigmoid": "sigmoid({0})"}
_FORMS |= {"relu": "{zero} if {0} < {zero} else {0}", "clamp_min": "{1} if {0} < {1} else {0}"}
_FORMS |= {"clamp_max": "{1} if {0} > {1} else {0}", "maximum": "{0} if {0} > {1} else {1}"}
_FORMS |= {"minimum": "{0} if {0} < {1} else {1}", "select": "{1} if {0} else {2}"}
_FORMS |= {"sign": "{one} if {0} > {zero} else (-{one} if {0} < {zero} else {zero})", "gt": "{0} > {1}"}
_FORMS |= {"ge": "{0} >= {1}", "lt": "{0} < {1}", "le": "{0} <= {1}", "eq": "{0} == {1}", "ne": "{0} != {1}"}
_FORMS |= {"and": "{0} and {1}", "or": "{0} or {1}", "not": "not {0}"}
"""Operation → Python text; every argument is a name, save truth values, which stand where they are used."""

Read = Callable[[Leaf], str]
"""How a slot is read inside the loop."""


class Body(NamedTuple):
    """Lines of one loop's body, the constants that it needs (name → index), and the places that it writes."""

    constants: dict[str, int]
    lines: list[str]


def body(writes: Sequence[Write], read: Read, constants: Constants) -> Body:
    """Return the body of a loop that computes the writes."""
    names: dict[Node, str] = {}
    used: dict[str, int] = {}
    loads: list[str] = []
    lines: list[str] = []
    note = ""

    def constant(value: float) -> str:
        index = constants.index(value)
        used[f"k{index}"] = index
        return f"k{index}"

    for node in ordered([write.node for write in writes]):
        arguments = [names[a] for a in node.args]
        if node.op == "constant":
            assert isinstance(node.label, float)
            names[node] = constant(node.label)
        elif node.op == "input":
            assert isinstance(node.label, Leaf)
            names[node] = word(node.label)
            loads.append(f"{names[node]} = {read(node.label)}")
        elif node.boolean:
            names[node] = f"({_FORMS[node.op].format(*arguments)})"
        else:
            if node.note != note:
                note = node.note
                lines.append(f"# {note or 'motion'}")
            names[node] = f"t{len(names)}"
            form = _FORMS[node.op]
            fixed = {n: constant(v) for n, v in (("zero", 0.0), ("one", 1.0)) if f"{{{n}}}" in form}
            text = form.format(*arguments, **fixed)
            lines.append(f"{names[node]} = {text}")
    for write in writes:
        lines.append(f"{write.place} {'+=' if write.adds else '='} {names[write.node]}")
    return Body(used, [*loads, *lines])


def function(name: str, doc: str, content: Body, compiler: str, arrays: tuple[str, ...] = ("w",)) -> str:
    """Return the text of one phase: a compiled function that loops over ``m`` vehicles."""
    parameters = ", ".join(f"{array}_" for array in arrays)
    text = [f"@{compiler}", f"def {name}({parameters}, m, k_):", f'    """{doc}"""']
    text += [f"    {array} = carray({array}_, SIZE)" for array in (*arrays, "k")]
    text += [f"    {n} = k[{i}]" for n, i in content.constants.items()]
    text += ["    for j in range(m):", *(f"        {line}" for line in content.lines)]
    return "\n".join([*text, ""])


def assignments(pairs: Iterable[tuple[str, object]]) -> str:
    """Return lines ``NAME = value``."""
    return "".join(f"{name} = {value}\n" for name, value in pairs)
