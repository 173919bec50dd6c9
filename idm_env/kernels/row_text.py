"""Operations of torch on single numbers as the text of ``rows``, and loops around them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

UNARY = {
    "reciprocal": "(F(1.0) / {0})", "neg": "(-{0})", "abs": "abs({0})", "sqrt": "np.sqrt({0})",
    "exp": "np.exp({0})", "expm1": "np.expm1({0})", "rsqrt": "(F(1.0) / np.sqrt({0}))", "log": "np.log({0})",
    "floor": "np.floor({0})", "round": "np.rint({0})", "isinf": "np.isinf({0})", "sin": "np.sin({0})",
    "cos": "np.cos({0})", "relu": "larger({0}, F(0))", "tanh": "np.tanh({0})", "logical_not": "(not {0})",
    "bitwise_not": "(not {0})", "sign": "F(np.sign({0}))", "sgn": "F(np.sign({0}))",
}  # fmt: skip
BINARY = {
    "add": "({0} + {1})", "sub": "({0} - {1})", "rsub": "({1} - {0})", "mul": "({0} * {1})", "div": "({0} / {1})",
    "minimum": "smaller({0}, {1})", "maximum": "larger({0}, {1})", "pow": "({0} ** {1})",
    "remainder": "({0} % {1})", "tanh_backward": "({0} * (F(1.0) - {1} * {1}))",
    "threshold_backward": "({0} if {1} > F(0) else F(0))", "bitwise_and": "({0} and {1})",
    "bitwise_or": "({0} or {1})", "logical_and": "({0} and {1})", "logical_or": "({0} or {1})",
}  # fmt: skip
COMPARE = {
    "lt": "({0} < {1})", "le": "({0} <= {1})", "gt": "({0} > {1})", "ge": "({0} >= {1})", "eq": "({0} == {1})",
    "ne": "({0} != {1})",
}  # fmt: skip
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


def fused(parts: Sequence[list[str]]) -> list[str]:
    """Return loops behind one another; neighbours over one shape as one, where that changes nothing."""
    text: list[str] = []
    group: _Group | None = None

    def close() -> None:
        nonlocal group
        if group is not None:
            text.extend(group.head)
            text.extend("    " * len(group.head) + line for line in group.lines)
            group = None

    for lines in parts:
        *head, last = lines
        line = last.strip()
        if group is not None and _NUMBER.match(line) and not head and group.lets_by(line):
            text.append(line)
            continue
        plain_loop = head and all(x.strip().startswith("for ") for x in head) and _elements(line.split(" = ")[0])
        if not plain_loop:
            close()
            text.extend(lines)
        elif group is None or group.head != head or not group.takes(line):
            close()
            group = _Group(head)
            group.takes(line)
    close()
    return text


def body(lines: Sequence[str]) -> str:
    """Return lines as the body of the loop over rows."""
    return "\n".join("        " + line for line in lines or ["pass"]) + "\n"
