"""Operations of torch on single numbers as the text of ``rows``, and loops around them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

UNARY = {"reciprocal": "(F(1.0) / {0})", "neg": "(-{0})", "abs": "abs({0})", "sqrt": "np.sqrt({0})"}
UNARY |= {"exp": "np.exp({0})", "log1p": "np.log1p({0})", "expm1": "np.expm1({0})", "rsqrt": "(F(1.0) / np.sqrt({0}))"}
UNARY |= {"log": "np.log({0})", "floor": "np.floor({0})", "round": "np.rint({0})", "isinf": "np.isinf({0})"}
UNARY |= {"sin": "np.sin({0})", "cos": "np.cos({0})", "relu": "larger({0}, F(0))", "tanh": "tanh({0})"}
UNARY |= {"logical_not": "(not {0})", "bitwise_not": "(not {0})", "sign": "F(np.sign({0}))", "sgn": "F(np.sign({0}))"}
UNARY |= {"sigmoid": "sigmoid({0})", "tanh of doubles": "np.tanh({0})"}
UNARY |= {"sigmoid of doubles": "(1.0 / (1.0 + np.exp(-{0})))"}
BINARY = {"add": "({0} + {1})", "sub": "({0} - {1})", "rsub": "({1} - {0})", "mul": "({0} * {1})", "div": "({0} / {1})"}
BINARY |= {"minimum": "smaller({0}, {1})", "maximum": "larger({0}, {1})", "pow": "({0} ** {1})"}
BINARY |= {"remainder": "({0} % {1})", "tanh_backward": "({0} * (F(1.0) - {1} * {1}))"}
BINARY |= {"threshold_backward": "({0} if {1} > F(0) else F(0))", "bitwise_and": "({0} and {1})"}
BINARY |= {"bitwise_or": "({0} or {1})", "logical_and": "({0} and {1})", "logical_or": "({0} or {1})"}
COMPARE = {"lt": "({0} < {1})", "le": "({0} <= {1})", "gt": "({0} > {1})", "ge": "({0} >= {1})", "eq": "({0} == {1})"}
COMPARE |= {"ne": "({0} != {1})"}
REDUCE = {
    "sum": ("0", "{0} + {1}", "{0}"),
    "mean": ("0", "{0} + {1}", "{0} / {1}"),
    "amin": ("", "smaller({0}, {1})", "{0}"),
    "amax": ("", "larger({0}, {1})", "{0}"),
    "any": ("False", "{0} or {1}", "{0}"),
    "all": ("True", "{0} and {1}", "{0}"),
}
"""Where a reduction begins (empty: at the first element), how it goes on, and what is done at its end."""


def loops(shape: Sequence[int], line: Callable[[list[str]], str | list[str]]) -> list[str]:
    """Return lines inside loops over a shape; dimensions of one element have none."""
    names = [f"j{k}" if n > 1 else "0" for k, n in enumerate(shape)]
    inner = line(names)
    lines = [inner] if isinstance(inner, str) else inner
    depth = 0
    head = []
    for name, n in zip(names, shape, strict=True):
        if n > 1:
            head.append("    " * depth + f"for {name} in range({n}):")
            depth += 1
    return head + ["    " * depth + text for text in lines]


_ELEMENT = re.compile(r"\b(?:[fdib]|out_\w+)\[U\((\d+|r)[^\[\]]*\]")
"""An element of the workspace or of an output: its text, and where its storage begins."""


_STORAGE = re.compile(r"\b([fdib])\[U\((\d+)")
"""Where an element of the workspace begins, whatever its index is."""

IF = "if "
"""How the line begins after which all else is done in some rows only."""

_NUMBER = re.compile(r"v\d+ = ")
"""A number of a row, with a name of its own."""


class _Group:
    """Loops over one shape that run as one: none reads what another one writes at another element."""

    def __init__(self, head: list[str]) -> None:
        self.head, self.lines = head, list[str]()
        self._written: dict[str, str] = {}
        self._read: dict[str, set[str]] = {}

    def takes(self, line: str) -> bool:
        """Add a line, if that changes nothing."""
        to, value = line.split(" = ", 1)
        read, (target, store) = _elements(value), _elements(to)[0]
        if any(self._written.get(cell, text) != text for text, cell in read):
            return False
        if self._written.get(store, target) != target or self._read.get(store, {target}) != {target}:
            return False
        self._written[store] = target
        for text, cell in read:
            self._read.setdefault(cell, set()).add(text)
        self.lines.append(line)
        return True

    def lets_by(self, line: str) -> bool:
        """Return whether a number of a row may be computed before these loops, though it comes after them."""
        name, value = line.split(" = ", 1)
        word = re.compile(rf"\b{re.escape(name)}\b")
        return not (
            any(store in self._written for _, store in _elements(value)) or any(word.search(x) for x in self.lines)
        )


def _elements(text: str) -> list[tuple[str, str]]:
    """Return elements with the storage that each lies in."""
    return [(m.group(), m.group().split("[")[0] + m.group(1)) for m in _ELEMENT.finditer(text)]


VECTOR = 8
"""Numbers that are computed at once: room in the workspace is taken in such pieces."""
_ONE_LOOP = re.compile(r"for j0 in range\((\d+)\):")
_FIRST = re.compile(r"\b(?:[fdib]|t\d+)\[U\(\d+ \+ j0 \* 1\)\]| if j0 == \d+ else ")
"""An element of the workspace, or of a table, in a loop that begins where its storage does; or which of them it is."""


_UNSAFE = re.compile(r"\[U\([^\]]*\b[fdib]\[|^i\[.* (%|//) ")
"""An index that is an element of the workspace, or a remainder: behind a storage's numbers may lie anything."""


def padded(count: int) -> int:
    """Return how much room so many numbers take in the workspace."""
    return -(-count // VECTOR) * VECTOR


def _in_vectors(head: Sequence[str], line: str, widths: Mapping[str, int]) -> bool:
    """Return whether a loop may compute the room behind its numbers, too: the rest would go one by one."""
    over = _ONE_LOOP.fullmatch(head[0]) if len(head) == 1 else None
    if over is None or int(over[1]) <= VECTOR // 2 or "j0" in _FIRST.sub("", line) or _UNSAFE.search(line):
        return False
    return widths.get(_elements(line.split(" = ")[0])[0][1]) == int(over[1])


def _local(groups: Sequence[tuple[list[str], list[str]]]) -> None:
    """Give names to elements of one loop alone: a name needs no memory."""
    everywhere = Counter("".join(m.groups()) for _, lines in groups for line in lines for m in _STORAGE.finditer(line))
    for head, lines in groups:
        if not head:
            continue
        here = Counter(_elements("\n".join(lines)))
        written = set[str]()
        names = dict[str, str]()
        for line in lines:
            to, value = line.split(" = ", 1)
            text, store = _elements(to)[0]
            single = here[text, store] == everywhere[store] and text[0] != "o"
            if single and store not in written and text not in value:
                names[text] = f"x{store}"
            written.add(store)

        def renamed(element: re.Match[str], names: Mapping[str, str] = names) -> str:
            return names.get(element.group(), element.group())

        lines[:] = [_ELEMENT.sub(renamed, line) for line in lines]


def _statements(lines: Sequence[str]) -> list[list[str]]:
    """Return lines as statements: each begins with a line that is not indented."""
    begins = [i for i, line in enumerate(lines) if not line.startswith(" ")]
    return [list(lines[i:j]) for i, j in pairwise([*begins, len(lines)])]


def fused(parts: Sequence[list[str]], widths: Mapping[str, int] | None = None) -> list[str]:
    """Return loops behind one another; neighbours over one shape as one, where that changes nothing.

    ``widths`` are how many numbers of a row lie in a storage. With them these loops are all there is.
    Then what only one of them needs takes no memory. They fill whole vectors, too.
    """
    groups: list[tuple[list[str], list[str]]] = []
    group: _Group | None = None
    vectors = False

    def close() -> None:
        nonlocal group
        if group is not None:
            groups.append((group.head, group.lines))
            group = None

    for lines in [statement for part in parts for statement in _statements(part)]:
        *head, last = lines
        line = last.strip()
        if group is not None and _NUMBER.match(line) and not head and group.lets_by(line):
            groups.append(([], [line]))
            continue
        plain_loop = head and all(x.strip().startswith("for ") for x in head) and _elements(line.split(" = ")[0])
        if not plain_loop:
            close()
            groups.append(([], lines))
            continue
        whole = widths is not None and _in_vectors(head, line, widths)
        if group is None or group.head != head or whole != vectors or not group.takes(line):
            close()
            group, vectors = _Group(head), whole
            group.takes(line)
    close()
    vectors_of = [
        widths is not None and bool(head) and all(_in_vectors(head, line, widths) for line in lines)
        for head, lines in groups
    ]
    if widths is not None:
        _local(groups)
    text, within = list[str](), ""
    for (head, lines), whole in zip(groups, vectors_of, strict=True):
        if whole:
            head = [_ONE_LOOP.sub(lambda m: f"for j0 in range({padded(int(m[1]))}):", head[0])]
        text += [within + line for line in (*head, *("    " * len(head) + line for line in lines))]
        within = "    " if lines[0].startswith(IF) else within
    return text


def body(lines: Sequence[str]) -> str:
    """Return lines as the body of the loop over rows."""
    return "\n".join("        " + line for line in lines or ["pass"]) + "\n"
