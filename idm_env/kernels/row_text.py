"""Operations of torch on single numbers as the text of ``rows``, and loops around them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

UNARY = {
    "reciprocal": "(F(1.0) / {0})",
    "neg": "(-{0})",
    "abs": "abs({0})",
    "sqrt": "np.sqrt({0})",
    "exp": "np.exp({0})",
    "log": "np.log({0})",
    "sin": "np.sin({0})",
    "cos": "np.cos({0})",
    "relu": "larger({0}, F(0))",
    "tanh": "np.tanh({0})",
    "logical_not": "(not {0})",
    "bitwise_not": "(not {0})",
}
BINARY = {
    "add": "({0} + {1})",
    "sub": "({0} - {1})",
    "rsub": "({1} - {0})",
    "mul": "({0} * {1})",
    "div": "({0} / {1})",
    "minimum": "smaller({0}, {1})",
    "maximum": "larger({0}, {1})",
    "pow": "({0} ** {1})",
    "bitwise_and": "({0} and {1})",
    "bitwise_or": "({0} or {1})",
    "logical_and": "({0} and {1})",
    "logical_or": "({0} or {1})",
}
COMPARE = {
    "lt": "({0} < {1})",
    "le": "({0} <= {1})",
    "gt": "({0} > {1})",
    "ge": "({0} >= {1})",
    "eq": "({0} == {1})",
    "ne": "({0} != {1})",
}
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


def body(lines: Sequence[str]) -> str:
    """Return lines as the body of the loop over rows."""
    return "\n".join("        " + line for line in lines or ["pass"]) + "\n"
