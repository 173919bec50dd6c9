"""Pictures: what is drawn where, headless windows, videos, and space-time diagrams."""

import base64
import json

import gymnasium as gym
import numpy as np
import polars as pl
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import idm_env  # noqa: F401
from idm_env.envs.render import Viewer, colour, space_time
from idm_env.reports.diagrams import lane_panels, panels, write_html
from idm_env.simulator import Trajectory

QUICK = {"warmup": 5}
BLUE = np.array([30, 90, 220])


def test_check_env_with_rendering(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    check_env(gym.make("DiffIDM-v0", **QUICK).unwrapped)


def blue(picture):
    return int((np.abs(picture.astype(int) - BLUE).sum(-1) < 10).sum())


def test_the_picture_shows_vehicles_speeds_and_controlled_ones():
    def picture(**keywords):
        env = gym.make("DiffIDM-v0", render_mode="rgb_array", **{**QUICK, **keywords})
        env.reset(seed=0)
        return env.render()

    one, three = picture(), picture(controlled=3)
    assert one.shape == (600, 600, 3)
    assert one.dtype == np.uint8
    assert blue(three) > 2 * blue(one) > 0
    moving = picture(start="wave")
    assert (moving != one).any()


def test_colours_run_from_red_to_green():
    slow, fast = colour(0.0, 10.0), colour(10.0, 10.0)
    assert slow[0] > slow[1] + 100
    assert fast[1] > fast[0] + 50
    assert colour(99.0, 10.0) == fast


def test_a_vector_renders_one_picture_each():
    env = gym.make_vec("DiffIDM-v0", num_envs=2, render_mode="rgb_array", **QUICK)
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == 2
    env.close()


def test_a_window_without_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make("DiffIDM-v0", render_mode="human", **QUICK)
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    assert env.render() is None
    env.close()
    env.close()


def test_record_video(tmp_path):
    env = gym.make("DiffIDM-v0", render_mode="rgb_array", max_episode_steps=8, **QUICK)
    env = gym.wrappers.RecordVideo(env, str(tmp_path), episode_trigger=lambda _: True)
    env.reset(seed=0)
    for _ in range(8):
        env.step(np.zeros(1, np.float32))
    env.close()
    assert [path.stat().st_size > 1000 for path in tmp_path.glob("*.mp4")] == [True]


def lines(figure):
    return [c for c in figure.axes[0].collections if c.get_array() is not None]


def test_space_time_of_a_rollout_and_of_a_table():
    time = 0.1 * torch.arange(1, 21, dtype=torch.float64)
    speed = torch.tensor([2.0, 3.0], dtype=torch.float64).expand(20, 2)
    position = torch.stack((50.0 + 2.0 * time, 3.0 * time), -1)
    drawn = lines(space_time(Trajectory(position, speed, speed, speed)))
    assert len(drawn) == 2
    np.testing.assert_allclose(drawn[0].get_segments()[0], [[0.1, 50.2], [0.2, 50.4]])
    rows = [
        {"run_id": "r", "vehicle_id": str(i), "time_s": float(t), "position_m": float(x), "speed_mps": 2.0}
        for i in range(2)
        for t, x in zip(time, position[:, i], strict=True)
    ]
    table = lines(space_time(pl.DataFrame(rows)))
    np.testing.assert_allclose(table[1].get_segments()[0], drawn[1].get_segments()[0])


def test_space_time_on_a_ring_draws_no_line_across_the_lap():
    position = torch.linspace(0.0, 25.0, 26).unsqueeze(-1)
    drawn = lines(space_time(Trajectory(position, position, position, position), ring_length=10.0))
    assert all(abs(segment[1, 1] - segment[0, 1]) < 2.0 for segment in drawn[0].get_segments())
    assert len(drawn[0].get_segments()) == 23


def rows(run, lane, vehicles, count=20):
    return [
        {"run_id": run, "lane": lane, "vehicle_id": f"{run}{lane}-{i}", "time_s": 0.1 * k, "position_m": 10.0 * i + k,
         "speed_mps": 10.0, "controlled": i == 1}
        for i in range(vehicles) for k in range(count)
    ]  # fmt: skip


def test_panels_are_one_per_run_and_lane_the_largest_first(tmp_path):
    table = pl.DataFrame(rows("a", 1, 2) + rows("a", 2, 5) + rows("b", 1, 3))
    found = panels(table.sample(fraction=1.0, shuffle=True, seed=0))
    assert [p.title for p in found] == ["run a, lane 2, 5 vehicles", "run b, lane 1, 3 vehicles",
                                        "run a, lane 1, 2 vehicles"]  # fmt: skip
    assert all((np.diff(line.time) > 0).all() for p in found for line in p.lines)
    assert [line.marked for line in found[0].lines] == [False, True, False, False, False]
    axes = space_time(found).axes
    assert [a.get_title() for a in axes[:3]] == [p.title for p in found]
    assert axes[0].get_legend().get_texts()[0].get_text() == "controlled"
    assert len([a for a in space_time(found, most=2).axes if a.get_title()]) == 2


def test_the_interactive_page_holds_what_was_drawn_and_needs_no_network(tmp_path):
    found = panels(pl.DataFrame(rows("a</script>", 1, 3)))
    write_html(tmp_path / "x.html", found, "x")
    page = (tmp_path / "x.html").read_text()
    assert "http" not in page and page.count("</script>") == page.count("<script")
    data = json.loads(page.split('id="measured">')[1].split("</script>")[0])
    (panel,) = data["panels"]
    line = panel["vehicles"][2]
    place = np.frombuffer(base64.b64decode(line["place"]), "<u2") / 65535 * np.ptp(panel["place"]) + panel["place"][0]
    np.testing.assert_allclose(place, found[0].lines[2].position, atol=1e-3)
    assert line["name"] == "a</script>1-2" and panel["vehicles"][1]["marked"]


def test_pictures_and_interactive_pages_begin_near_0_and_say_what_is_subtracted(tmp_path):
    """A clock since 1970 and a place on a motorway, by one rule; what lies near 0 is left alone."""
    table = pl.DataFrame(rows("a", 1, 3))
    far = panels(table.with_columns(pl.col("time_s") + 1.7e9, pl.col("position_m") + 5e4))
    write_html(tmp_path / "x.html", far, "x")
    (panel,) = json.loads((tmp_path / "x.html").read_text().split('id="measured">')[1].split("</script>")[0])["panels"]
    axes = space_time(far).axes[0]
    assert panel["names"] == [axes.get_xlabel(), axes.get_ylabel()]
    assert panel["names"] == ["time − 1700000000 s (s)", "position − 50000 m (m)"]
    assert panel["offsets"] == [1.7e9, 5e4] and axes.get_xlim()[0] < 1.0
    assert space_time(panels(table)).axes[0].get_xlabel() == "time (s)"


def test_a_table_without_speed_is_an_error():
    with pytest.raises(ValueError, match="no column 'speed_mps'"):
        space_time(pl.DataFrame({"vehicle_id": [1], "time_s": [0.0], "position_m": [0.0]}))


def test_arrows_show_who_has_changed_lanes():
    env = gym.make(
        "DiffIDM-v0", task="highway", vehicles=2, length=2000.0, controlled=[1], lanes_count=3, lane_commands=True,
        render_mode="rgb_array",
    )  # fmt: skip
    env.reset(seed=1)
    env.render()
    seen = []
    for _ in range(25):
        env.step(np.array([0.0, 1.0], np.float32))
        seen.append(int((env.render() == np.array([208, 60, 150])).all(-1).sum()))
    # The one change, in the first step, is shown for a second.
    assert env.unwrapped.state.lanes.changed[0, 1] == 1
    shown = np.flatnonzero(seen)
    assert 8 <= len(shown) <= 12 and (np.diff(shown) == 1).all()


def test_lanes_have_a_panel_each_and_changes_go_on_in_another():
    time = torch.arange(20)
    position = torch.stack((10.0 * time, 5.0 * time, 1.0 * time), -1)
    lane = torch.zeros(20, 3, dtype=torch.int64)
    lane[8:, 1] = 1
    there = torch.ones(20, 3)
    there[12:, 2] = 0
    position[15:, 0] -= 140.0  # the slot begins another trip
    rollout = Trajectory(position, torch.ones(20, 3), torch.zeros(20, 3), position)
    left, right = lane_panels(rollout, lane, there, dt=1.0, marked=[1])
    assert left.title.startswith("lane 1") and right.title.startswith("lane 0")
    assert [(x.name, len(x.time), x.marked) for x in left.lines] == [("1", 12, True)]
    assert sorted((x.name, len(x.time)) for x in right.lines) == [("0", 15), ("0, trip 2", 5), ("1", 9), ("2", 12)]
    assert right.title == "lane 0, 4 vehicles"
    assert right.lines[2].time[-1] == left.lines[0].time[0] == 9.0  # a change leaves no hole


def test_a_road_is_drawn_to_scale_with_numbers_along_it():
    """A vehicle of 5 m by 1.9 m has these sides in pixels of one scale, where the road is no longer than the view."""
    env = gym.make("DiffIDM-v0", task="highway", vehicles=2, lanes_count=4, length=500.0, render_mode="rgb_array")
    env.reset(seed=1)
    picture = env.render()[72:].astype(int)
    assert picture.shape[1] == 1000
    frame = np.argwhere(np.abs(picture - BLUE).sum(-1) < 10)
    height, width = np.ptp(frame, axis=0) + 1 - 6  # the frame is 3 pixels wide
    length = float(env.unwrapped.state.length[0, env.unwrapped.task.agents[0]])
    assert width / height == pytest.approx(length / 1.9, rel=0.2)
    ink = (np.abs(picture - np.array([30, 32, 36])).sum(-1) < 10)[4 * 20 + 3 : 4 * 20 + 9]
    assert ink.all(0).sum() in (8, 9)  # a tick every 20 m of the 170 m around the agent


@pytest.mark.parametrize("task", ["ring", "follow"])
def test_a_crash_is_marked_where_it_happens(task):
    env = gym.make("DiffIDM-v0", task=task, render_mode="rgb_array", **({"warmup": 0} if task == "ring" else {}))
    env.reset(seed=1)

    viewer, state = Viewer("rgb_array"), env.unwrapped.state

    def marked(state):
        return int((viewer.show(env.unwrapped.task, state) == np.array([255, 210, 0])).all(-1).sum())

    gap = state.gap.clone()
    gap[0, env.unwrapped.task.agents[0]] = -0.1
    assert marked(state) == 0 and 100 < marked(state._replace(gap=gap)) < 600


@pytest.mark.usefixtures("torch_path")
def test_a_signal_and_a_closed_lane_are_drawn_while_they_hold():
    """The line is red for 30 s of 60 and green for as long; a stretch is closed from 2 to 4 s."""
    env = gym.make("DiffIDM-v0", task="approach", render_mode="rgb_array")
    env.reset(seed=1)
    red, green = (np.array(c) for c in ((225, 25, 25), (40, 200, 110)))
    lit = []
    for _ in range(60):
        env.step(env.action_space.sample() * 0)
        picture = env.render()
        lit.append(tuple((picture == c).all(-1).any() for c in (red, green)))
    assert lit.count((True, False)) == lit.count((False, True)) == 30
    closures = [{"lane": 1, "begin": 100.0, "end": 200.0, "since": 2.0, "until": 4.0}]
    env = gym.make("DiffIDM-v0", task="open_highway", closures=closures, render_mode="rgb_array")
    env.reset(seed=1)
    closed = []
    for _ in range(5):
        env.step(env.action_space.sample() * 0)
        closed.append(int((env.render() == np.array([150, 130, 120])).all(-1).sum()))
    assert closed[0] == closed[3] == closed[4] == 0 and closed[1] > 100 and closed[2] > 100


def test_a_road_that_ends_has_a_window_around_an_agent_and_nobody_beyond_its_end():
    env = gym.make("DiffIDM-v0", task="merge", render_mode="rgb_array")
    env.reset(seed=1)
    while not (env.unwrapped.state.position > 900.0).any():
        env.step(None)
    picture = env.render()
    assert (picture[72:108, 986:] == np.array([244, 243, 238])).all()  # no vehicle, and no road, from 900 m on
    window = picture[162:222].astype(int)
    assert blue(window) > 100


def test_a_window_shows_a_step_of_a_second_in_ten_pictures(monkeypatch):
    shown = []
    monkeypatch.setattr(Viewer, "_display", lambda self, canvas, frames: shown.append((canvas, frames)))
    env = gym.make("DiffIDM-v0", task="merge", render_mode="human")
    env.reset(seed=1)
    first = len(shown)
    env.step(None)
    pictures = {canvas.get_buffer().raw for canvas, _ in shown[first:]}
    assert first == 1 and [frames for _, frames in shown] == [10] * 11 and len(pictures) == 10


def test_axes_begin_at_0_with_the_offset_in_the_label():
    """A clock of seconds since 1970, and places far from an origin, would fill the axis with digits."""
    table = pl.DataFrame(rows("a", 1, 2)).with_columns(pl.col("time_s") + 1113433186.0, pl.col("position_m") - 8420.0)
    axes = space_time(table).axes[0]
    assert axes.get_xlabel() == "time − 1113433186 s (s)" and axes.get_ylabel() == "position + 8420 m (m)"
    assert -1.0 < axes.get_xlim()[0] <= 0.0 and axes.get_xlim()[1] < 3.0
    near = space_time(pl.DataFrame(rows("a", 1, 2))).axes[0]
    assert (near.get_xlabel(), near.get_ylabel()) == ("time (s)", "position (m)")
