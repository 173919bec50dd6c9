"""The pictures of docs/trajectories.md, from data that are made here.

    python -m benchmarks.trajectories_pictures [--out docs]

``filtering.png``: a generated driver with 0.3 m of correlated noise and two jumps, before and after.
``prediction.png``: a vehicle that comes up to a stop sign, its futures, and what it did.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import numpy as np

from idm_env.data import synthetic
from idm_env.data.scenario import Agent, Control, Lane, Scenario
from idm_env.prediction.pictures import scene_picture
from idm_env.prediction.predict import predict
from idm_env.prediction.scene import Scene
from idm_env.trajectories.noise import fit_noise
from idm_env.trajectories.recipe import recipe
from idm_env.trajectories.report import before_and_after
from idm_env.trajectories.tracks import Pieces, Track, from_frame


def noisy_tracks() -> list[Track]:
    """Return generated drivers whose positions carry noise correlated over 0.3 s, white noise, and jumps."""
    made, _ = synthetic.generate(3, runs=2, followers=4, seconds=60.0)
    rng = np.random.default_rng(0)
    tracks = []
    for track in Pieces(from_frame(made.table.select("run_id", "vehicle_id", "leader_id", "time_s", "position_m"))):
        fade, noise = np.exp(-0.1 / 0.3), np.empty(len(track))
        noise[0] = 0.3 * rng.normal()
        for k in range(1, len(noise)):
            noise[k] = fade * noise[k - 1] + 0.3 * np.sqrt(1 - fade * fade) * rng.normal()
        noise += 0.1 * rng.normal(size=len(noise))
        noise[rng.integers(0, len(noise), 2)] += 3.0
        tracks.append(dataclasses.replace(track, position_m=track.position_m + noise))
    return tracks


def crossing() -> Scenario:
    """Return a crossing with a stop sign, and a vehicle that halts at it and goes on to the left."""
    east = Lane(1, np.array([[-80.0, 0.0], [-4.0, 0.0]]), exits=(2, 3))
    across = Lane(2, np.array([[-4.0, 0.0], [60.0, 0.0]]), exits=())
    angle = np.linspace(0, np.pi / 2, 12)
    bend = np.stack([-4.0 + 8.0 * np.sin(angle), 8.0 - 8.0 * np.cos(angle)], axis=1)
    left = Lane(3, np.concatenate([bend, [[4.0, 60.0]]]), exits=())
    path = np.concatenate([east.line, left.line])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    speed = np.interp(np.arange(91), [0, 10, 50, 60, 91], [10.5, 10.0, 0.3, 0.3, 5.0])
    along = 76.0 - 2.5 - 21.4 - 10.3 + np.concatenate([[0.0], np.cumsum(0.1 * speed[:-1])])
    position = np.stack([np.interp(along, length, path[:, i]) for i in (0, 1)], axis=1)
    step = np.gradient(position, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    velocity = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    agent = Agent(1, "vehicle", 4.6, 1.9, position, heading, velocity, np.ones(91, bool))
    return Scenario(
        "a crossing", (agent,), (east, across, left), (0,), controls=(Control("sign", np.array([-6.0, -4.0])),)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs"))
    out = parser.parse_args().out
    tracks = noisy_tracks()
    filtered = recipe(tracks, 0.1, fit_noise([(t.time_s, t.position_m) for t in tracks], 0.1))
    before_and_after(filtered[2].track, filtered[2].motion).savefig(out / "filtering.png", dpi=90)
    figure, _ = scene_picture(scene := crossing(), predict(Scene(scene), 0))
    figure.savefig(out / "prediction.png", dpi=90)


if __name__ == "__main__":
    main()
