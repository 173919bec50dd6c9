"""Fixtures for all tests: the measured files, which are not part of the project and may be absent."""

from __future__ import annotations

import gc
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

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


def pytest_collection_finish() -> None:
    """Keep what the imports made out of every later collection of garbage, which then takes milliseconds."""
    gc.collect()
    gc.freeze()


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
