"""A step that is replayed is the step: values, gradients, second derivatives. Recording itself needs a GPU (test_gpu).

On a CPU what was recorded is run again, in the same tensors: all but CUDA's own part is tried.
"""

from __future__ import annotations

import copy

import pytest
import torch

from idm_env.envs import cuda_graph
from idm_env.envs.cuda_graph import Replayed
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.tasks import TASKS


@pytest.fixture(autouse=True)
def run_again(monkeypatch):
    """Run again what was recorded."""
    monkeypatch.setattr(cuda_graph, "recorded", lambda run: run)
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")


def driven(task: str, replay: bool) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Return what six steps tell, and the gradient of their rewards by the action of each."""
    env = DiffIDMVectorEnv(3, task=task, output="torch", dtype="float64", **({"warmup": 1} if task == "ring" else {}))
    env.reset(seed=4)
    if replay:
        env.batch._step = Replayed(env.batch._stepped)
    actions = torch.linspace(-0.5, 0.5, 6, dtype=torch.float64).requires_grad_()
    told: list[torch.Tensor] = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action.expand(env.action_space.shape))
        told += [observation, reward, terminated, truncated]
    total = sum(x.sum() for x in told[1::4])
    return [x.detach() for x in told], torch.autograd.grad(total, actions)[0]


@pytest.mark.parametrize("task", TASKS)
def test_a_replayed_step_is_the_step_to_the_bit(task):
    mine, other = driven(task, True), driven(task, False)
    assert all(torch.equal(x, y) for x, y in zip(mine[0], other[0], strict=True))
    torch.testing.assert_close(mine[1], other[1], rtol=1e-12, atol=1e-12)
    assert task == "replay_lanes" or bool(mine[1].any())


def squares(x: torch.Tensor, more: dict, twice: bool):
    """Return a function's results of every kind: made, passed on, whole numbers, none and plain ones."""
    y = x * x * more["factor"] * (2.0 if twice else 1.0)
    return {"made": y, "passed": x, "whole": (y > 1.0).long(), "none": None, "plain": twice}, (y.sum(), more["factor"])


def test_results_of_every_kind_come_back_with_gradients_of_every_order():
    replayed = Replayed(squares)
    x, factor = torch.tensor([1.0, 2.0], requires_grad=True), torch.tensor(3.0, requires_grad=True)
    told, (total, same) = replayed(x, {"factor": factor}, True)
    assert told["passed"] is x and same is factor and told["none"] is None and told["plain"] is True
    assert told["whole"].tolist() == [1, 1] and total.item() == 30.0
    first = torch.autograd.grad(total + told["made"].sum(), (x, factor), create_graph=True)
    assert first[0].tolist() == [24.0, 48.0] and first[1].item() == 20.0
    assert torch.autograd.grad(first[0].sum(), (x, factor))[0].tolist() == [24.0, 24.0]
    once, _ = replayed(x, {"factor": factor}, False)  # another plain argument is another form
    assert once["made"].tolist() == [3.0, 12.0] and told["made"].tolist() == [6.0, 24.0]
    assert len(replayed._forms) == 2 and len(copy.deepcopy(replayed)._forms) == 0


def test_an_argument_that_was_written_to_is_read_again():
    replayed = Replayed(lambda x: x + 1.0)
    x = torch.zeros(2)
    assert replayed(x).tolist() == [1.0, 1.0]
    x += 1.0
    assert replayed(x).tolist() == [2.0, 2.0]


def test_a_gradient_is_that_of_its_own_call_after_later_ones():
    replayed = Replayed(lambda x: x**3)
    first, second = torch.tensor(2.0, requires_grad=True), torch.tensor(5.0, requires_grad=True)
    cubes = replayed(first), replayed(second)
    assert [float(torch.autograd.grad(y, x)[0]) for y, x in zip(cubes, (first, second), strict=True)] == [12.0, 75.0]


def test_what_cannot_be_recorded_is_called_and_told(monkeypatch):
    def refused(run):
        raise RuntimeError("operation not permitted when stream is capturing.\nmore")

    monkeypatch.setattr(cuda_graph, "recorded", refused)
    replayed = Replayed(lambda x: x + 1.0)
    with pytest.warns(UserWarning, match="no CUDA graph of a step.*: operation not permitted when stream is capturing"):
        assert float(replayed(torch.zeros(()))) == 1.0
    assert float(replayed(torch.ones(()))) == 2.0
