"""A step on a GPU: torch's own operations, recorded once as a CUDA graph and replayed, so that no launch is waited for.

What is recorded is the function that every step is (``idm_env.envs.moves``), and torch's derivative of it.
"""

from __future__ import annotations

import warnings
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from idm_env.compat import forward_mode, transforming, tree_flatten
from idm_env.jobs.storage import lacks_memory
from idm_env.types import recording

Maybe = Tensor | None


def recorded(run: Callable[[], None]) -> Callable[[], None]:
    """Return what repeats all that ``run`` does on the GPU; its tensors stay where they are."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        run()  # libraries load, and take their memory, before a graph is recorded
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph.replay


class Replayed:
    """A pure function of trees of tensors, which is recorded where its arguments have a new form and then replayed.

    A gradient is computed from the arguments of its call alone: nothing of the step between is kept for it. A function
    that cannot be recorded, as one that asks a tensor for its value, is called as it is, and a warning says so once.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._forms: dict[Any, _Form] | None = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is recorded: a copy records anew."""
        return {"_function": self._function, "_forms": {}}

    def __call__(self, *arguments: Any) -> Any:
        """Return what the function returns: new tensors, and arguments that it passes on."""
        if self._forms is None or transforming() or forward_mode() or torch.compiler.is_compiling():
            return self._function(*arguments)
        leaves, tree = tree_flatten(arguments)
        tensors = [x for x in leaves if isinstance(x, Tensor)]
        needs = tuple(torch.is_grad_enabled() and x.requires_grad for x in tensors)
        others = tuple(None if isinstance(x, Tensor) else (x,) for x in leaves)
        key = tree, others, needs, tuple((x.shape, x.dtype) for x in tensors)
        try:
            form = self._forms.get(key) or self._forms.setdefault(key, _Form(self._function, tree, leaves, needs))
        except RuntimeError as why:
            if lacks_memory(why):
                raise
            self._forms, reason = None, str(why).splitlines()[0].rstrip(".")
            warnings.warn(f"no CUDA graph of a step, which takes about ten times as long: {reason}.", stacklevel=6)
            return self._function(*arguments)
        results = _Recorded.apply(form, *tensors) if any(needs) else form.forward(tensors)  # type: ignore[no-untyped-call]
        return form.tree_of(tensors, results)


class _Form:
    """A function of tensors alone: the tensors it reads and writes, and what repeats it and its derivative."""

    def __init__(self, function: Callable[..., Any], tree: Any, leaves: list[Any], needs: tuple[bool, ...]) -> None:
        self._function, self._tree, self._needs = function, tree, needs
        self._leaves = [None if isinstance(x, Tensor) else x for x in leaves]
        self._places = [i for i, x in enumerate(leaves) if isinstance(x, Tensor)]
        self._inputs = [leaves[i].detach().clone() for i in self._places]
        self._last: list[tuple[Any, int]] = [(None, 0)] * len(self._inputs)
        self._prepare()
        self._run = recorded(self._step)
        if any(self.differ):
            gradients = self.derivative(self._fresh(), self._slopes, False)
            self._gradients = [None if x is None else torch.zeros_like(x) for x in gradients]
            self._run_back = recorded(self._step_back)

    def _fresh(self) -> list[Tensor]:
        """Return the arguments as leaves of a new graph: none of another stream may reach into a recording."""
        return [x.detach().requires_grad_(n) for x, n in zip(self._inputs, self._needs, strict=True)]

    def _prepare(self) -> None:
        """Look which results are new tensors, which are arguments, and which differ with the arguments."""
        tensors = self._fresh()
        with torch.set_grad_enabled(any(self._needs)):
            results, self._results_tree = self._call(tensors)
        same = {id(x): i for i, x in enumerate(tensors)}
        self._arguments = [same.get(id(x)) for x in results]
        self._others = [None if isinstance(x, Tensor) else x for x in results]
        self._new = [i for i, x in enumerate(results) if isinstance(x, Tensor) and id(x) not in same]
        self.differ = [bool(results[i].requires_grad) for i in self._new]
        self._outputs = [results[i].detach().clone() for i in self._new]
        self._slopes = [torch.zeros_like(x) if d else None for x, d in zip(self._outputs, self.differ, strict=True)]

    def _call(self, tensors: Sequence[Tensor]) -> tuple[list[Any], Any]:
        """Return the results of these tensors, and the form of their tree."""
        leaves = list(self._leaves)
        for place, x in zip(self._places, tensors, strict=True):
            leaves[place] = x
        with recording():
            return tree_flatten(self._function(*self._tree.unflatten(leaves)))

    @torch.no_grad()
    def _step(self) -> None:
        results, _ = self._call(self._inputs)
        for output, i in zip(self._outputs, self._new, strict=True):
            output.copy_(results[i])

    @torch.no_grad()
    def _step_back(self) -> None:
        for gradient, x in zip(self._gradients, self.derivative(self._fresh(), self._slopes, False), strict=True):
            if gradient is not None and x is not None:
                gradient.copy_(x)

    def forward(self, tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Return the results that are new."""
        self._take(tensors)
        self._run()
        return tuple(x.clone() for x in self._outputs)

    @torch.no_grad()
    def backward(self, tensors: Sequence[Tensor], slopes: Sequence[Maybe]) -> list[Maybe]:
        """Return the gradients by the arguments, from those by the new results."""
        self._take(tensors)
        for x, slope in zip(self._slopes, slopes, strict=True):
            if x is not None:
                x.zero_() if slope is None else x.copy_(slope)
        self._run_back()
        return [None if x is None else x.clone() for x in self._gradients]

    @torch.enable_grad()
    def derivative(self, tensors: Sequence[Tensor], slopes: Sequence[Maybe], again: bool) -> list[Maybe]:
        """Return the same by torch, to be differentiated ``again``."""
        results, _ = self._call(tensors)
        pairs = [(results[i], slope) for i, slope in zip(self._new, slopes, strict=True) if slope is not None]
        wrt = [x for x, n in zip(tensors, self._needs, strict=True) if n]
        outputs, by = zip(*pairs, strict=True)
        gradients = iter(torch.autograd.grad(outputs, wrt, by, create_graph=again, allow_unused=True))
        return [next(gradients) if n else None for n in self._needs]

    def tree_of(self, tensors: Sequence[Tensor], results: Sequence[Tensor]) -> Any:
        """Return the tree of results, of which these are new."""
        leaves = [x if i is None else tensors[i] for i, x in zip(self._arguments, self._others, strict=True)]
        for i, x in zip(self._new, results, strict=True):
            leaves[i] = x
        return self._results_tree.unflatten(leaves)

    @torch.no_grad()
    def _take(self, tensors: Sequence[Tensor]) -> None:
        """Copy arguments to where they are read; those of the last call, if nobody wrote to them, are there already."""
        for i, x in enumerate(tensors):
            last, version = self._last[i]
            now = 0 if x.is_inference() else x._version
            if x.is_inference() or last is None or last() is not x or now != version:
                self._inputs[i].copy_(x)
                self._last[i] = weakref.ref(x), now


class _Recorded(torch.autograd.Function):
    """The new results of a form, with its derivative."""

    @staticmethod
    def forward(ctx: Any, form: _Form, *tensors: Tensor) -> tuple[Tensor, ...]:
        results = form.forward(tensors)
        ctx.form = form
        ctx.save_for_backward(*tensors)
        ctx.mark_non_differentiable(*(x for x, d in zip(results, form.differ, strict=True) if not d))
        ctx.set_materialize_grads(False)
        return results

    @staticmethod
    def backward(ctx: Any, *slopes: Maybe) -> tuple[Maybe, ...]:
        tensors, form = ctx.saved_tensors, ctx.form
        if torch.is_grad_enabled():  # a second derivative is wanted: torch's
            return None, *form.derivative(tensors, slopes, True)
        return None, *form.backward(tensors, slopes)
