"""Laws are about the one source of the mathematics, ``Simulator.step``; kernels are held to it by their own tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from idm_env.compiled.kernels import dispatch


@pytest.fixture(autouse=True)
def torch_path() -> Iterator[None]:
    """Run every rollout by repeated steps."""
    with dispatch.off("laws are tested on the torch path"):
        yield
