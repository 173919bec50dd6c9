"""Loops over rows of a function with weights, which all rows share: a small network, and its vector-Jacobian product.

As ``rows.py``, with products of a row with a matrix, and with what falls on the weights, which is summed over rows.
Sums may be made in any order (``reassoc``), so results are those of torch to rounding.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from idm_env.compiled.kernels.dense import PITCH, ROWS
from idm_env.compiled.kernels.row_text import BINARY, COMPARE, UNARY, loops
from idm_env.compiled.kernels.rows import Place, RowFunction, index, storage, tensors
from idm_env.compiled.scalar.record import Untraceable


def _elu(x: Tensor, alpha: float = 1.0, scale: float = 1.0, inner: float = 1.0) -> Tensor:
    return torch.where(x > 0.0, x * scale, torch.expm1(x * inner) * (alpha * scale))


def _elu_back(g: Tensor, alpha: float, scale: float, inner: float, is_result: bool, x: Tensor) -> Tensor:
    if is_result:
        raise Untraceable("ELU in place")
    return torch.where(x > 0.0, g * scale, g * (inner * alpha * scale) * torch.exp(x * inner))


def _silu_back(g: Tensor, x: Tensor) -> Tensor:
    s = torch.sigmoid(x)
    return g * s * (1.0 + x * (1.0 - s))


def _layer_norm(
    x: Tensor, shape: Sequence[int], weight: Tensor | None, bias: Tensor | None, eps: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``w (x − m)/√(s² + ε) + b``, m and 1/√(s² + ε)."""
    if len(shape) != 1:
        raise Untraceable("a layer norm over several dimensions")
    apart = x - x.mean(-1, keepdim=True)
    mean, scale = x.mean(-1, keepdim=True), ((apart * apart).mean(-1, keepdim=True) + eps).rsqrt()
    out = apart * scale
    out = out if weight is None else out * weight
    return out if bias is None else out + bias, mean, scale


def _layer_norm_back(
    g: Tensor, x: Tensor, shape: Sequence[int], mean: Tensor, scale: Tensor, weight: Tensor | None,
    bias: Tensor | None, needs: Sequence[bool],
) -> tuple[Tensor | None, ...]:  # fmt: skip
    normal = (x - mean) * scale
    own = g if weight is None else g * weight
    on_x = scale * (own - own.mean(-1, keepdim=True) - normal * (own * normal).mean(-1, keepdim=True))
    rows = list(range(g.dim() - 1))
    return on_x, (g * normal).sum(rows) if needs[1] else None, g.sum(rows) if needs[2] else None


_SIMPLER: dict[str, Callable[..., Any]] = {
    "elu": _elu,
    "elu_backward": _elu_back,
    "silu": lambda x: x * torch.sigmoid(x),
    "silu_backward": _silu_back,
    "native_layer_norm": _layer_norm,
    "native_layer_norm_backward": _layer_norm_back,
}
"""What one operation is in terms of simpler ones."""


class PolicyRows(RowFunction):
    """``function(**inputs)``, of which those named in ``shared`` are the same for all rows.

    Rows may be several agents each: a tensor ``(rows · agents, …)`` is one ``(rows, agents, …)``. Numbers of a
    block of rows lie side by side, so every loop over rows is one over vectors. An output that is a sum over rows
    lies in one of ``sums``, arrays that are added to: ``summed`` says for each such output in which, and shape,
    strides and offset there.
    """

    options = ', fastmath={"contract", "reassoc"}'
    imports = (
        f"{RowFunction.imports}from idm_env.compiled.kernels.dense import dense, outer\n"
        "from idm_env.compiled.kernels.functions import exp_{kind} as exp\n"
    )
    around = (
        f"    for first in range(begin, end, {PITCH}):\n"
        f"        count = min({PITCH}, end - first)\n"
        f"        m = (count + {ROWS - 1}) // {ROWS} * {ROWS}\n"
    )
    unary = {**UNARY, "exp": "exp({0})"}  # noqa: RUF012
    simpler, lean = _SIMPLER, False

    def __init__(
        self,
        function: Callable[..., Mapping[str, Tensor]],
        inputs: Mapping[str, Tensor],
        rows: int,
        shared: Sequence[str],
    ) -> None:
        self._shared = set(shared)
        self._whole: set[int] = set()
        self._read: dict[str, tuple[Tensor, Place]] = {}
        self._used: set[int] = set()
        self.sums: dict[str, int] = {}
        self.summed: dict[str, tuple[str, tuple[int, ...], tuple[int, ...], int]] = {}
        super().__init__(function, inputs, rows)

    # -- where tensors lie -----------------------------------------------------------------------------------------

    def _given(self, name: str, x: Tensor) -> None:
        if name in self._shared:
            self._stores[storage(x)] = (f"in_{name}", "0", 0)
            self._whole.add(storage(x))
        else:
            self._read[name] = (x, self._fresh(x))

    def _fresh(self, x: Tensor) -> Place:
        kind, width = self._kind(x), x.untyped_storage().nbytes() // x.element_size() // self._rows
        self._keep(x, kind, f"{self._room[kind]} + r", width, kind)
        self._room[kind] += width * PITCH
        return self._places[id(x)]

    def _first(self, lines: Sequence[str]) -> list[str]:
        """Print how blocks of inputs are read, rows last; what lies beyond the last row is 0."""
        loads: list[str] = []
        for name, (x, place) in self._read.items():
            if storage(x) in self._used:
                to, width = f"{place.array}[U({place.start} + j * {PITCH})]", x.numel() // self._rows
                loads += [f"for j in range({width}):", "    for r in range(count):"]
                loads += [f"        {to} = in_{name}[U((first + r) * {width} + j)]"]
                loads += ["    for r in range(count, m):", f"        {to} = 0"]
        return loads

    def _tell(self, name: str, x: Tensor, kind: str) -> list[str]:
        strides = tuple(math.prod(x.shape[k + 1 :]) for k in range(1, x.dim()))
        to = Place(f"out_{name}", f"(first + r) * {math.prod(x.shape[1:])}", 0, strides, kind)
        return self._loops(x.shape[1:], lambda cell: f"{index(to, cell)} = {self._at(x, cell)}", "count")

    def _loops(self, shape: Sequence[int], line: Callable[[list[str]], str | list[str]], many: str = "m") -> list[str]:
        """Return loops over a shape and the rows of a block; what is the same for all rows is read before them."""

        def inner(cell: list[str]) -> list[str]:
            text = line(cell)
            lines, held = [text] if isinstance(text, str) else text, dict[str, str]()
            for i, each in enumerate(lines):
                for same in _SHARED.findall(each):
                    held.setdefault(same, f"h{len(held)}")
                    each = each.replace(same, held[same])
                lines[i] = each
            first = [f"{name} = {same}" for same, name in held.items()]
            return [*first, f"for r in range({many}):", *("    " + each for each in lines)]

        return loops(shape, inner)

    def _by_row(self, name: str, x: Tensor) -> bool:
        if storage(x) not in self._whole:
            return True
        array = self._stores[storage(x)][0]
        if array not in self.sums:
            raise Untraceable("a weight is what comes out")
        self.summed[name] = (array, tuple(x.shape), tuple(x.stride()), int(x.storage_offset()))
        return False

    def _more(self) -> list[str]:
        return list(self.sums)

    def _view(self, x: Tensor, kind: str) -> None:
        if storage(x) in self._whole:
            array, start, _ = self._stores[storage(x)]
            self._enter(x, Place(array, start, int(x.storage_offset()), tuple(x.stride()), kind))
            return
        super()._view(x, kind)
        place = self._places[id(x)]
        strides = tuple(s * PITCH for s in place.strides)
        self._enter(x, place._replace(offset=place.offset * PITCH, strides=strides))

    def _number(self, value: float | int | bool, kind: str) -> str:
        # From a table: a number that a policy changes from window to window is no reason to compile it anew.
        plain = kind == "f" and value in (0.0, 1.0, -1.0)
        return f"F({float(value)!r})" if plain else super()._number(value, kind)

    def _at(self, x: Any, cell: Sequence[str], kind: str | None = None) -> str:
        if not isinstance(x, Tensor):
            return super()._at(x, cell, kind)
        self._used.add(storage(x))
        if storage(x) not in self._whole:
            return super()._at(x, cell, kind)
        shape = tuple(x.shape)
        while len(shape) > len(cell) and shape[0] == 1:
            x, shape = x[0], shape[1:]
        if len(shape) > len(cell):
            raise Untraceable("an operation mixes rows")
        lined = ["0" if n == 1 else i for n, i in zip(shape, cell[len(cell) - len(shape) :], strict=True)]
        return index(self._place(x), lined)

    # -- operations ------------------------------------------------------------------------------------------------

    def _print(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> None:
        if name in ("t", "transpose") and self._turned(out):
            return
        sources = tensors(args)
        if any(self._known(x) for x in sources) and any(self._split(x) is not x for x in (*sources, *tensors((out,)))):
            args, out = self._apart(name, args, out)
        if name in ("mm", "addmm"):
            self._product(name, args, kwargs, out)
        elif name == "sum" and self._known(args[0]) and self._over_rows(args, kwargs):
            self._total(args[0], set(args[1]), out)
        elif name in ("view", "_unsafe_view", "reshape") and storage(out) in self._whole:
            self._place(out)
        else:
            super()._print(name, args, kwargs, out)

    def _split(self, x: Any) -> Any:
        """Return a tensor of all agents behind one another with agents as its second dimension, others as they are."""
        agents, more = divmod(x.shape[0] if isinstance(x, Tensor) and x.dim() else 0, self._rows)
        if more or agents < 2 or storage(x) in self._whole:
            return x
        try:
            return x.view(self._rows, agents, *x.shape[1:])
        except RuntimeError as error:
            raise Untraceable("agents that do not lie one behind another") from error

    def _apart(self, name: str, args: tuple[Any, ...], out: Any) -> tuple[tuple[Any, ...], Any]:
        """Return the arguments and results of an operation, with agents as the second dimension."""
        plain = name.removesuffix("_")
        arguments = [[self._split(y) for y in x] if isinstance(x, (list, tuple)) else self._split(x) for x in args]
        split: Any = [self._split(y) for y in out] if isinstance(out, (list, tuple)) else self._split(out)
        if plain in _ALONG and len(args) > 1:
            dims = [args[1]] if isinstance(args[1], int) else args[1]
            where = [d for each in dims for d in ((0, 1) if each == 0 else (each + (each > 0),))]
            arguments[1] = where[0] if isinstance(args[1], int) else where
        if plain in _SPREAD:
            arguments[1:3] = tuple(split.shape), args[2] + (args[2] > 0)
        views = all(self._known(x) for x in tensors((out,))) and not name.endswith("_")
        if not (views or plain in {*_ALONG, *_SPREAD, *_EACH, *self.unary}):
            raise Untraceable(f"{name} of agents one behind another")
        return tuple(arguments), split

    def _total(self, source: Tensor, gone: set[int], out: Tensor) -> None:
        """Print a sum over rows, and over other dimensions."""
        self._sum(out)
        left = [d for d in range(1, source.dim()) if d not in gone]
        shape = [source.shape[d] for d in left]
        to, inner = self._place(out.view(shape)), sorted(gone - {0})

        def line(cell: list[str]) -> list[str]:
            own = dict(zip(left, cell, strict=True))
            element = self._at(source, [own.get(d, f"k{d}") for d in range(1, source.dim())])
            heads = [*(f"for k{d} in range({source.shape[d]}):" for d in inner), "for r in range(m):"]
            lines = ["    " * i + head for i, head in enumerate(heads)]
            return ["s = F(0.0)", *lines, "    " * len(heads) + f"s = s + {element}", f"{index(to, cell)} += s"]

        self._parts.append(loops(shape, line))

    def _reduce(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any], x: Tensor, to: Place) -> list[str]:
        """Print a sum or a mean over the last dimension, which is added to for all rows at once."""
        source = args[0]
        dims = args[1] if len(args) > 1 else kwargs.get("dim")
        if name not in ("sum", "mean") or [d % source.dim() for d in dims or ()] != [source.dim() - 1]:
            return super()._reduce(name, args, kwargs, x, to)
        keeps_dim = x.dim() == source.dim()
        shape = x.shape[1:-1] if keeps_dim else x.shape[1:]
        count = self._number(source.shape[-1] if name == "mean" else 1, "f")
        own = to._replace(strides=to.strides[:-1]) if keeps_dim else to

        def lines(cell: list[str]) -> list[str]:
            target = index(own, cell)
            lines = ["for r in range(m):", f"    {target} = F(0.0)", f"for k in range({source.shape[-1]}):"]
            lines += ["    for r in range(m):", f"        {target} = {target} + {self._at(source, [*cell, 'k'])}"]
            return [*lines, "for r in range(m):", f"    {target} = {target} / {count}"]

        return loops(shape, lines)

    def _turned(self, x: Tensor) -> bool:
        """Return whether a tensor has its rows last."""
        if not self._known(x) or storage(x) in self._whole or x.dim() != 2:
            return False
        return x.shape[-1] > 0 and x.shape[-1] % self._rows == 0

    def _over_rows(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> bool:
        return storage(args[0]) not in self._whole and len(args) > 1 and 0 in (args[1] or ())

    def _sum(self, x: Tensor) -> Place:
        """Give a sum over rows its array."""
        name = f"sum{len(self.sums)}"
        self.sums[name] = x.untyped_storage().nbytes() // x.element_size()
        self._stores[storage(x)] = (name, "0", 0)
        self._whole.add(storage(x))
        return self._place(x)

    def _product(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any], x: Tensor) -> None:
        """Print a product of two matrices: of every row with weights, or of all rows with each other."""
        if kwargs:
            raise Untraceable(f"{name} with {', '.join(kwargs)}")
        a, b = args[-2:]
        if self._turned(a):
            to, (tall, wide) = self._sum(x), x.shape
            for left, right in zip(self._columns(a.t()), self._columns(b), strict=True):
                sides = f"{left}, {tall}, {right}, {wide}"
                self._parts.append([f"outer({to.array}, {to.offset}, {to.strides[0]}, {to.strides[1]}, f, {sides}, m)"])
            return
        to, (deep, wide) = self._fresh(x), b.shape
        if not self._known(b):
            by = self._table(b, self._plain(b))
        elif storage(b) in self._whole:
            by = self._place(b)
        else:
            raise Untraceable(f"{name} of other things than rows and weights")
        first = args[0] if name == "addmm" else 0.0
        self._parts.append(self._each(to, x.shape[1:], lambda cell: self._at(first, cell, "f")))
        for own, other in zip(self._columns(x), self._columns(a), strict=True):
            sides = f"{own}, {wide}, {other}, {deep}, {by.array}, {by.offset}"
            self._parts.append([f"dense(f, {sides}, {by.strides[1]}, {by.strides[0]}, m)"])

    def _columns(self, x: Tensor) -> list[str]:
        """Return the first place of a matrix of rows, and the distance of its columns; of every agent's."""
        x = self._split(x)
        if not self._known(x):
            x = self._constant(x)
        if storage(x) in self._whole or self._turned(x):
            raise Untraceable("a product of other things than rows")
        self._used.add(storage(x))
        place = self._place(x)
        first, (*between, apart) = int(place.start.removesuffix(" + r")) + place.offset, place.strides
        agents = range(x.shape[1]) if between else (0,)
        return [f"{first + i * between[0] if between else first}, {apart}" for i in agents]

    def _constant(self, x: Tensor) -> Tensor:
        """Return a constant that is the same for all rows as numbers of theirs."""
        values, copied = self._table(x, self._plain(x)), x.contiguous().clone()
        to = self._fresh(copied)
        self._parts.append(self._each(to, x.shape[1:], lambda cell: index(values, cell)))
        return copied


_SHARED = re.compile(r"\b(?:in_\w+|t\d+|c)\[[^\[\]]*\]")
"""An element of what is the same for all rows."""

_ALONG, _SPREAD = ("sum", "mean", "cat"), ("slice_backward",)
_EACH = {*BINARY, *COMPARE, "where", "clone", "_to_copy", "mm", "addmm"}
"""Operations that are told a dimension by its number, and others that all agents may do at once."""
