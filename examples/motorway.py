"""A motorway of one's own: three lanes, an on- and an off-ramp, a fifth of trucks, demand by time, a closed lane."""

import gymnasium
import numpy as np

import idm_env  # noqa: F401 (registers DiffIDM-v0)

truck = {"length": 12.0, "parameters": {"idm.desired_speed": 23.0, "idm.max_accel": 0.7, "idm.time_gap": 1.8}}
road = {
    "lanes_count": 3, "length": 2000.0, "on_ramp": [500.0, 800.0], "off_ramp": [1300.0, 1600.0],
    "classes": {"truck": truck}, "limits": [{"speed": 27.0, "begin": 400.0, "end": 1000.0}],
    "closures": [{"lane": 3, "begin": 1000.0, "end": 1200.0, "since": 300.0, "until": 420.0}],
    "trips": {
        "per_hour": {0: 500, **{lane: [[0, 800], [120, 1400], [480, 600]] for lane in (1, 2, 3)}},  # from when (s)
        "seconds": 600, "speed": 25.0, "classes": {"truck": 0.2}, "destinations": {"exit": 0.15},
    },
}  # fmt: skip
env = gymnasium.make("DiffIDM-v0", task="open_highway", controlled=1, **road)
env.reset(seed=1)
told = [env.step(None)[-1] for _ in range(600)]  # a second each, nobody commanded
flow = {name: np.array([info[name][0] for info in told]) for name in ("inside", "queued", "outflow", "travel")}
out, trips = flow["outflow"][-1], env.unwrapped.task.vehicles
print(f"{out} of {trips} are out after 600 s, {flow['queued'].max()} waited at most")
