"""Fixtures for all tests: the measured files, which are not part of the project and may be absent."""

from __future__ import annotations

import gc
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# As many processes test as there are cores: a thread each, also in processes that tests begin. torch reads it once.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from idm_env.effects import ALL

# Examples are as many as a suite of minutes allows, and take as long as the machine is busy; fixtures that they share
# hold nothing that one of them changes.
settings.register_profile(
    "suite",
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("suite")


def measured_folder() -> Path:
    """The folder named by IDM_ENV_DATA, or shared/data beside the checkout."""
    named = os.environ.get("IDM_ENV_DATA")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def measured() -> Callable[[str], Path]:
    """Return the path of a measured file by name; the test is skipped, with a warning, where it is absent."""

    def find(name: str) -> Path:
        path = measured_folder() / name
        if not path.exists():
            message = f"measured file {name} is absent from {measured_folder()} (set IDM_ENV_DATA): test skipped"
            warnings.warn(message, stacklevel=2)
            pytest.skip(message)
        return path

    return find


LONG = ("test_discover", "test_bases", "test_traps", "test_cli", "test_wheel", "test_examples", "test_docs")
"""Files that take a minute each: they are begun first, so that none of them is waited for in the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with long files; otherwise the order stays."""
    items.sort(key=lambda item: item.path.stem not in LONG)


def pytest_collection_finish() -> None:
    """Keep what the imports made out of every later collection of garbage, which then takes milliseconds.

    What a compiler makes is walked through less often: that took a tenth of its time. Each test collects at its end.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)


@pytest.fixture
def torch_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile no environment's step, in processes of the test either: for laws that many programs would hold once each.

    Both paths are held equal by tests/kernels, tests/laws/test_printed.py and tests/envs/test_values.py.
    """
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")


@pytest.fixture(autouse=True)
def the_same_catalogue() -> Iterator[None]:
    """Effects that a test enters are gone after it."""
    before = dict(ALL)
    yield
    ALL.clear()
    ALL.update(before)


@pytest.fixture(autouse=True)
def nothing_left_open() -> Iterator[None]:
    """Collect what a test leaves behind within it: a file that it left open is its error, not that of a later test.

    What survives is kept out of later collections: a process that has compiled much holds millions of objects, and to
    walk through them after each test took most of the suite's time.
    """
    yield
    gc.collect()
    gc.freeze()
