"""One action means the same in every face."""

import gymnasium as gym
import numpy as np
import pytest

import idm_env  # noqa: F401
from idm_env.envs.pettingzoo import env as turns, parallel_env

pytest.importorskip("stable_baselines3")

from idm_env.envs.sb3 import SB3VecEnv


def _single(output):
    return lambda rows, **k: gym.make("DiffIDM-v0", output=output, **k), lambda a: a[0]


def _vector(output):
    return lambda rows, **k: gym.make_vec("DiffIDM-v0", num_envs=rows, output=output, **k), lambda a: a


FACES = {f"{f.__name__} {o}": f(o) for f in (_single, _vector) for o in ("numpy", "torch")}
FACES["sb3"] = (lambda rows, **k: SB3VecEnv(gym.make_vec("DiffIDM-v0", num_envs=rows, **k)), lambda a: a)
FACES["parallel"] = (
    lambda rows, **k: parallel_env(**k),
    lambda a: dict(zip(("vehicle_0", "vehicle_3"), a[0, :, None], strict=True)),
)
FACES["turns"] = (lambda rows, **k: turns(**k), lambda a: list(a[0, :, None]))
GIVEN = {
    "huge": np.full((2, 2), 1e300), "huge below": np.full((2, 2), -1e300), "beyond": np.full((2, 2), 5.0),
    "reversed": np.array([[0.5, -0.3]] * 2, np.float32)[::-1, ::-1], "big-endian": np.array([[0.5, -0.3]] * 2, ">f4"),
    "big-endian doubles": np.array([[0.5, -0.3]] * 2, ">f8"), "whole": np.array([[1, -1]] * 2, np.int8),
    "read-only": np.array([[0.5, -0.3]] * 2, np.float32),
}  # fmt: skip
GIVEN["read-only"].flags.writeable = False


@pytest.mark.filterwarnings("error:overflow:RuntimeWarning")
def test_an_action_is_the_same_action_in_every_face():
    """Clipped where it is finite, whatever its type and however it lies; None leaves the vehicle to its driver."""
    wrong = {}
    for face, (make, taken) in FACES.items():
        for name, action in {**GIVEN, "nobody": None}.items():
            env = make(2, task="ring", vehicles=6, controlled=2, warmup=0)
            if face == "sb3":
                env.seed(0), env.reset()
            else:
                env.reset(seed=0)
            given = None if action is None else taken(action)
            if face == "turns":
                for each in [None, None] if given is None else given:
                    env.step(each)
                accel = [env.infos[agent]["accel"] for agent in env.agents]
            else:
                told = env.step(given)[3 if face == "sb3" else 4]
                accel = [x["accel"] for x in told.values()] if face == "parallel" else (
                    told[0]["accel"] if face == "sb3" else np.asarray(told["accel"]).reshape(-1, 2)[0]
                )  # fmt: skip
            wanted = np.zeros(2) if action is None else np.clip(np.asarray(action[0], np.float64), 0.0, 1.0)
            if not (np.min(accel) > 1.0 if action is None else np.allclose(accel, wanted, atol=1e-6)):
                wrong[face, name] = accel
    assert wrong == {}
