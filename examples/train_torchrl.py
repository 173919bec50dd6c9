"""Train with TorchRL: PPO on a batch of 16 rings, which TorchRL wraps as it wraps any vector of Gymnasium."""

import gymnasium
import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, GymWrapper
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import idm_env  # noqa: F401 (registers DiffIDM-v0)

RING = {"task": "ring", "warmup": 1000, "failsafe": 3.0, "max_episode_steps": 500, "info": "none"}
COUNT, STEPS, EPOCHS, PIECES = 16, 500, 5, 8


class Widths(nn.Module):
    """Gives a mean the standard deviation that goes with it, which is learned but does not depend on what is seen."""

    def __init__(self) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.full((1,), -2.5))

    def forward(self, mean: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return mean, self.log.exp().expand_as(mean)


def actor_of(env: EnvBase) -> ProbabilisticActor:
    """Return a Gaussian policy that begins by commanding almost nothing."""
    body = MLP(in_features=env.observation_spec["observation"].shape[-1], out_features=1, num_cells=[32, 32])
    with torch.no_grad():
        body[-1].weight.mul_(0.01)
    net = TensorDictModule(nn.Sequential(body, Widths()), in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        net, in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )  # fmt: skip


def train(updates: int, seed: int = 0) -> list[tuple[int, float]]:
    """Train; return (steps of all rings so far, mean reward of a step), one row per update."""
    torch.manual_seed(seed)
    env = GymWrapper(gymnasium.make_vec("DiffIDM-v0", num_envs=COUNT, **RING))
    env.set_seed(seed)
    actor = actor_of(env)
    critic = ValueOperator(MLP(in_features=3, out_features=1, num_cells=[64, 64]), in_keys=["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.0, critic_coeff=0.5)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    rows: list[tuple[int, float]] = []
    # No worker processes: a step of the native vector is a step of all rings.
    batch = COUNT * STEPS
    collector = Collector(
        env, actor, frames_per_batch=batch, total_frames=updates * batch, auto_register_policy_transforms=False
    )
    for seen in collector:
        for _ in range(EPOCHS):
            with torch.no_grad():
                advantage(seen)
            for part in seen.reshape(-1)[torch.randperm(seen.numel())].chunk(PIECES):
                found = loss(part)
                optimiser.zero_grad()
                (found["loss_objective"] + found["loss_critic"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
        rows.append(((len(rows) + 1) * batch, float(seen["next", "reward"].mean())))
    return rows


if __name__ == "__main__":
    for steps, reward in train(2):
        print(f"{steps} steps: mean reward {reward:.3f}")
