"""Loops over rows of a function with weights, which all rows share: a small network, and its vector-Jacobian product.

As ``rows.py``, with products of a row with a matrix, and with what falls on the weights, which is summed over rows.
Sums may be made in any order (``reassoc``), so results are those of torch to rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from idm_env.kernels.row_text import UNARY, loops
from idm_env.kernels.rows import Place, RowFunction, index, storage
from idm_env.scalar.record import Untraceable


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
    bias: Tensor | None, wanted: Sequence[bool],
) -> tuple[Tensor | None, ...]:  # fmt: skip
    normal = (x - mean) * scale
    own = g if weight is None else g * weight
    on_x = scale * (own - own.mean(-1, keepdim=True) - normal * (own * normal).mean(-1, keepdim=True))
    return on_x, (g * normal).sum([0]) if wanted[1] else None, g.sum([0]) if wanted[2] else None


_ATEN = torch.ops.aten
_SIMPLER: dict[Any, Callable[..., Any]] = {
    _ATEN.elu.default: _elu,
    _ATEN.elu_backward.default: _elu_back,
    _ATEN.silu.default: lambda x: x * torch.sigmoid(x),
    _ATEN.silu_backward.default: _silu_back,
    _ATEN.sigmoid_backward.default: lambda g, y: g * (1.0 - y) * y,
    _ATEN.native_layer_norm.default: _layer_norm,
    _ATEN.native_layer_norm_backward.default: _layer_norm_back,
}
"""What one operation is in terms of simpler ones."""


class PolicyRows(RowFunction):
    """``function(**inputs)``, of which those named in ``shared`` are the same for all rows.

    An output that is a sum over rows lies in one of ``sums``, arrays that are added to: ``summed`` says for each such
    output in which, and shape, strides and offset there.
    """

    options = ', fastmath={"contract", "reassoc"}'
    imports = (
        "from idm_env.kernels.functions import exp_{kind} as exp, sigmoid_{kind} as sigmoid, tanh_{kind} as tanh\n"
    )
    unary = {**UNARY, "exp": "exp({0})", "sigmoid": "sigmoid({0})", "tanh": "tanh({0})"}  # noqa: RUF012
    simpler = _SIMPLER

    def __init__(
        self, function: Callable[..., Mapping[str, Tensor]], inputs: Mapping[str, Tensor], rows: int,
        shared: Sequence[str],
    ) -> None:  # fmt: skip
        self._shared = set(shared)
        self._whole: set[int] = set()
        self.sums: dict[str, int] = {}
        self.summed: dict[str, tuple[str, tuple[int, ...], tuple[int, ...], int]] = {}
        super().__init__(function, inputs, rows, apart=True)

    def _given(self, name: str, x: Tensor) -> None:
        if name not in self._shared:
            super()._given(name, x)
            return
        self._stores[storage(x)] = (f"in_{name}", "0", 0)
        self._whole.add(storage(x))

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
            self._places[id(x)] = Place(array, start, int(x.storage_offset()), tuple(x.stride()), kind)
            return
        super()._view(x, kind)

    def _at(self, x: Any, at: Sequence[str], kind: str | None = None) -> str:
        if not isinstance(x, Tensor) or storage(x) not in self._whole:
            return super()._at(x, at, kind)
        shape = tuple(x.shape)
        while len(shape) > len(at) and shape[0] == 1:
            x, shape = x[0], shape[1:]
        if len(shape) > len(at):
            raise Untraceable("an operation mixes rows")
        lined = ["0" if n == 1 else i for n, i in zip(shape, at[len(at) - len(shape) :], strict=True)]
        return index(self._place(x), lined)

    def _print(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], out: Any) -> None:
        if name in ("t", "transpose") and self._turned(out):
            return
        if name in ("mm", "addmm"):
            self._product(name, args, kwargs, out)
        elif name == "sum" and self._known(args[0]) and self._over_rows(args, kwargs):
            source = args[0]
            to = self._sum(out)
            if out.dim() > 1:
                to = to._replace(strides=to.strides[1:])
            self._parts.append(
                loops(source.shape[1:], lambda at: f"{index(to, at)} = {index(to, at)} + {self._at(source, at)}")
            )
        elif name in ("view", "_unsafe_view", "reshape") and storage(out) in self._whole:
            self._place(out)
        else:
            super()._print(name, args, kwargs, out)

    def _turned(self, x: Tensor) -> bool:
        """Return whether a tensor has its rows last."""
        return self._known(x) and storage(x) not in self._whole and x.dim() == 2 and x.shape[-1] == self._rows

    def _over_rows(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> bool:
        given = args[1] if len(args) > 1 else kwargs.get("dim")
        return storage(args[0]) not in self._whole and list(given or ()) == [0]

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
            rows, to = a.t(), self._sum(x)
            self._parts.append(
                loops(
                    tuple(x.shape),
                    lambda at: f"{index(to, at)} = {index(to, at)} + {self._at(rows, at[:1])} * {self._at(b, at[1:])}",
                )
            )
            return
        if not self._known(a) or storage(a) in self._whole or self._turned(b):
            raise Untraceable(f"{name} of other things than rows and weights")
        to, (inner, width) = self._fresh(x), b.shape
        by_column = self._known(b) and self._place(b).strides[-1] != 1 and inner > 1
        at = "j0" if width > 1 else "0"
        first = self._at(args[0], [at], "f") if name == "addmm" else "F(0.0)"
        k = "k" if inner > 1 else "0"
        times = f"{self._at(a, [k])} * {self._weight(b, k, at)}"
        loop = [f"for {at} in range({width}):"] if width > 1 else []
        deep = "    " if loop else ""
        if by_column or width == 1:
            lines = [*loop, f"{deep}s = {first}"]
            lines += (
                [f"{deep}for k in range({inner}):", f"{deep}    s += {times}"] if inner > 1 else [f"{deep}s += {times}"]
            )
            self._parts.append([*lines, f"{deep}{index(to, [at])} = s"])
            return
        self._parts.append([*loop, f"{deep}{index(to, [at])} = {first}"])
        outer = [f"for k in range({inner}):"] if inner > 1 else []
        far = "    " if outer else ""
        lines = [*outer, f"{far}s = {self._at(a, [k])}", *(far + line for line in loop)]
        self._parts.append([*lines, f"{far}{deep}{index(to, [at])} += s * {self._weight(b, k, at)}"])

    def _weight(self, b: Tensor, k: str, at: str) -> str:
        if not self._known(b):
            return self._at(b, [k, at])
        return index(self._place(b), [k, at])
