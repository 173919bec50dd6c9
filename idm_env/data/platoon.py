"""Integrates platoons behind prescribed leaders by Heun's method on a fine clock; made for synthetic data only.

Heun's second order at a step far below that of the data keeps errors of integration out of what a fitted model might
take for an effect, which a first-order step at 0.1 s does not.
"""

from dataclasses import dataclass

import numpy as np

from idm_env.data import hidden
from idm_env.data.hidden import Drivers, View


@dataclass(frozen=True)
class PlatoonMotion:
    """Vehicles on the fine clock, scripted or simulated: arrays [steps, runs] or [steps, runs, vehicles]."""

    position: np.ndarray
    speed: np.ndarray
    accel: np.ndarray


@dataclass
class Platoon:
    """Runs of followers behind one scripted leader each; `run` integrates them.

    Attributes:
        leader: The leaders [steps, runs].
        beside: Vehicles of the adjacent lane [steps, runs, vehicles], or None.
        drivers: Parameters [runs, followers].
        lengths: Lengths [runs, 1 + followers], the leader first.
        starts: Time of each run's first step [runs] in s.
        step: Fine step in s.
        on: Strength by name of the effects at work.
        noise: Random acceleration of the drivers [steps, runs, followers] in m/s².
    """

    leader: PlatoonMotion
    beside: PlatoonMotion | None
    drivers: Drivers
    lengths: np.ndarray
    starts: np.ndarray
    step: float
    on: dict[str, float]
    noise: np.ndarray

    def run(self) -> PlatoonMotion:
        """Return the followers' motions, started in equilibrium at their leader's first speed."""
        steps = len(self.leader.position)
        shape = self.drivers.time_gap.shape
        out = PlatoonMotion(*(np.empty((steps, *shape)) for _ in range(3)))
        self._seen = np.empty((3, steps, *shape))
        self._held = np.zeros(shape)
        state = self._start()
        for k in range(steps):
            here = self._rates(k, k, state)
            out.position[k], out.speed[k], out.accel[k] = state[0], state[1], here[1]
            self._held = here[1]
            if k + 1 == steps:
                break
            ahead = self._rates(k + 1, k, state + self.step * here)
            state = state + 0.5 * self.step * (here + ahead)
            state[1] = np.maximum(state[1], 0.0)
        return out

    def _start(self) -> np.ndarray:
        """Return the state [6, runs, followers]: position, speed, lagged acceleration, three memories (see `View`)."""
        speed = np.broadcast_to(self.leader.speed[0][:, None], self.drivers.time_gap.shape)
        desired = self.drivers.min_gap + speed * self.drivers.time_gap
        gap = desired / np.sqrt(1 - np.minimum(speed / self.drivers.desired_speed, 0.95) ** 4)
        position = self.leader.position[0][:, None] - np.cumsum(gap + self.lengths[:, :-1], axis=1)
        zero = np.zeros_like(speed)
        return np.stack([position, speed, zero, speed / self.drivers.desired_speed, 1.0 + zero, speed])

    def _rates(self, k: int, last: int, state: np.ndarray) -> np.ndarray:
        """Return the time derivative of the state at fine step k; what drivers saw is recorded up to step `known`."""
        view = self._view(k, state)
        if k == last:
            self._seen[:, k] = view.gap, view.speed, view.lead_speed
        gap, speed, lead_speed = self._perceived(k, last, view)
        accel = hidden.desired_accel(view, (gap, speed, lead_speed), self.drivers, self.on) + self.noise[last]
        accel = self._chained(k, accel, view.speed, state[2])
        rates = np.empty_like(state)
        rates[0] = state[1]
        rates[1] = state[2] if "lag" in self.on else accel
        rates[1] = np.where((state[1] <= 0) & (rates[1] < 0), 0.0, rates[1])
        rates[2] = (accel - state[2]) / self.on["lag"] if "lag" in self.on else 0.0
        rates[3] = (state[1] / self.drivers.desired_speed - state[3]) / hidden.MEMORY_TIME_S
        rates[4] = (hidden.habit_of(view.gap, view.speed, self.drivers) - state[4]) / hidden.RELAXATION_TIME_S
        rates[5] = (view.lead_speed - state[5]) / hidden.TREND_TIME_S
        return rates

    def _chained(self, k: int, accel: np.ndarray, speed: np.ndarray, lagged: np.ndarray) -> np.ndarray:
        """Return the limited accelerations; each follower may react to that of the one ahead at this moment."""
        if not {"leader_acceleration", "brake_light"} & set(self.on):
            return hidden.limited(accel, speed, self._held, self.on)
        result = np.empty_like(accel)
        ahead = self.leader.accel[k]
        for i in range(accel.shape[1]):
            led_by = hidden.with_feed_forward(accel[:, i], ahead, self.on)
            result[:, i] = hidden.limited(led_by, speed[:, i], self._held[:, i], self.on)
            ahead = lagged[:, i] if "lag" in self.on else result[:, i]
        return result

    def _perceived(self, k: int, last: int, view: View) -> np.ndarray:
        if "delay" not in self.on:
            return np.stack([view.gap, view.speed, view.lead_speed])
        past = np.clip(k - self.on["delay"] / self.step, 0.0, last)
        low = int(past)
        share = past - low
        return (1 - share) * self._seen[:, low] + share * self._seen[:, min(low + 1, last)]

    def _view(self, k: int, state: np.ndarray) -> View:
        position, speed = state[0], state[1]
        front = np.concatenate([self.leader.position[k][:, None], position], axis=1)
        rates = np.concatenate([self.leader.speed[k][:, None], speed], axis=1)
        gap = front[:, :-1] - self.lengths[:, :-1] - position
        none = np.full((len(position), 1), np.nan)
        second_gap = np.concatenate([none, front[:, :-2] - self.lengths[:, :-2] - position[:, 1:]], axis=1)
        second_speed = np.concatenate([none, rates[:, :-2]], axis=1)
        distance, beside_speed = self._nearest(k, position)
        return View(
            time=(self.starts + k * self.step)[:, None],
            position=position,
            speed=speed,
            gap=gap,
            lead_speed=rates[:, :-1],
            second_gap=second_gap,
            second_speed=second_speed,
            gap_behind=np.concatenate([gap[:, 1:], none], axis=1),
            beside_distance=distance,
            beside_speed=beside_speed,
            memory=state[3],
            # What the vehicle ahead did a fine step ago: what it does now depends on what it sees now.
            lead_accel=np.concatenate([self.leader.accel[k][:, None], self._held[:, :-1]], axis=1),
            habit=state[4],
            lead_level=state[5],
        )

    def _nearest(self, k: int, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.beside is None:
            none = np.full_like(position, np.nan)
            return none, none
        away = self.beside.position[k][:, None, :] - position[:, :, None]
        index = np.abs(away).argmin(axis=2)
        distance = np.take_along_axis(away, index[:, :, None], axis=2)[:, :, 0]
        return distance, np.take_along_axis(self.beside.speed[k], index, axis=1)
