"""Counters as randomness: the same numbers in any order, independent streams, and the right distribution."""

import pytest
import torch

from idm_env.compiled.kernels import threads
from idm_env.tasks import Draw, random


def draw(count, episode=0):
    return Draw.of(torch.arange(count), torch.full((count,), episode))


def test_blocks_give_what_single_steps_give():
    step = torch.tensor([-3, 0, 40])
    block = draw(3).normals(step, 6, 5, torch.float64)
    for t in range(6):
        assert torch.equal(block[t], draw(3).normals(step + t, 1, 5, torch.float64)[0])


def test_normals_are_the_same_however_many_are_made_at_once(monkeypatch):
    draw, step = Draw.of(torch.arange(5), torch.zeros(5, dtype=torch.int64)), torch.arange(5) - 2
    whole = draw.normals(step, 9, 7, torch.float32)
    monkeypatch.setattr(random, "_AT_ONCE", 50)
    assert torch.equal(draw.normals(step, 9, 7, torch.float32), whole)
    assert draw.normals(step, 0, 7, torch.float32).shape == (0, 5, 7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_hashes_and_threads_give_the_bits_of_torch(monkeypatch, dtype):
    draw, step, pieces = Draw.of(torch.arange(5), torch.arange(5) - 2), torch.arange(5) - 9, []
    whole, split = draw.normals(step, 9, 7, dtype), threads.split
    monkeypatch.setattr(threads, "count", lambda work: 3)
    monkeypatch.setattr(
        threads, "split", lambda run, *how: split(lambda *ends: (pieces.append(ends), run(*ends)), *how)
    )
    with torch.inference_mode():
        assert torch.equal(draw.normals(step, 9, 7, dtype), whole)
    assert sorted(pieces) == [(0, 3), (3, 6), (6, 9)]
    monkeypatch.setattr(random, "may_run", lambda: False)
    assert torch.equal(draw.normals(step, 9, 7, dtype), whole)


def test_rows_are_what_a_single_environment_draws():
    many = draw(7).normals(torch.zeros(7, dtype=torch.int64), 2, 22, torch.float64)
    one = Draw.of(torch.tensor([4]), torch.tensor([0])).normals(torch.zeros(1, dtype=torch.int64), 2, 22, torch.float64)
    torch.testing.assert_close(many[:, 4], one[:, 0], rtol=0, atol=1e-14)


def test_normals_are_normal_and_independent():
    x = draw(400).normals(torch.zeros(400, dtype=torch.int64), 50, 22, torch.float64)
    assert abs(float(x.mean())) < 0.01
    assert abs(float(x.std()) - 1.0) < 0.01
    assert abs(float((x**4).mean()) - 3.0) < 0.1
    for shifted in (x.roll(1, 0), x.roll(1, 1), x.roll(1, 2), x.flip(2)):
        assert abs(float((x * shifted).mean())) < 0.01
    other = draw(400, episode=1).normals(torch.zeros(400, dtype=torch.int64), 50, 22, torch.float64)
    assert abs(float((x * other).mean())) < 0.01


def test_uniforms_are_uniform_and_streams_differ():
    u, other = draw(5000).uniforms(1, 4, torch.float64), draw(5000).uniforms(2, 4, torch.float64)
    assert 0.0 < float(u.min()) < float(u.max()) < 1.0
    assert abs(float(u.mean()) - 0.5) < 0.01
    assert abs(float(u.var()) - 1 / 12) < 0.003
    assert abs(float(((u - 0.5) * (other - 0.5)).mean())) < 0.003


def test_float32_draws_the_same_numbers():
    step = torch.zeros(50, dtype=torch.int64)
    exact, single = (draw(50).normals(step, 4, 22, dtype) for dtype in (torch.float64, torch.float32))
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=2e-5)
