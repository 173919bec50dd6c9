"""Clones of the planner: does what agents see tell when to command? Run it from the root of the repository.

A network is taught what each rule pays beside no command in the next 60 s (vehicle-seconds), as the planner's copies
have it, one copy for each rule: their noise averages out. It commands the best rule where that pays more than one of
``LEAST``: *when* and *which*, weighed by what it is worth. Networks differ in what they see: ``VIEWS``. Data are of three rounds (DAgger): humans and the planner drive,
with every sixth rule drawn; then the network that sees all; then the one that sees what agents do.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn

from agents.rollout import SEED
from benchmarks import lane_planner as plan, table
from idm_env.envs.batch import Batch
from idm_env.multilane.demand import due
from idm_env.tasks.open_lanes import OpenLanesTask

VIEWS = {
    "what agents see": ("agents",),
    "and the road": ("agents", "road"),
    "and arrivals": ("agents", "arrivals"),
    "road and arrivals": ("agents", "road", "arrivals"),
}
SEGMENT, WINDOWS = 100.0, (20.0, 40.0, 60.0)
"""Of the road (m), for each of which and each lane density and mean speed are seen; and of arrivals (s)."""
LEAST, UNIT, MOST = (0.0, 10.0), 50.0, 300.0
"""Vehicle-seconds: gains beyond ``MOST`` either way are taught as that."""
Seen = dict[str, Tensor]
Net = Callable[[Seen], Tensor]


def look(batch: Batch) -> Seen:
    """Return what may be seen of every world: agents ``(n, agents, 23)``, road and arrivals ``(n, …)``."""
    task, world = batch.task, batch.world
    assert isinstance(task, OpenLanesTask) and world is not None
    agents = task.observe(world).flatten(1)
    state = world.state
    assert state.lanes is not None and state.lanes.trips is not None and state.present is not None
    lanes, segments = task.road.count, round((task.road.length or 0.0) / SEGMENT)
    cell = state.lanes.lane * segments + (state.position / SEGMENT).long().clamp(0, segments - 1)
    zero = torch.zeros(batch.count, lanes * segments)
    count = zero.scatter_add(1, cell, state.present.float())
    speed = zero.scatter_add(1, cell, (state.present * state.speed).float()) / count.clamp_min(1.0)
    trips, now = state.lanes.trips, state.step.unsqueeze(-1) * task.simulator.dt
    own = torch.zeros(task.vehicles)
    own[list(task.agents)] = 1.0
    begun, arrivals = due(trips, now), list[Tensor]()
    before = begun
    for window in WINDOWS:
        later = due(trips, now + window)
        for who in (1, own):
            arrivals += [((later - before) * (trips.lane == k) * who).sum(1) / 5.0 for k in range(lanes)]
        before = later
    arrivals += [((begun - trips.entered) * (trips.lane == k)).sum(1) / 5.0 for k in range(lanes)]
    return {
        "agents": agents.reshape(batch.count, len(task.bounds.names), -1).transpose(1, 2).float(),
        "road": torch.cat((count / 5.0, speed / 20.0), 1),
        "arrivals": torch.stack(arrivals, 1).float(),
    }


class Gains(nn.Module):
    """What rules pay beside no command, over ``UNIT``: agents are encoded alike, and pooled by sum and maximum."""

    def __init__(self, view: tuple[str, ...], seen: Seen) -> None:
        super().__init__()
        self.view = view
        self.each = nn.Sequential(nn.Linear(seen["agents"].shape[2], 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU())
        more = sum(seen[name].shape[1] for name in view if name != "agents")
        self.rest = nn.Sequential(
            nn.Linear(128 + more, 128), nn.ReLU(), nn.Dropout(0.1), nn.Linear(128, 128), nn.ReLU(),
            nn.Linear(128, len(plan.RULES) - 1),
        )  # fmt: skip

    def forward(self, seen: Seen) -> Tensor:
        """Return ``(n, rules − 1)``."""
        hidden = self.each(seen["agents"])
        parts = [hidden.sum(1) / 5.0, hidden.amax(1), *(seen[name] for name in self.view if name != "agents")]
        return self.rest(torch.cat(parts, 1))


def fit(view: tuple[str, ...], seen: Seen, gains: Tensor, steps: int = 1000) -> Gains:
    """Return a network fitted by least squares."""
    torch.manual_seed(0)
    net = Gains(view, seen)
    descent = torch.optim.AdamW(net.parameters(), 1e-3, weight_decay=1e-3)
    fall = torch.optim.lr_scheduler.CosineAnnealingLR(descent, steps)
    for _ in range(steps):
        rows = torch.randint(len(gains), (256,))
        wanted = gains[rows].clamp(-MOST, MOST) / UNIT
        loss = nn.functional.mse_loss(net({k: x[rows] for k, x in seen.items()}), wanted)
        descent.zero_grad()
        loss.backward()
        descent.step()
        fall.step()
    return net.eval()


def choice(net: Net, seen: Seen, least: float = LEAST[0]) -> Tensor:
    """Return the best rule of each world, 0 where none pays more than ``least``."""
    with torch.no_grad():
        gains = net(seen) * UNIT
    return torch.where(gains.amax(1) > least, 1 + gains.argmax(1), 0)


def collect(name: str, noise: float, first: int, count: int, net: Net | None) -> tuple[Seen, Tensor]:
    """Return what was seen at every decision of new episodes, and what rules would have paid beside no command."""
    seeds = range(first, first + count)
    batch, copies = plan.episodes_of(name, noise, seeds), plan.episodes_of(name, noise, range(count * len(plan.RULES)))
    drawing, seen, gains = torch.Generator().manual_seed(first), list[Seen](), list[Tensor]()
    for i in range(plan.SECONDS // plan.EVERY):
        paid = plan.foresee(batch, copies, plan.OTHER_NOISE + first + i * copies.count)
        seen.append(look(batch))
        gains.append((paid[:, 1:] - paid[:, :1]).float())
        human = torch.arange(count) % 2 == 0
        choices = torch.where(human, 0, paid.argmax(1)) if net is None else choice(net, seen[-1])
        drawn = torch.randint(len(plan.RULES), (count,), generator=drawing)
        plan.drive(batch, torch.where(torch.rand(count, generator=drawing) < 1 / 6, drawn, choices), plan.EVERY)
    return {k: torch.cat([x[k] for x in seen]) for k in seen[0]}, torch.cat(gains)


def judged(
    name: str, noise: float, first: int, count: int, net: Net | None, least: float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what episodes return (vehicle-h), whether they crash, and the choices, humans' without a network."""
    batch, parts = plan.episodes_of(name, noise, range(first, first + count)), list[tuple[Tensor, ...]]()
    for _ in range(plan.SECONDS // plan.EVERY):
        choices = torch.zeros(count, dtype=torch.long) if net is None else choice(net, look(batch), least)
        parts.append((*plan.drive(batch, choices, plan.EVERY), choices))
    paid, crashes, choices = (torch.stack(x) for x in zip(*parts, strict=True))
    return paid.sum(0) / 3600.0, crashes.any(0), choices


def main() -> None:
    """Print how well clones foresee, and what they are worth in fresh episodes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--noise", type=float, default=0.2)
    parser.add_argument("--train", type=int, default=96, help="episodes of each round")
    parser.add_argument("--episodes", type=int, default=256, help="fresh ones that judge")
    given = parser.parse_args()
    torch.set_num_threads(1)
    name, begin = "merge 3000 + 800", time.process_time()

    def told(*what: object) -> None:
        print(f"[{time.process_time() - begin:.0f} CPU s]", *what, flush=True)

    every = VIEWS["road and arrivals"]
    seen, gains = collect(name, given.noise, SEED + 50_000, given.train, None)
    told("round 0", len(gains), "decisions; some rule pays more than", LEAST[1], (gains.amax(1) > LEAST[1]).float().mean())
    for number, view in enumerate((every, VIEWS["what agents see"]), 1):
        more = collect(name, given.noise, SEED + 50_000 + 1000 * number, given.train, fit(view, seen, gains))
        seen, gains = {k: torch.cat((x, more[0][k])) for k, x in seen.items()}, torch.cat((gains, more[1]))
        told("round", number, view)
    nets = {row: fit(view, seen, gains) for row, view in VIEWS.items()}
    told("fitted", len(gains))
    fresh, truth = collect(name, given.noise, SEED + 60_000, 48, nets["road and arrivals"])
    for row, net in nets.items():
        with torch.no_grad():
            worth = torch.cat((0.0 * truth[:, :1], truth), 1)
            paid = [float(worth.gather(1, choice(net, fresh, x).unsqueeze(1)).mean()) for x in LEAST]
            error = (net(fresh) * UNIT - truth).square().mean() / (truth - truth.mean(0)).square().mean()
        told(row, f"foresees {1.0 - float(error):.2f} of the variance of what rules pay (48 fresh episodes)", paid)
    told("the planner's own choice there:", float(truth.amax(1).clamp_min(0.0).mean()), "vehicle-s a decision")
    human, lines = judged(name, given.noise, SEED + 70_000, given.episodes, None), list[list[str]]()
    for row, net, least in [("humans", None, 0.0), *((row, net, least) for row, net in nets.items() for least in LEAST)]:
        if net is not None:
            driven = judged(name, given.noise, SEED + 70_000, given.episodes, net, least)
        paid, crashed, choices = human if net is None else driven
        difference = paid - human[0]
        error = float(difference.std()) / given.episodes**0.5
        lines.append([
            row, f"{least:g}", f"{float(paid.mean()):.2f}",
            f"{float(difference.mean()):+.2f} ± {1.96 * error:.2f}", f"{2.8 * error:.2f}",
            f"{int((paid < -plan.BROKEN).sum())} of {given.episodes}", str(int(crashed.sum())),
            f"{100.0 * float((choices > 0).float().mean()):.0f} %",
        ])  # fmt: skip
        told(*lines[-1])
    head = "row, least (vehicle-s), return in vehicle-h, more than humans, least shown, broken down, crashes, commands"
    print(table(head.split(", "), lines))


if __name__ == "__main__":
    main()
