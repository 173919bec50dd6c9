"""Adam through the simulator, as in the paper: reverse-mode gradients, parameters behind bijections."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from idm_env.fitting.problem import Problem
from idm_env.parameters import constrain, unconstrain


def adam(
    problem: Problem,
    own: Tensor,
    shared: Tensor,
    *,
    steps: int = 500,
    rate: tuple[float, float] = (0.1, 0.01),
    state: dict[str, Any] | None = None,
    on_step: Callable[[int, float, dict[str, Any]], None] | None = None,
) -> tuple[Tensor, Tensor, float]:
    """Minimise the mean squared residual; return own [G, P] and shared [Q] values and the last loss.

    Every parameter lives on the real line behind ``biject_to`` of its bounds; the learning rate falls linearly from
    ``rate[0]`` to ``rate[1]``. ``state`` is what ``on_step`` was given last: with it an interrupted run goes on as
    if nothing had happened.
    """
    free = [
        unconstrain(p, own[:, i]) if i < len(problem.own) else unconstrain(p, shared[i - len(problem.own)])
        for i, p in enumerate(problem.parameters)
    ]
    leaves = [x.clone().requires_grad_() for x in free]
    optimiser = torch.optim.Adam(leaves, lr=rate[0])
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, rate[1] / rate[0], total_iters=steps)
    begin = 0
    if state is not None:
        with torch.no_grad():
            for leaf, saved in zip(leaves, state["leaves"], strict=True):
                leaf.copy_(saved)
        optimiser.load_state_dict(state["optimiser"])
        schedule.load_state_dict(state["schedule"])
        begin = state["step"]

    def values() -> tuple[Tensor, Tensor]:
        inside = [constrain(p, x) for p, x in zip(problem.parameters, leaves, strict=True)]
        cut = len(problem.own)
        own_now = torch.stack(inside[:cut], dim=-1)
        return own_now, torch.stack(inside[cut:]) if inside[cut:] else shared

    loss_value = float("nan")
    count = problem.weight.sum() * (2 if problem.objective == "both" else 1)
    for step in range(begin, steps):
        optimiser.zero_grad()
        residual = problem.residual(problem.simulate(problem.rows(*values())))
        loss = residual.square().sum() / count
        loss_value = float(loss.detach())
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if on_step is not None:
            saved = {
                "leaves": [x.detach().clone() for x in leaves],
                "optimiser": optimiser.state_dict(),
                "schedule": schedule.state_dict(),
                "step": step + 1,
            }
            on_step(step + 1, loss_value, saved)
    own_end, shared_end = values()
    return own_end.detach(), shared_end.detach(), loss_value
