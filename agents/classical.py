"""Classical controllers of one vehicle on the ring, as rows beside what is learned; nothing is trained here.

Both are of Stern, Cui, Delle Monache, Bhadani, Bunting, Churchill, Hamilton, Haulcy, Pohlmann, Wu, Piccoli, Seibold,
Sprinkle, Work 2018, "Dissipation of stop-and-go waves via control of autonomous vehicles: field experiments", Transp.
Res. C 89, 205 (arXiv 1705.01693). They command a speed; the acceleration is the one that reaches it in a step, clipped
to what an agent may command.

``python -m agents.classical [--config configs/ring-apg.yaml]``
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import tyro
from torch import Tensor

from agents import apg
from agents.common import load_agent, one_line
from agents.environments import task_of
from agents.evaluate import as_judged, evaluate_ring
from agents.rollout import FRESH, LENGTHS, Act, ring_start, uniform_speed
from idm_env.jobs import trust
from idm_env.tasks import Task


class Seen(NamedTuple):
    """The observation of the ring in SI units, each ``(n, agents)``: speed, leader's speed (m/s), gap (m)."""

    speed: Tensor
    lead_speed: Tensor
    gap: Tensor


def seen(observation: Tensor, task: Task) -> Seen:
    """Return an observation ``(n, agents · features)`` of the ring."""
    columns = task.by_name(observation)
    speed = columns["speed"]
    return Seen(speed, speed + columns["relative_speed"], columns["headway"] - task.vehicle_length)


@dataclass
class Controller:
    """A commanded speed, turned into actions in [−1, 1]; one object drives one batch of rings once."""

    task: Task

    def __call__(self, observation: Tensor) -> Tensor:
        """Return actions ``(n, agents)``."""
        view = seen(observation, self.task)
        return self.task.action((self.wanted(view) - view.speed) / self.task.step_time)

    def wanted(self, view: Seen) -> Tensor:
        """Return the commanded speed (m/s)."""
        raise NotImplementedError


@dataclass
class FollowerStopper(Controller):
    """A desired speed U, given up in three parabolic zones of gap and closing speed.

    With ``Δv₋ = min(v_lead − v, 0)`` the zones begin at ``Δx_k = Δx_k⁰ + Δv₋² / (2 d_k)``; ``v* = min(v_lead, U)``. The
    command is 0, then rises linearly to v*, then to U.

    Args:
        desired: U (m/s), one number or one per ring ``(n, 1)``: the controller cannot find it by itself.
    """

    desired: Tensor | float

    def wanted(self, view: Seen) -> Tensor:
        """Return the commanded speed (m/s)."""
        closing = (view.lead_speed - view.speed).clamp_max(0.0)
        zones = ((4.5, 1.5), (5.25, 1.0), (6.0, 0.5))
        first, second, third = (start + closing.square() / (2.0 * decel) for start, decel in zones)
        top = torch.as_tensor(self.desired).expand_as(view.speed)
        calm = torch.minimum(view.lead_speed.clamp_min(0.0), top)
        adapting = calm * (view.gap - first) / (second - first)
        leaving = calm + (top - calm) * (view.gap - second) / (third - second)
        result = torch.where(view.gap <= first, 0.0, torch.where(view.gap <= second, adapting, leaving))
        return torch.where(view.gap > third, top, result)


@dataclass
class PISaturation(Controller):
    """Follows the mean of its own speed over 38 s, and less of it the shorter the gap.

    ``v_target = U + v_catch sat((Δx − g_l)/(g_u − g_l))``; ``α = sat((Δx − Δx_s)/γ)``, ``Δx_s = max(2 s (v_lead − v), 4
    m)``, ``β = 1 − α/2``; ``v_cmd ← β (α v_target + (1 − α) v_lead) + (1 − β) v_cmd``, sat clipping to [0, 1], with
    v_catch = 1 m/s, g_l = 7 m, g_u = 30 m, γ = 2 m.
    """

    seconds: float = 38.0

    def __post_init__(self) -> None:
        self._past: deque[Tensor] = deque(maxlen=round(self.seconds / self.task.step_time))
        self._command: Tensor | None = None

    def wanted(self, view: Seen) -> Tensor:
        """Return the commanded speed (m/s), and remember it."""
        self._past.append(view.speed)
        mean = torch.stack(tuple(self._past)).mean(0)
        target = mean + ((view.gap - 7.0) / 23.0).clamp(0.0, 1.0)
        safe = (2.0 * (view.lead_speed - view.speed)).clamp_min(4.0)
        alpha = ((view.gap - safe) / 2.0).clamp(0.0, 1.0)
        beta = 1.0 - 0.5 * alpha
        before = view.speed if self._command is None else self._command
        self._command = beta * (alpha * target + (1.0 - alpha) * view.lead_speed) + (1.0 - beta) * before
        return self._command


def no_command(observation: Tensor) -> Tensor:
    """Return actions of zero: the vehicle keeps its speed, whatever happens, unless a failsafe brakes."""
    return observation.new_zeros(len(observation), 1)


def constant(accel: float, task: Task) -> Act:
    """Return agents that always command this acceleration (m/s²): with a failsafe, that drives."""
    return lambda observation: task.action(observation.new_full((len(observation), len(task.agents)), accel))


def controllers(
    environment: Mapping[str, Any], lengths: Sequence[float], draws: Sequence[int]
) -> dict[str, Callable[[], Act | None]]:
    """Return what makes each controller for rings of these lengths and draws, by the name of its row."""
    task = task_of(environment)
    uniform = uniform_speed(ring_start(environment, lengths, draws=draws)).unsqueeze(-1)
    middle = float(uniform.median())
    return {
        "IDM for all": lambda: None,
        "no command": lambda: no_command,
        "0.025 m/s² for ever": lambda: constant(0.025, task),
        "0.05 m/s² for ever": lambda: constant(0.05, task),
        "FollowerStopper, one speed for all rings": lambda: FollowerStopper(task, desired=middle),
        "FollowerStopper, told each ring's uniform speed": lambda: FollowerStopper(task, desired=uniform),
        "PI with saturation": lambda: PISaturation(task),
    }


@dataclass
class Arguments:
    """Judge the classical controllers as agents are judged.

    Args:
        config: An agent's file, of which the environment is taken.
        trust: Run Python code that the file names, such as my_file.py:MyEffect.
    """

    config: str = "configs/ring-apg.yaml"
    trust: bool = False


def main(argv: Sequence[str] | None = None) -> None:
    """Print one row per controller."""
    torch.set_num_threads(1)
    with one_line():
        options = tyro.cli(Arguments, args=argv)
        if options.trust:
            trust.always()
        arguments = load_agent(options.config, apg.Arguments, "apg")
        environment = as_judged(arguments.environment, arguments.judged_in)
    print("controller | worst speed ratio | worst std (m/s) | smallest time gap (s) | collisions")
    for name, make in controllers(environment, LENGTHS, FRESH).items():
        r = evaluate_ring(make(), environment, draws=FRESH)
        print(
            f"{name} | {r['speed_ratio']:.3f} | {r['speed_std']:.2f} | {r['time_gap']:.2f} | {r['collisions']}"
            f" | {[round(x, 3) for x in r['ratios']]}"
        )


if __name__ == "__main__":
    main()
