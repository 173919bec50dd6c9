"""What one effect more costs: nanoseconds of CPU time per vehicle-step, forward and forward + backward, one thread.

``python -m benchmarks.effects [vehicles]``; lanes of 50, float32, ten steps per call, parameters of IDM and brakes per
vehicle. Every effect is timed in turns with IDM and brakes alone, so the ratios hold where the machine is loaded.
"""

from __future__ import annotations

import torch
import tyro

from benchmarks import command
from benchmarks.bench.measure import Case, measure
from idm_env.effects import ALL, CANDIDATES, IDM, Brakes, Effect
from idm_env.roads import Lane
from idm_env.simulator import Simulator

STEPS, LANE = 10, 50


def case(vehicles: int, effects: tuple[Effect, ...], backward: bool) -> Case:
    """Return ten steps of lanes with these effects."""
    simulator = Simulator(Lane(), (IDM(), Brakes(), *effects))
    generator = torch.Generator().manual_seed(0)
    shape = (vehicles // LANE, LANE)
    position = (-25.0 * torch.arange(LANE)).expand(shape) + 5.0 * torch.rand(shape, generator=generator)
    params = simulator.defaults()
    for name in ("idm", "brakes"):
        params[name] = {k: x * (1.0 + 0.1 * torch.rand(shape, generator=generator)) for k, x in params[name].items()}
    state = simulator.state(position, 10.0 + 3.0 * torch.rand(shape, generator=generator), params)
    leaves = [x.requires_grad_(backward) for part in params.values() for x in part.values()]

    def run() -> None:
        last, _ = simulator.rollout(state, {}, params, STEPS, keep=None)
        if backward:
            torch.autograd.grad(last.position.sum() + last.speed.sum(), leaves, allow_unused=True)

    return Case(run, STEPS * vehicles * 1e-6)


def main(vehicles: tyro.conf.Positional[int] = 200_000) -> None:
    """Print a line per effect."""
    torch.set_num_threads(1)
    print(f"{'effect':24s} {'forward':>8s} {'ratio':>6s} {'both':>8s} {'ratio':>6s}   ns per vehicle-step")
    for name in ("", *(n for n in CANDIDATES if n not in ("lateral", "grade"))):
        effects = (ALL[name](),) if name else ()
        cells = []
        for backward in (False, True):
            cases = {"plain": case(vehicles, (), backward), "this": case(vehicles, effects, backward)}
            times = measure(cases, 3)
            now, plain = (times[k]["cpu_min_ms"] for k in ("this", "plain"))
            cells.append(f"{now:8.2f} {now / plain:6.2f}")
        print(f"{name or 'IDM and brakes':24s} {' '.join(cells)}", flush=True)


if __name__ == "__main__":
    command(main)
