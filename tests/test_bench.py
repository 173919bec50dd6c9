"""The benchmark runs, interleaves, and says what it did; no test here looks at a time."""

import json

import pytest

from benchmarks import bench
from benchmarks.bench import memory, peers, tables
from benchmarks.bench.measure import Case, measure
from tests.browser import check, there_is_one


def test_cases_take_turns():
    order = []
    cases = {name: Case(lambda name=name: order.append(name), 2.0) for name in "ab"}
    found = measure(cases, 3)
    assert order == ["a", "b"] * 4
    assert set(found) == {"a", "b"}
    assert all(v["cpu_min_ms"] <= v["cpu_median_ms"] and v["wall_min_ms"] >= 0 for v in found.values())


def test_growth_is_the_slope():
    part = {str(n): {"times_ms_per_step": {"x": {"cpu_min_ms": 3e-6 * n**1.5}}} for n in (2_000, 20_000, 200_000)}
    assert bench.growth(part)["x"] == pytest.approx(1.5)


def test_a_small_run_writes_json_and_picture(tmp_path, monkeypatch):
    for name in ("recorded_leaders", "corrected_models", "rings", "discovery"):
        monkeypatch.setattr(bench.fits, name, lambda *_: {})
    window = lambda: bench.gradients.of(bench.gradients.RING, 2, 3, True)  # noqa: E731
    monkeypatch.setattr(bench.gradients, "workloads", lambda: [("ring, 2 × 3", window)])
    lines, seen = [], []
    result = bench.run(
        tmp_path, sizes=(100, 200), rounds=1, compiled=False, others=False, verbose=True, say=lines.append,
        on_progress=lambda *at: seen.append(at),
    )  # fmt: skip
    written = json.loads((tmp_path / "performance.json").read_text())
    assert written["one_core"].keys() == {"100", "200"} == result["one_core"].keys()
    page = (tmp_path / "report.html").read_text()
    assert "200 vehicles, one core" in page and "{&#34;" not in page and "{'" not in page
    titles = [title for title, _, _ in tables.of(result)]
    assert titles[:3] == ["200 vehicles, one core", "100 vehicles, one core", titles[2]] and "wall time" in titles[2]
    assert seen[0][1] == 0 and [at[1] for at in seen] == sorted(at[1] for at in seen) and seen[-1][1:3] == (100, 100)
    assert tables.absent(result).startswith("Not measured: ")
    assert (tmp_path / "performance.png").stat().st_size > 5_000
    assert any("kernels run" in line or "kernels do not run:" in line for line in lines)
    assert any("eager" in row["path"] for row in tables.of(result)[0][1])
    assert result["gradient_error"]["kernel float64"] < 1e-10
    assert [row["way"] for row in result["gradient_steps"]] == ["env.step", "unroll"]
    assert any(title == "A step of environments with its gradients" for title in titles)
    if there_is_one():
        assert check.wrong([tmp_path / "report.html"]) == []


def test_the_torch_path_says_why_no_kernel_runs(monkeypatch):
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    lines = []
    made = bench._lanes(100, 1, False, True, lines.append)
    assert lines == ["100 vehicles: kernels do not run: IDM_ENV_KERNELS=0"]
    assert not any("kernel" in name for name in made["times_ms_per_step"])


@pytest.mark.skipif(not memory._STATUS.exists(), reason="Linux tells the peak of a process")
def test_memory_is_measured_in_a_process_of_its_own():
    found = memory.peaks((1_000_000,), 20)
    # Six parameters with gradients, four arrays of state and four of results, in float32: 80 B per vehicle, of which
    # memory that the allocator had at hand before is not seen.
    assert found["1000000"] > 0.6 * 1_000_000 * 80 / 2**20
    assert memory.peaks((2_000,), 20) == {}


def test_absent_peers_are_none(monkeypatch):
    monkeypatch.setattr(peers, "find_spec", lambda _: None)
    assert peers.diffidm_layer() is None and peers.sumo() is None and peers.highway_rate() is None


def test_sizes_must_be_whole_lanes():
    with pytest.raises(ValueError, match=r"size 70 is no multiple of 50"):
        bench.run(sizes=(70,))
