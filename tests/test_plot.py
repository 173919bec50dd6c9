"""Pictures for teaching: what a diagram counts is what the traffic does, and the animation moves."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from idm_env.data import synthetic
from idm_env.plot import animate, edie, fundamental_diagram
from idm_env.reports.diagrams import Panel, VehicleLine, axes_of


def uniform(vehicles: int, speed: float, ring: float | None = 200.0) -> Panel:
    """Vehicles 10 m apart at one speed."""
    time = 0.5 * np.arange(401)
    lines = [VehicleLine(str(i), time, 10.0 * i + speed * time, np.full(401, speed)) for i in range(vehicles)]
    return Panel("", tuple(lines), ring)


@pytest.mark.parametrize(("vehicles", "speed"), [(4, 0.0), (10, 5.0), (20, 13.0)])
def test_flow_is_density_times_speed(vehicles: int, speed: float) -> None:
    """On a ring every cell holds all vehicles for all of its time, whatever laps they end."""
    density, flow = edie([uniform(vehicles, speed)], seconds=50.0)
    assert len(density) >= 3
    np.testing.assert_allclose(density, vehicles / 200.0, rtol=0.02)
    np.testing.assert_allclose(flow, speed * density, rtol=1e-9)


def test_a_lane_is_cut_into_cells_and_a_short_one_is_refused() -> None:
    """In the midst of an endless column density is one vehicle in 10 m."""
    density, _ = edie([uniform(80, 4.0, None)], seconds=20.0, metres=100.0)
    assert np.median(density) == pytest.approx(0.1, rel=0.05)
    with pytest.raises(ValueError, match=r"no cell of 900 s by 100 m is whole\. Give smaller"):
        fundamental_diagram([uniform(3, 4.0)], seconds=900.0, metres=100.0)


def test_a_table_is_drawn_with_units_and_an_animation_moves(tmp_path: Path) -> None:
    """Axes say what they count; pictures of a ring differ from second to second."""
    made, _ = synthetic.generate(1, runs=1, followers=2, seconds=30.0)
    axes = fundamental_diagram(made, seconds=5.0).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("density (vehicles/km)", "flow (vehicles/h)")
    assert axes.get_xlim()[0] == axes.get_ylim()[0] == 0.0 and len(axes.lines[0].get_xdata())
    for name, data in (("ring", [uniform(10, 5.0)]), ("lane", made)):
        animate(data, every=10.0).save(tmp_path / f"{name}.gif", "pillow")
        with Image.open(tmp_path / f"{name}.gif") as shown:
            first = np.asarray(shown.convert("RGB"))
            shown.seek(1)
            assert shown.n_frames >= 3 and (np.asarray(shown.convert("RGB")) != first).any()


def test_times_of_all_panels_have_one_origin() -> None:
    """Of which one lane is used late and for a while only."""
    late = [VehicleLine("9", 1000.0 + np.arange(20.0), np.arange(20.0), np.ones(20))]
    drawn = [uniform(3, 4.0), Panel("late", tuple(late), None)]
    assert {axes_of(panel, drawn)[1][0] for panel in drawn} == {"time (s)"}
    assert axes_of(drawn[1], drawn[1:])[1][0] == "time − 1000 s (s)"
