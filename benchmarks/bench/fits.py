"""Fits behind recorded leaders, many candidates at once, and bare rings: the other shapes that have to be fast."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.bench.measure import Case, measure
from idm_env.compiled.kernels import dispatch
from idm_env.effects import ALL, CANDIDATES, IDM, Brakes, Replay, make
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.types import Record

TRAJECTORIES, STEPS, SHORT = 6000, 600, 60
ITERATIONS = 500
CORRECTIONS = ("", "asymmetry", "lag", "memory", "leader_acceleration", "delay")
"""Effects behind which a fit is timed; none is plain IDM."""


class Followers:
    """Drivers behind leaders that brake and drive off again, and the rollouts that a fit makes of them."""

    def __init__(self, drivers: int, steps: int, *effects: str) -> None:
        from idm_env.compiled.kernels import drivers as kernels

        generator = torch.Generator().manual_seed(0)

        def draw(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(*shape, generator=generator)

        time_s = torch.arange(steps + 1)[:, None] * 0.1
        lead = 12.0 + draw(2.0, 6.0, drivers) * torch.sin(0.2 * time_s + draw(0.0, 6.0, drivers))
        speed = torch.stack((lead, draw(5.0, 15.0, drivers).expand_as(lead)), -1)
        place = torch.cumsum(lead * 0.1, 0)
        gap = draw(10.0, 40.0, drivers)
        position = torch.stack((place, (place[0] - 5.0 - gap).expand_as(place)), -1)
        bounds = ((0.8, 2.0), (1.0, 2.5), (1.0, 2.0), (1.5, 3.0), (20.0, 35.0))
        self.simulator = Simulator(Lane(), (IDM(), Brakes(), Replay(), *(make(e) for e in effects)))
        self.steps, self.leaf = steps, torch.stack([draw(*b, drivers) for b in bounds], -1)
        active = torch.tensor([True, False]).expand(steps, drivers, 2)
        accel = torch.zeros_like(position)
        records = {"position": position, "speed": speed, "accel": accel}
        self.start = (position[0], speed[0])
        self.inputs = {"replay": Record(position[1:], speed[1:], accel[1:], active)}
        state = self.simulator.state(*self.start, self.params(self.leaf))
        prepared = kernels.prepared(self.simulator, state, records, self.inputs, 1)
        assert not isinstance(prepared, str), prepared
        self.behind = prepared
        ones = torch.ones(steps, drivers)
        self._measured = torch.stack((20.0 * ones, 12.0 * ones)), torch.stack((ones, ones))

    def params(self, leaf: Tensor) -> dict[str, dict[str, Tensor]]:
        """Return defaults with each driver's own five."""
        own = {p.name: leaf[:, j, None] for j, p in enumerate(IDM.declared)}
        return {**self.simulator.defaults(), "idm": own}

    def gradient(self, kernel: bool) -> Tensor:
        """Return the gradient of one iteration of Adam."""
        leaf = self.leaf.clone().requires_grad_()
        params = self.params(leaf)
        state = self.simulator.state(*self.start, params)
        if kernel:
            gap, speed = self.behind.simulate(state, params)
        else:
            with dispatch.off("benchmark of the torch path"):
                _, motion = self.simulator.rollout(state, self.inputs, params, self.steps)
            gap, speed = motion.gap[..., 1], motion.speed[..., 1]
        ((gap - 20.0).square().mean() + (speed - 12.0).square().mean()).backward()  # type: ignore[no-untyped-call]
        assert leaf.grad is not None
        return leaf.grad

    def _linear(self) -> tuple[Any, ...]:
        params = self.params(self.leaf)
        return self.simulator.state(*self.start, params), params, tuple(f"idm.{p.name}" for p in IDM.declared)

    def sensitivities(self) -> object:
        """Return gap, speed and their derivatives by the five parameters."""
        return self.behind.sensitivities(*self._linear())

    def equations(self) -> object:
        """Return the normal equations of one step of Gauss and Newton."""
        state, params, names = self._linear()
        return self.behind.normal_equations(state, params, names, *self._measured)


def recorded_leaders(rounds: int) -> dict[str, Any]:
    """Return seconds for 500 Adam iterations of 6000 × 600 by the kernel, and the same (scaled) in eager torch.

    The eager path is timed over 60 of the 600 steps and multiplied by ten. Also one pass of sensitivities and of the
    normal equations, and the candidates of discovery: 30 × 20 × 4 drivers over 36 windows of 50 steps.
    """
    long, short, candidates = Followers(TRAJECTORIES, STEPS), Followers(TRAJECTORIES, SHORT), Followers(86_400, 50)
    times = measure(
        {
            "kernel iteration": Case(lambda: long.gradient(True)),
            "eager iteration": Case(lambda: short.gradient(False), SHORT / STEPS),
            "sensitivities": Case(long.sensitivities),
            "normal equations": Case(long.equations),
            "discovery's candidates, sensitivities": Case(candidates.sensitivities),
        },
        min(rounds, 3),
    )
    kernel, eager = (times[f"{path} iteration"]["cpu_min_ms"] for path in ("kernel", "eager"))
    return {
        "ms": times,
        "seconds_for_500_iterations": kernel * ITERATIONS / 1e3,
        "times_eager": eager / kernel,
    }


def corrected_models(rounds: int, drivers: int = 600, steps: int = 600) -> dict[str, dict[str, float]]:
    """Return, by added effect, ns per driver and step of normal equations and of a gradient, and times plain IDM."""
    models = {name or "plain": Followers(drivers, steps, *([name] if name else [])) for name in CORRECTIONS}
    cases = {
        f"{name} equations": Case(followers.equations, drivers * steps / 1e6) for name, followers in models.items()
    }
    cases |= {
        f"{name} gradient": Case(lambda followers=followers: followers.gradient(True), drivers * steps / 1e6)  # type: ignore[misc]
        for name, followers in models.items()
    }
    times = {name: t["cpu_min_ms"] for name, t in measure(cases, rounds).items()}
    return {
        name: {
            what: value
            for kind in ("equations", "gradient")
            for what, value in (
                (f"{kind}_ns", times[f"{name} {kind}"]),
                (f"{kind}_times_plain", times[f"{name} {kind}"] / times[f"plain {kind}"]),
            )
        }
        for name in models
    }


def discovery() -> dict[str, Any]:
    """Return CPU ms of one Jacobian of every candidate effect by discovery's loop, and CPU seconds of a discovery.

    A generated set of 10 runs × 3 followers × 180 s without an effect; a Jacobian is a rollout of all windows of 50
    steps in one copy more than there are parameters, the drivers' five included, at the candidate's first start.
    """
    from idm_env.data import synthetic
    from idm_env.discovery import discover, model, records
    from idm_env.discovery.calibrate import first_prior
    from idm_env.discovery.discover import prepare
    from idm_env.discovery.noise import first_noise
    from idm_env.discovery.solve import Problem, linearise

    trajectories, _ = synthetic.generate(0)
    rows = records.windows(prepare(trajectories, "driver"))
    problem = Problem(rows, first_noise(rows), first_prior())
    theta = np.tile(problem.prior.centre, (problem.groups, 1))

    def jacobian(name: str) -> Case:
        term = model.simple(name)
        return Case(lambda: linearise(problem, model.Hypothesis((term,)), theta, np.array(term.starts[0])))

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
    simulator = Simulator(Ring(230.0), (IDM(), Brakes()))
    params = simulator.defaults()

    def each(rows: int, steps: int) -> float:
        position = (-torch.arange(22.0) * 230.0 / 22).expand(rows, 22).clone()
        state = simulator.state(position, torch.full((rows, 22), 3.0), params)
        state, _ = simulator.rollout(state, {}, params, steps, keep=None)
        count, begin = 0, time.process_time()
        while time.process_time() - begin < seconds:
            state, _ = simulator.rollout(state, {}, params, steps, keep=None)
            count += steps
        return (time.process_time() - begin) / count

    lane_simulator = Simulator(Lane(), simulator.effects)
    line = lane_simulator.state(-30.0 * torch.arange(1000.0)[None], torch.full((1, 1000), 10.0), params)
    line, _ = lane_simulator.rollout(line, {}, params, 10, keep=None)
    begin = time.process_time()
    for _ in range(1000):
        line, _ = lane_simulator.rollout(line, {}, params, 10, keep=None)
    lane = (time.process_time() - begin) / 10_000
    return {
        "env_steps_per_s_at_8192": 8192 / each(8192, 1),
        "env_steps_per_s_at_8192_ten_per_call": 8192 / each(8192, 10),
        "single_ring_step_us": 1e6 * each(1, 1),
        "lane_of_1000_vehicle_updates_per_s": 1000.0 / lane,
    }
