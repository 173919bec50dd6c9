"""Fits behind recorded leaders, many candidates at once, and bare rings: the other shapes that have to be fast."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.bench.measure import Case, measure
from idm_env.effects import ALL, CANDIDATES, IDM, Brakes, Replay
from idm_env.kernels import dispatch
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.types import Record

TRAJECTORIES, STEPS, SHORT = 6000, 600, 60
ITERATIONS = 500


def _followers(drivers: int, steps: int) -> tuple[Tensor, ...]:
    """Return gap, speed, lead position, lead speed and the five parameters: leaders that brake and drive off again."""
    generator = torch.Generator().manual_seed(0)

    def draw(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    time_s = torch.arange(steps + 1)[:, None] * 0.1
    lead_speed = 12.0 + draw(2.0, 6.0, drivers) * torch.sin(0.2 * time_s + draw(0.0, 6.0, drivers))
    lead_position = torch.cumsum(lead_speed * 0.1, 0)
    bounds = ((0.8, 2.0), (1.0, 2.5), (1.0, 2.0), (1.5, 3.0), (20.0, 35.0))
    params = torch.stack([draw(*b, drivers) for b in bounds], -1)
    return draw(10.0, 40.0, drivers), draw(5.0, 15.0, drivers), lead_position, lead_speed, params


def recorded_leaders(rounds: int) -> dict[str, Any]:
    """Return seconds for 500 Adam iterations of 6000 × 600 by the kernel, and the same (scaled) in eager torch.

    The eager path is timed over 60 of the 600 steps and multiplied by ten. Also one pass of sensitivities and of the
    normal equations, and the candidates of discovery: 30 × 20 × 4 drivers over 36 windows of 50 steps.
    """
    from idm_env.kernels import recorded

    gap, speed, lead_position, lead_speed, params = _followers(TRAJECTORIES, STEPS)
    leaf = params.clone().requires_grad_()
    adam = torch.optim.Adam([leaf], lr=1e-3)

    def iteration() -> None:
        adam.zero_grad()
        out = recorded.rollout(gap, speed, lead_position, lead_speed, leaf)
        ((out.gap - 20.0).square().mean() + (out.speed - 12.0).square().mean()).backward()
        adam.step()

    ones = torch.ones(STEPS, TRAJECTORIES)
    candidates = _followers(30 * 20 * 4 * 36, 50)

    def normal() -> object:
        return recorded.normal_equations(
            *given, gap_target=20 * ones, speed_target=12 * ones, gap_weight=ones, speed_weight=ones
        )

    given = (gap, speed, lead_position, lead_speed, params)
    times = measure(
        {
            "kernel iteration": Case(iteration),
            "eager iteration": Case(_eager(SHORT), SHORT / STEPS),
            "sensitivities": Case(lambda: recorded.sensitivities(*given)),
            "normal equations": Case(lambda: normal()),
            "discovery's candidates, sensitivities": Case(lambda: recorded.sensitivities(*candidates)),
        },
        min(rounds, 3),
    )
    kernel, eager = (times[f"{path} iteration"]["cpu_min_ms"] for path in ("kernel", "eager"))
    return {
        "ms": times,
        "seconds_for_500_iterations": kernel * ITERATIONS / 1e3,
        "times_eager": eager / kernel,
    }


def _eager(steps: int) -> Any:
    gap, speed, lead_position, lead_speed, params = _followers(TRAJECTORIES, steps)
    simulator = Simulator(Lane(), (IDM(), Brakes(), Replay()))
    names = [p.name for p in IDM.declared]
    leaf = params.clone().requires_grad_()
    adam = torch.optim.Adam([leaf], lr=1e-3)
    place, pace = (x[1:, :, None].expand(-1, -1, 2) for x in (lead_position, lead_speed))
    record = Record(
        place,
        pace,
        torch.zeros_like(pace),
        torch.tensor([True, False]).expand(steps, TRAJECTORIES, 2),
    )

    def iteration() -> None:
        adam.zero_grad()
        own: dict[str, dict[str, Tensor]] = {
            "idm": {name: leaf[:, j, None] for j, name in enumerate(names)},
            "brakes": {"max_decel": torch.tensor(9.0)},
            "replay": {},
        }
        front = lead_position[0]
        state = simulator.state(
            torch.stack((front, front - 5.0 - gap), -1), torch.stack((lead_speed[0], speed), -1), own
        )
        with dispatch.off("benchmark of the torch path"):
            _, out = simulator.rollout(state, {"replay": record}, own, steps)
        ((out.gap[..., 1] - 20.0).square().mean() + (out.speed[..., 1] - 12.0).square().mean()).backward()
        adam.step()

    return iteration


def discovery() -> dict[str, Any]:
    """Return CPU ms of one Jacobian of every candidate effect by discovery's loop, and CPU seconds of a discovery.

    A generated set of 10 runs × 3 followers × 180 s without an effect; a Jacobian is a rollout of all windows of 50
    steps in one copy more than there are parameters, the drivers' five included, at the candidate's first start.
    """
    from idm_env.data import synthetic
    from idm_env.discovery import discover, model, records, search
    from idm_env.discovery.discover import prepare
    from idm_env.discovery.solve import Task, linearise

    trajectories, _ = synthetic.generate(0)
    rows = records.windows(prepare(trajectories, "driver"))
    task = Task(rows, search.first_noise(rows), search.first_prior(), np.ones(len(rows)))
    theta = np.tile(task.prior.centre, (task.groups, 1))

    def jacobian(name: str) -> Case:
        term = model.simple(name)
        return Case(lambda: linearise(task, model.Model((term,)), theta, np.array(term.starts[0])))

    times = measure({n: jacobian(n) for n in CANDIDATES if ALL[n].sought == "anywhere"}, 3)
    begin = time.process_time()
    discover(trajectories)
    return {
        "windows": len(rows),
        "jacobian_cpu_ms": {name: t["cpu_min_ms"] for name, t in times.items()},
        "set_cpu_s": time.process_time() - begin,
    }


def rings(seconds: float = 0.5) -> dict[str, float]:
    """Return bare steps of rings of 22 (IDM and brakes): env-steps per CPU second at 8192, µs for a single one."""
    from idm_env.kernels.stepper import Stepper

    simulator = Simulator(Ring(230.0), (IDM(), Brakes()))
    params = simulator.defaults()

    def each(rows: int, steps: int) -> float:
        position = (-torch.arange(22.0) * 230.0 / 22).expand(rows, 22).clone()
        stepper = Stepper(simulator)
        state = stepper.run(simulator.state(position, torch.full((rows, 22), 3.0), params), {}, params, steps)
        count, begin = 0, time.process_time()
        while time.process_time() - begin < seconds:
            state = stepper.run(state, {}, params, steps)
            count += steps
        return (time.process_time() - begin) / count

    alone = Simulator(Lane(), simulator.effects)
    line = alone.state(-30.0 * torch.arange(1000.0)[None], torch.full((1, 1000), 10.0), params)
    stepper = Stepper(alone)
    line = stepper.run(line, {}, params, 10)
    begin = time.process_time()
    for _ in range(1000):
        line = stepper.run(line, {}, params, 10)
    lane = (time.process_time() - begin) / 10_000
    return {
        "env_steps_per_s_at_8192": 8192 / each(8192, 1),
        "env_steps_per_s_at_8192_ten_per_call": 8192 / each(8192, 10),
        "single_ring_step_us": 1e6 * each(1, 1),
        "lane_of_1000_vehicle_updates_per_s": 1000.0 / lane,
    }
