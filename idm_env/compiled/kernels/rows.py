"""A function of tensors in torch, recorded once and printed as one loop over its rows: values only, on the CPU.

Tasks say in torch what agents command, see and earn. On a row of 22 vehicles each of those operations takes a
microsecond to start and a nanosecond to do; so the operations that one call performs are recorded as torch performs
them (``TorchDispatchMode``), for a number of rows that is no other dimension, and printed with plain indices in place
of views. Whatever does not depend on the inputs is a constant.
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from idm_env.compat import Uncompiled
from idm_env.compiled.kernels.memory import addresses
from idm_env.compiled.kernels.row_text import BINARY, COMPARE, IF, REDUCE, UNARY, VECTOR, body, fused, loops, padded
from idm_env.compiled.scalar import library
from idm_env.compiled.scalar.record import Untraceable
from idm_env.types import recording

_TEXT = {"f": "F", "d": "np.float64", "i": "np.int64", "b": "np.bool_"}
KINDS = {torch.float32: "f", torch.float64: "f", torch.int64: "i", torch.bool: "b"}
TYPES = {"d": np.dtype(np.float64), "i": np.dtype(np.int64), "b": np.dtype(np.bool_)}
"""Types of numbers beside those of the recording; ``d`` are doubles in a recording in single precision."""
_BLANK = {"new_zeros": 0.0, "zeros_like": 0.0, "zeros": 0.0, "new_ones": 1.0, "ones_like": 1.0, "empty_like": 0.0}
_BLANK |= {"new_empty_strided": 0.0}
_FULL = {"new_full": 2, "full_like": 1, "full": 1, "fill_": 1}
"""Constants of one value, which backward passes write to: the value, or the place of the argument that it is."""

HEADER = '''"""Printed by idm_env from one call of a task's functions; see compiled/kernels/rows.py. Delete at will."""

import numpy as np
from numba import carray, types

from idm_env.compiled.kernels.emitted import emitted
from idm_env.compiled.kernels.memory import located

F, U = np.{kind}, np.uint64
SIZE = (1 << 40,)
{imports}

@emitted(types.void(types.int64, types.int64, types.CPointer(types.int64)){options})
def run(begin, end, at):
{arguments}    f, d = np.empty({f}, F), np.empty({d}, np.float64)
    i, b = np.empty({i}, np.int64), np.empty({b}, np.bool_)
{around}'''


_AT_ONCE = 16
"""Numbers that a sort compares at once."""


class Place(NamedTuple):
    """Where a recorded tensor lies: ``array[start + Σ index · stride]``, or a local name without strides."""

    array: str
    start: str
    offset: int
    strides: tuple[int, ...]
    kind: str


def _clamped(x: Tensor, low: Any = None, high: Any = None) -> Tensor:
    for end, bound in ((torch.maximum, low), (torch.minimum, high)):
        if bound is not None:
            x = end(x, torch.as_tensor(bound, dtype=torch.float64 if isinstance(bound, float) else None))
    return x


def _index_added(x: Tensor, dim: int, which: Tensor, source: Tensor) -> Tensor:
    shape = [-1 if d == dim % x.dim() else 1 for d in range(x.dim())]
    return x.scatter_add(dim, which.view(shape).expand(source.shape), source)


def _select_back(on: Tensor, sizes: Sequence[int], dim: int, i: int) -> Tensor:
    whole: Tensor = torch.ops.aten.slice_backward(on.unsqueeze(dim), sizes, dim, i, i % sizes[dim] + 1, 1)
    return whole


SIMPLER: dict[str, Callable[..., Any]] = {
    "clamp": _clamped,
    "clamp_min": _clamped,
    "clamp_max": lambda x, high: _clamped(x, None, high),
    "masked_fill": lambda x, mask, value: torch.where(mask, value, x),
    "index_add": _index_added,
    "stack": lambda parts, dim=0: torch.cat([x.unsqueeze(dim) for x in parts], dim),
    "select_backward": _select_back,
    "sigmoid_backward": lambda on, y: on * (1.0 - y) * y,
}
"""What one operation is in terms of simpler ones."""


class _Recorder(Uncompiled, TorchDispatchMode):
    """Keeps every operation with its inputs and its results."""

    def __init__(self, simpler: Mapping[str, Callable[..., Any]]) -> None:
        super().__init__()
        self._simpler = SIMPLER | dict(simpler)
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any], Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func._schema.name.removeprefix("aten::")
        plain = name.removesuffix("_") if _in_place(name) else name
        if plain in self._simpler:
            with self:
                result = self._simpler[plain](*args, **(kwargs or {}))
                return result if plain == name else args[0].copy_(result)
        if torch.Tag.nondeterministic_seeded in func.tags:
            raise Untraceable(f"chance ({func._schema.name})")
        out = func(*args, **(kwargs or {}))
        self.calls.append((name, args, kwargs or {}, out))
        return out


def recorded(
    function: Callable[..., Mapping[str, Tensor]],
    inputs: Mapping[str, Tensor],
    simpler: Mapping[str, Callable[..., Any]],
) -> tuple[list[tuple[str, tuple[Any, ...], dict[str, Any], Any]], dict[str, Tensor]]:
    """Return the operations of one call of a function of tensors of any shape, and its result.

    Raises:
        Untraceable: For a function that draws random numbers.
    """
    with torch.no_grad(), recording(), _Recorder(simpler) as recorder:
        results = dict(function(**inputs))
    return recorder.calls, results


class RowFunction:
    """``function(**inputs)`` as compiled loops; it returns a dict of tensors, each with the rows first.

    ``inputs`` are examples with ``rows`` rows each. ``needs`` are the names of those that are read, and ``outs`` of
    those that are filled: in this order, behind what is ``fixed``, ``call`` takes their addresses. ``shapes`` and
    ``types`` are those of the outputs, without rows. ``pitches`` are distances from row to row of outputs that do not
    lie one behind another. Outputs that are ``seldom`` read are filled only where an input or output ``when`` is true.

    Raises:
        Untraceable: For an operation that is not known here, or mixes rows.
    """

    options, unary = "", UNARY
    imports = "from idm_env.compiled.kernels.functions import sigmoid_{kind} as sigmoid, tanh_{kind} as tanh\n"
    """How it is compiled, what is imported for that, and operations on single numbers."""
    around = "    for r in range(begin, end):\n"
    """The loop over rows."""
    lean = True
    """Whether every element of the workspace stands in the text as such."""
    simpler: Mapping[str, Callable[..., Any]] = {}
    """What stands for an operation, by its name in torch, beside ``SIMPLER``."""

    def __init__(
        self, function: Callable[..., Mapping[str, Tensor]], inputs: Mapping[str, Tensor], rows: int, *,
        pitches: Mapping[str, int] | None = None, seldom: Sequence[str] = (), when: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self._rows, self._pitches = rows, pitches or {}
        self._places: dict[int, Place] = {}
        self._noted: list[Tensor] = []
        self._stores: dict[int, tuple[str, str, int]] = {}
        self._room = {"f": 0, "d": 0, "i": 0, "b": 0}
        self._constants: dict[float, int] = {}
        self._tables: list[np.ndarray] = []
        self._table_of: dict[int, str] = {}
        self._parts: list[list[str]] = []
        operations, results = recorded(function, inputs, self.simpler)
        self._floats = next(x.dtype for x in (*inputs.values(), *results.values()) if x.is_floating_point())
        self._loads: dict[int, list[str]] = {}
        self._widths: dict[str, int] = {}
        for name, x in inputs.items():
            self._given(name, x)
        self._blanks: dict[int, float] = {}
        for called, args, _, out in operations:
            if called in _BLANK:
                self._blanks[storage(out)] = _BLANK[called]
            elif called in _FULL:
                self._blanks[storage(out)] = args[_FULL[called]]
        _refuse_forks(operations, list(inputs.values()))
        calls = _needed(operations, list(results.values()))
        self._calls = calls
        self._results: dict[Any, int] = {}
        self._written = {storage(x) for name, _, _, out in calls if _in_place(name) for x in tensors((out,))}
        read = {storage(x) for _, args, _, _ in calls for x in tensors(args)} | {storage(x) for x in results.values()}
        read |= {storage(inputs[n]) for n in when if n in inputs}
        self._parts += [lines for where, lines in self._loads.items() if where in read]
        # What is written in place is read in the order of the recording.
        ordered = [x for _, args, _, out in calls if self._reads_written(args) for x in tensors((out,))]
        often = set(map(id, _needed(operations, [*ordered, *(x for n, x in results.items() if n not in seldom)])))
        for call in calls:
            if id(call) in often:
                self._print(*call)
        moving = {name: x for name, x in results.items() if self._by_row(name, x)}
        self.shapes = {name: tuple(x.shape[1:]) for name, x in moving.items()}
        kinds = {name: self._kind(x) for name, x in moving.items()}
        real = np.dtype(np.float32 if self._floats == torch.float32 else np.float64)
        self.types = {name: TYPES.get(kind, real) for name, kind in kinds.items()}
        for name in [n for n in moving if n not in seldom]:
            self._parts.append(self._tell(name, moving[name], kinds[name]))
        if rest := [n for n in moving if n in seldom]:
            tensor_of = {**inputs, **results}
            self._parts.append([f"{IF}{' or '.join(self._at(tensor_of[n], []) for n in when)}:"])
            for call in calls:
                if id(call) not in often:
                    self._print(*call)
            self._parts += [self._tell(n, moving[n], kinds[n]) for n in rest]
        lines = fused(self._parts, self._widths if self.lean else None)
        lines = self._first(lines) + lines
        text = "\n".join(lines)
        self.needs = [name for name in inputs if re.search(rf"\bin_{name}\b", text)]
        self.outs = list(moving)
        typed: list[tuple[str, str]] = [("c", "f")]
        typed += [(f"t{k}", x.dtype.kind) for k, x in enumerate(self._tables)]
        typed += [(f"in_{n}", self._kind(inputs[n])) for n in self.needs]
        typed += [(f"out_{n}", kinds[n]) for n in moving]
        typed += [(n, "f") for n in self._more()]
        arguments = "".join(
            f"    {n} = carray(located(at[{k}], {_TEXT[kind]}), SIZE)\n" for k, (n, kind) in enumerate(typed)
        )
        # By a name of its own a constant is no memory that the loops might write to.
        arguments += "".join(f"    c{k} = c[{k}]\n" for k in range(len(self._constants) if self.lean else 0))
        room = {kind: max(1, size) for kind, size in self._room.items()}
        # Loops go on to a whole number of vectors: of numbers that nobody wrote LLVM may take any branch, or none.
        rest = [f"    {w[0]}[{int(w[1:]) + k}] = 0\n" for w, n in self._widths.items() for k in range(n, padded(n))]
        around = "".join(rest) + self.around
        parts = {"options": self.options, "imports": self.imports.format(kind=real.name), "around": around}
        header = HEADER.format(kind=real.name, arguments=arguments, **parts, **room)
        self._held = [np.array(list(self._constants) or [0.0], real), *self._tables]
        self.fixed = addresses(self._held)
        self._noted.clear()
        """Addresses that every call begins with."""
        self.call: int = library.load("rows", header + body(lines)).run.address
        """Address of the loops: (first row, row behind the last, addresses of arrays that hold row after row)."""

    @cached_property
    def run(self) -> Callable[[int, int, int], None]:
        """The loops: (first row, row behind the last, address of a ``table``). They run without the interpreter."""
        return ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)(self.call)

    def table(self, arrays: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the addresses for a call, from arrays by name; those that are missing are 0."""
        names = (*self.needs, *self.outs, *self._more())
        return np.concatenate((self.fixed, addresses([arrays.get(n) for n in names])))

    def place(self, name: str) -> int:
        """Return where in the table the address of an input or an output stands."""
        return len(self.fixed) + (*self.needs, *self.outs, *self._more()).index(name)

    def _given(self, name: str, x: Tensor) -> None:
        """Enter an input."""
        width = x.untyped_storage().nbytes() // x.element_size() // self._rows
        if not self.lean or x.dim() > 2 or 1 < width <= VECTOR // 2:
            self._keep(x, f"in_{name}", f"r * {width}", width, self._kind(x))
            return
        to, lies = self._fresh(x), Place(f"in_{name}", f"r * {width}", 0, (1,) * (x.dim() - 1), "")
        self._loads[storage(x)] = self._each(to, x.shape[1:], lambda cell: index(lies, cell))

    def _tell(self, name: str, x: Tensor, kind: str) -> list[str]:
        """Print how an output is filled."""
        strides = tuple(math.prod(x.shape[k + 1 :]) for k in range(1, x.dim()))
        pitch = self._pitches.get(name, math.prod(x.shape[1:]))
        to = Place(f"out_{name}", f"r * {pitch}", 0, strides, kind)
        return self._each(to, x.shape[1:], lambda cell: self._at(x, cell))

    def _first(self, lines: Sequence[str]) -> list[str]:
        """Return what comes before lines that were printed."""
        return []

    def _loops(self, shape: Sequence[int], line: Callable[[list[str]], str | list[str]]) -> list[str]:
        return loops(shape, line)

    def _each(self, to: Place, shape: Sequence[int], value: Callable[[list[str]], str]) -> list[str]:
        """Print what every element of a tensor becomes."""
        return self._loops(shape, lambda cell: f"{index(to, cell)} = {value(cell)}")

    def _by_row(self, name: str, x: Tensor) -> bool:
        """Return whether an output has a value for every row."""
        return True

    def _more(self) -> list[str]:
        """Return the names of arrays that are filled beside the outputs."""
        return []

    # -- where tensors lie -----------------------------------------------------------------------------------------

    def _kind(self, x: Tensor) -> str:
        if x.dtype not in KINDS:
            raise Untraceable(f"a tensor of {x.dtype}")
        return "d" if x.dtype == torch.float64 != self._floats else KINDS[x.dtype]

    def _keep(self, x: Tensor, array: str, start: str, width: int, kind: str) -> None:
        self._stores[storage(x)] = (array, start, width)
        self._view(x, kind)

    def _known(self, x: Tensor) -> bool:
        """Return whether a tensor depends on the inputs."""
        return storage(x) in self._stores

    def _place(self, x: Tensor) -> Place:
        """Return where a known tensor lies; autograd keeps other tensors of the same memory."""
        if id(x) not in self._places:
            self._view(x, self._kind(x))
        return self._places[id(x)]

    def _view(self, x: Tensor, kind: str) -> None:
        """Enter a tensor that looks into a known storage."""
        array, start, width = self._stores[storage(x)]
        if x.dim() == 0 or x.shape[0] != self._rows or x.stride(0) != width or x.storage_offset() >= max(width, 1):
            raise Untraceable("an operation mixes rows")
        self._enter(x, Place(array, start, int(x.storage_offset()), tuple(x.stride()[1:]), kind))

    def _enter(self, x: Tensor, place: Place) -> None:
        """Note where a tensor lies; it is held, or another one might have its id."""
        self._noted.append(x)
        self._places[id(x)] = place

    def _fresh(self, x: Tensor) -> Place:
        """Give a result its place: a local name for one number a row, else a part of the workspace."""
        kind, width = self._kind(x), x.untyped_storage().nbytes() // x.element_size() // self._rows
        if width == 1:
            self._keep(x, f"v{len(self._places)}", "", 1, kind)
        else:
            self._keep(x, kind, str(self._room[kind]), width, kind)
            self._widths[f"{kind}{self._room[kind]}"] = width
            self._room[kind] += padded(width)
        return self._places[id(x)]

    def _plain(self, x: Tensor) -> np.ndarray:
        """Return a constant, without rows."""
        if x.dim() and x.shape[0] == self._rows:
            if not bool(((x == x[:1]) | (x != x)).all()):
                raise Untraceable("a constant differs by row")
            x = x[0]
        return x.detach().cpu().numpy()

    def _number(self, value: float | int | bool, kind: str) -> str:
        if kind == "f":
            key = float(value)
            if key != key:
                return "F(np.nan)"
            which = self._constants.setdefault(key, len(self._constants))
            return f"c{which}" if self.lean else f"c[{which}]"
        if kind == "d":
            return f"np.float64({float(value)!r})" if math.isfinite(value) else f"np.float64(np.{float(value)!r})"
        return str(bool(value)) if kind == "b" else str(int(value))

    def _at(self, x: Any, cell: Sequence[str], kind: str | None = None) -> str:
        """Return the text of one element; ``at`` are the indices behind the row, to which ``x`` broadcasts."""
        if not isinstance(x, Tensor):
            return self._number(x, kind or ("f" if isinstance(x, float) else "i"))
        own = self._kind(x)
        kind = kind or own
        place = self._place(x) if self._known(x) else None
        if place is None:
            values = self._plain(x)
            # A table of one number is that number: LLVM makes no vector code of a choice between two arrays.
            if values.size and values.tobytes() == values.reshape(-1)[:1].tobytes() * values.size:
                return self._number(values.reshape(-1)[0].item(), kind)
            shape, place = values.shape, self._table(x, values)
        else:
            shape = tuple(x.shape[1:])
        if len(shape) > len(cell):
            raise Untraceable("an operation mixes rows")
        lined = ["0" if n == 1 else i for n, i in zip(shape, cell[len(cell) - len(shape) :], strict=True)]
        text = index(place, lined)
        return text if kind == own else f"{_TEXT[kind]}({text})"

    def _table(self, x: Tensor, values: np.ndarray) -> Place:
        if id(x) not in self._table_of:
            self._noted.append(x)
            self._table_of[id(x)] = f"t{len(self._tables)}"
            real = values.astype(np.float32 if self._floats == torch.float32 else np.float64)
            flat = real if self._kind(x) == "f" else values
            # Loops over whole vectors read on behind it.
            self._tables.append(np.concatenate((flat.reshape(-1), np.zeros(VECTOR, flat.dtype))))
        strides = tuple(math.prod(values.shape[k + 1 :]) for k in range(values.ndim))
        return Place(self._table_of[id(x)], "0", 0, strides, self._kind(x))

    # -- operations ------------------------------------------------------------------------------------------------

    def _print(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> None:
        if name in _BLANK or name in _FULL or not any(self._known(x) for x in tensors(args)):
            return
        if name == "sort":
            self._parts.append(self._sorted(args, kwargs, out))
            return
        inplace = _in_place(name)
        for x in out if isinstance(out, (list, tuple)) else (out,):
            if inplace:
                name = name.removesuffix("_")
                if not self._known(x):
                    self._began(x)
                to = self._place(x)
            elif self._known(x):
                self._place(x)
                continue
            else:
                if x.dim() == 0 or x.shape[0] != self._rows:
                    raise Untraceable(f"{name} mixes rows")
                if self.lean and self._computed(name, args, kwargs, x):
                    continue
                to = self._fresh(x)
            self._parts.append(self._compute(name, args, kwargs, x, to))

    def _computed(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any], x: Tensor) -> bool:
        """Give a result the place of one that is the same operation of the same numbers; False for the first one."""

        def mark(part: Any) -> Any:
            if isinstance(part, (list, tuple)):
                return tuple(map(mark, part))
            if not isinstance(part, Tensor):
                return repr(part)
            one = part[0] if part.dim() and part.stride(0) == 0 else part
            lies = self._stores.get(storage(part)) or one.detach().cpu().numpy().tobytes()
            return part.dtype, part.shape, part.stride(), part.storage_offset(), lies

        if self._reads_written((x, *args)):
            return False
        key = name, mark(args), mark(tuple(kwargs.items())), x.shape, x.stride()
        first = self._results.setdefault(key, storage(x))
        if first != storage(x):
            self._stores[storage(x)] = self._stores[first]
            self._place(x)
        return first != storage(x)

    def _reads_written(self, args: Sequence[Any]) -> bool:
        return any(storage(x) in self._written for x in tensors(args))

    def _began(self, x: Tensor) -> None:
        """Give a constant of one value, that is written to now, a place."""
        value = self._blanks.get(storage(x))
        if value is None or x.dim() == 0 or x.shape[0] != self._rows:
            raise Untraceable("a constant is written to")
        to = self._fresh(x)
        self._parts.append(self._each(to, x.shape[1:], lambda cell: self._number(value, to.kind)))

    def _compute(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], x: Tensor, to: Place) -> list[str]:
        shape = tuple(x.shape[1:])
        if name == "slice_backward":
            return self._spread(args, shape, to)
        if name == "gather":
            return self._gathered(args, shape, to)
        if name in ("scatter", "scatter_add", "scatter_reduce"):
            return self._scattered(name, args, kwargs, shape, to)
        if name == "copy":
            name, args = "clone", args[1:]
        if name in self.unary or name in ("_to_copy", "clone"):
            form = self.unary.get(f"{name}{' of doubles' if to.kind == 'd' else ''}") or self.unary.get(name, "{0}")
            kind = None if name == "isinf" else to.kind
            return self._each(to, shape, lambda cell: form.format(self._at(args[0], cell, kind)))
        if name in BINARY or name in COMPARE:
            kind = to.kind if name in BINARY else self._common(args)
            form = BINARY.get(name) or COMPARE[name]
            if kwargs.get("alpha", 1) != 1 or (name == "div" and kwargs.get("rounding_mode")):
                raise Untraceable(f"{name} with alpha")
            if name == "pow" and not isinstance(args[1], Tensor) and args[1] in (1, 2, 3):
                form = f"({' * '.join(['{0}'] * int(args[1]))})"
            return self._each(to, shape, lambda cell: form.format(*(self._at(a, cell, kind) for a in args)))
        if name == "where":
            c, y, n = args
            return self._each(
                to,
                shape,
                lambda cell: f"{self._at(y, cell, to.kind)} if {self._at(c, cell)} else {self._at(n, cell, to.kind)}",
            )
        if name in REDUCE:
            return self._reduce(name, args, kwargs, x, to)
        if name == "cat":
            return self._joined(args, x, to)
        if name in ("flip", "roll"):
            by = {d % x.dim() - 1: s for s, d in zip(args[1], args[-1], strict=True)}
            if -1 in by or not by:
                raise Untraceable(f"{name} mixes rows")
            form = "({} - {{}})" if name == "flip" else "(({{}} + {}) % {})"
            moved = [
                form.format(n - 1 if name == "flip" else -by[k] % n, n) if k in by else "{}"
                for k, n in enumerate(shape)
            ]
            return self._each(to, shape, lambda cell: self._at(args[0], list(map(str.format, moved, cell))))
        if name == "searchsorted":
            return self._searched(args, kwargs, x, to)
        if name == "cumsum":
            return self._cumsum(args, x, to)
        if name in ("index", "index_select"):
            return self._picked(name, args, x, to)
        raise Untraceable(f"operation {name}")

    def _common(self, args: Sequence[Any]) -> str:
        kinds = [self._kind(a) if isinstance(a, Tensor) else "f" if isinstance(a, float) else "i" for a in args]
        return next(kind for kind in "dfib" if kind in kinds)

    def _reduce(self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any], x: Tensor, to: Place) -> list[str]:
        source = args[0]
        axis = args[1] if len(args) > 1 else kwargs.get("dim")
        dims = range(source.dim()) if axis is None else [axis] if isinstance(axis, int) else axis
        gone = {d % source.dim() for d in dims or range(source.dim())}
        if 0 in gone:
            raise Untraceable(f"{name} mixes rows")
        first, update, last = REDUCE[name]
        keeps_dim = len(x.shape) == source.dim()

        def line(cell: list[str]) -> list[str]:
            own = iter(cell)
            full = (
                [f"k{d}" if d in gone else next(own) for d in range(1, source.dim())]
                if not keeps_dim
                else [f"k{d}" if d in gone else cell[d - 1] for d in range(1, source.dim())]
            )
            element = self._at(source, full, "b" if to.kind == "b" else to.kind)
            start = first or self._at(source, ["0" if i.startswith("k") else i for i in full])
            lines = [f"s = {start if start != '0' or to.kind != 'f' else 'F(0.0)'}"]
            for depth, d in enumerate(sorted(gone)):
                lines.append("    " * depth + f"for k{d} in range({source.shape[d]}):")
            lines.append("    " * len(gone) + "s = " + update.format("s", element))
            count = self._number(math.prod(source.shape[d] for d in gone), "f")
            return [*lines, f"{index(to, cell)} = " + last.format("s", count)]

        return self._loops(x.shape[1:], line)

    def _joined(self, args: Sequence[Any], x: Tensor, to: Place) -> list[str]:
        dim = (args[1] if len(args) > 1 else 0) % x.dim() - 1
        if dim < 0:
            raise Untraceable("cat mixes rows")
        lines, done = [], 0
        for part in args[0]:

            def line(cell: list[str], part: Tensor = part, done: int = done) -> str:
                target = [f"({done} + {j})" if k == dim else j for k, j in enumerate(cell)]
                return f"{index(to, target)} = {self._at(part, cell, to.kind)}"

            lines += self._loops(part.shape[1:], line)
            done += part.shape[dim + 1]
        return lines

    def _cumsum(self, args: Sequence[Any], x: Tensor, to: Place) -> list[str]:
        dim = args[1] % x.dim() - 1
        if dim != x.dim() - 2:
            raise Untraceable("cumsum over another dimension than the last")

        def line(cell: list[str]) -> list[str]:
            every = [*cell, "k"]
            lines = [f"s = {self._number(0, to.kind)}", f"for k in range({x.shape[-1]}):"]
            return [*lines, f"    s = s + {self._at(args[0], every, to.kind)}", f"    {index(to, every)} = s"]

        return self._loops(x.shape[1:-1], line)

    def _spread(self, args: Sequence[Any], shape: tuple[int, ...], to: Place) -> list[str]:
        """Print zeros with a part of them filled: what falls on the whole from a slice."""
        source, sizes, dim, *ends, step = args
        k = dim % len(sizes) - 1
        if k < 0:
            raise Untraceable("slice_backward mixes rows")
        begin, end = (min(x + shape[k] if x < 0 else x, shape[k]) for x in ends)
        zero, many = self._number(0, to.kind), len(range(begin, end, step))
        if many == 1:

            def chosen(cell: list[str]) -> str:
                own = [("0" if j == k else i) for j, i in enumerate(cell)]
                return f"{index(to, cell)} = {self._at(source, own, to.kind)} if {cell[k]} == {begin} else {zero}"

            return self._loops(shape, chosen)
        lines = self._each(to, shape, lambda cell: zero)
        part = [many if j == k else n for j, n in enumerate(shape)]

        def line(cell: list[str]) -> str:
            target = [f"({begin} + {i} * {step})" if j == k else i for j, i in enumerate(cell)]
            return f"{index(to, target)} = {self._at(source, cell, to.kind)}"

        return [*lines, *self._loops(part, line)]

    def _gathered(self, args: Sequence[Any], shape: tuple[int, ...], to: Place) -> list[str]:
        """Print ``source.gather(dim, which)``."""
        source, dim, which = args[:3]
        along = dim % source.dim() - 1
        if along < 0:
            raise Untraceable("gather of rows")

        def line(cell: list[str]) -> list[str]:
            # In two lines: loops that look elsewhere are not fused.
            target = ["k" if d == along else i for d, i in enumerate(cell)]
            return [f"k = {self._at(which, cell)}", f"{index(to, cell)} = {self._at(source, target, to.kind)}"]

        return self._loops(shape, line)

    def _scattered(
        self, name: str, args: Sequence[Any], kwargs: Mapping[str, Any], shape: tuple[int, ...], to: Place
    ) -> list[str]:
        """Print ``x.scatter(dim, which, source)``, or with what was there added to it, or the larger or smaller one."""
        x, dim, which, source = args[:4]
        along = dim % x.dim() - 1
        form = {"scatter": "{1}", "scatter_add": "{0} + {1}"}.get(name) or REDUCE.get(str(args[-1]), ("", ""))[1]
        if along < 0 or kwargs or not form or (len(args) > 4) != (name == "scatter_reduce"):
            raise Untraceable(f"{name} of rows, or with another reduction")

        def line(cell: list[str]) -> list[str]:
            target = index(to, ["k" if d == along else i for d, i in enumerate(cell)])
            value = form.format(target, self._at(source, cell, to.kind))
            return [f"k = {self._at(which, cell)}", f"{target} = {value}"]

        first = self._each(to, shape, lambda cell: self._at(x, cell, to.kind))
        return [*first, *self._loops(which.shape[1:], line)]

    def _searched(self, args: Sequence[Any], kwargs: Mapping[str, Any], x: Tensor, to: Place) -> list[str]:
        """Print ``torch.searchsorted(keys, values)``: by halves."""
        keys, values = args[:2]
        if len(args) > 2 or set(kwargs) - {"right"} or keys.dim() != values.dim():
            raise Untraceable("searchsorted that is not of every row's own keys")
        form = COMPARE["le" if kwargs.get("right") else "lt"]

        def line(cell: list[str]) -> list[str]:
            kind = self._common(args)
            before = form.format(self._at(keys, [*cell[:-1], "k"], kind), self._at(values, cell, kind))
            lines = ["n = 0", f"h = {keys.shape[-1]}", "while n < h:", "    k = (n + h) // 2"]
            lines += [f"    n = k + 1 if {before} else n", f"    h = h if {before} else k"]
            return [*lines, f"{index(to, cell)} = n"]

        return self._loops(x.shape[1:], line)

    def _sorted(self, args: Sequence[Any], kwargs: Mapping[str, Any], out: Sequence[Tensor]) -> list[str]:
        """Print the first of ``x.sort(stable=True)``, as many as are read: of equals the one that came first."""
        x, (values, slots) = args[0], out
        if not kwargs.get("stable") or kwargs.get("descending") or kwargs.get("dim", -1) % x.dim() != x.dim() - 1:
            raise Untraceable("a sort that is not stable, descends, or is of another dimension than the last")
        first, second, count = self._fresh(values), self._fresh(slots), x.shape[-1]
        most = min(count, self._read_of(slots))

        def line(cell: list[str]) -> list[str]:
            def put(to: Place, k: str) -> str:
                return index(to, [*cell, k])

            def insert(j: str, k: str) -> list[str]:
                lines = [f"s = {self._at(x, [*cell, j])}", f"k = {k}"]
                lines += [f"while k > 0 and s < {put(first, '(k - 1)')}:"]
                lines += [f"    {put(each, 'k')} = {put(each, '(k - 1)')}" for each in (first, second)]
                return [*lines, "    k -= 1", f"{put(first, 'k')} = s", f"{put(second, 'k')} = {j}"]

            def deeper(lines: list[str], by: int) -> list[str]:
                return ["    " * by + x for x in lines]

            # Hardly any belongs to the first: many are compared at once, and looked at only where one does.
            sooner = f"{self._at(x, [*cell, 'j'])} < {put(first, str(most - 1))}"
            some = f"for j in range(h, min(h + {_AT_ONCE}, {count})):"
            lines = [f"for j in range({most}):", *deeper(insert("j", "j"), 1)]
            lines += [f"for h in range({most}, {count}, {_AT_ONCE}):", "    n = 0", f"    {some}"]
            lines += [f"        n = n + np.int64({sooner})", "    if n > 0:", f"        {some}"]
            return [*lines, f"            if {sooner}:", *deeper(insert("j", str(most - 1)), 4)]

        return self._loops(x.shape[1:-1], line)

    def _read_of(self, slots: Tensor) -> int:
        """Return how many of the last dimension's numbers are read, from the first on."""
        ends = []
        for name, args, _, _ in self._calls:
            if any(storage(x) == storage(slots) and x.shape == slots.shape for x in tensors(args)):
                first = name == "slice" and args[1] % slots.dim() == slots.dim() - 1 and args[2] == 0
                ends.append(args[3] if first else slots.shape[-1])
        return max(ends, default=1)

    def _picked(self, name: str, args: Sequence[Any], x: Tensor, to: Place) -> list[str]:
        """Print ``source[index, …]``: rows of a table by recorded indices, or columns by constant ones."""
        source = args[0]
        if name == "index_select":
            dim = args[1] % source.dim() - 1
            if dim < 0 or self._known(args[2]):
                raise Untraceable("index_select of rows")
            return self._each(
                to,
                x.shape[1:],
                lambda cell: self._at(source, [self._at(args[2], [j]) if k == dim else j for k, j in enumerate(cell)]),
            )
        parts = args[1]
        if self._known(source) or any(p is None for p in parts) or len({p.dim() for p in parts}) > 1:
            raise Untraceable("an index into what changes")
        values, own = source.detach().cpu().numpy(), parts[0].dim() - 1
        table = self._table(source, values)
        return self._each(
            to, x.shape[1:], lambda cell: index(table, [*(self._at(p, cell[:own]) for p in parts), *cell[own:]])
        )


def _in_place(name: str) -> bool:
    """Return whether an operation writes to its first argument."""
    return name.endswith("_") and not name.endswith("__")


def storage(x: Tensor) -> int:
    """Return what tells the memory of a tensor of any shape from that of others."""
    return x.untyped_storage().data_ptr()


def tensors(args: Sequence[Any]) -> list[Tensor]:
    """Return the tensors, of any shape, among arguments and within lists of them."""
    return [x for a in args for x in (a if isinstance(a, (list, tuple)) else (a,)) if isinstance(x, Tensor)]


def _refuse_forks(calls: Sequence[Any], inputs: Sequence[Tensor]) -> None:
    """Raise Untraceable where Python has asked for a number that depends on inputs: it may have chosen by it."""
    dependent = {storage(x) for x in inputs}
    for name, args, _, out in calls:
        if any(storage(x) in dependent for x in tensors(args)):
            if name == "_local_scalar_dense":
                raise Untraceable("a fork on values")
            dependent |= {storage(x) for x in tensors((out,))}


def _needed(calls: Sequence[Any], results: Sequence[Tensor]) -> list[Any]:
    """Return the calls on which some results depend."""
    storages, needs = {storage(x) for x in results}, []
    for call in reversed(calls):
        outputs = call[3] if isinstance(call[3], (list, tuple)) else (call[3],)
        if any(storage(x) in storages for x in outputs if isinstance(x, Tensor)):
            storages |= {storage(x) for x in tensors(call[1])}
            needs.append(call)
    return needs[::-1]


def adjoint(
    function: Callable[..., Mapping[str, Tensor]], outputs: Sequence[str], by: Sequence[str]
) -> Callable[..., dict[str, Tensor]]:
    """Return the vector-Jacobian product of a function, by torch: to be recorded in its place.

    It takes what the function takes and, as ``on_NAME``, what falls on each of the ``outputs``; it returns what falls
    on the inputs ``by``, of those on which anything does; each has the shape of its output or input.
    """

    def back(**leaves: Tensor) -> dict[str, Tensor]:
        with torch.enable_grad():
            own = {n: x.detach().requires_grad_() if n in by else x for n, x in leaves.items() if n[:3] != "on_"}
            out = function(**own)
            names = [n for n in outputs if n in out and out[n].requires_grad]
            if not names:
                return {}
            # With a graph of its own autograd writes nothing in place that is still read.
            end = _End.apply([leaves[f"on_{n}"] for n in names], *(out[n] for n in names))
            gradients = torch.autograd.grad(end, [own[n] for n in by], create_graph=True, allow_unused=True)
        return {n: g.detach() for n, g in zip(by, gradients, strict=True) if g is not None}

    return back


class _End(torch.autograd.Function):
    """Where what falls on outputs comes from. Given to torch itself it would import sympy, to compare shapes."""

    @staticmethod
    def forward(ctx: Any, seeds: list[Tensor], *outputs: Tensor) -> Tensor:
        ctx.seeds = seeds
        return seeds[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, on: Tensor) -> Any:  # type: ignore[override]
        return None, *ctx.seeds


def index(place: Place, cell: Sequence[str]) -> str:
    """Return the text of an element: a local name, or an array with its index."""
    if place.start == "":
        return place.array
    terms = [f"{i} * {s}" for i, s in zip(cell, place.strides, strict=True) if i != "0" and s]
    # Without a sign: numba would ask of every other index whether it counts from the end, and nothing would vectorise.
    return f"{place.array}[U({' + '.join([place.start, *([str(place.offset)] if place.offset else []), *terms])})]"
