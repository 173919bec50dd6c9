"""Model-free baselines: Stable-Baselines3's PPO and SAC through ``idm_env.envs.sb3``.

They see the same observations in the same fixed normalisation, get the same reward, are stopped by the same clock and
judged by the same test as the agents that differentiate. After every chunk of learning the actor is copied into a
``Policy``, so that all agents leave the same files; ``learner.pt`` beside them is for ``resume``. It holds tensors and
numbers only: SB3's own files are pickles, which run whatever code somebody has put into them.

``python -m agents.ppo --config configs/ring-ppo.yaml --seed 1``
"""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples, RolloutBufferSamples
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn

from agents import common, environments
from agents.common import DivergedError
from agents.monitor import Monitor
from agents.policy import ACTIVATIONS, Policy
from idm_env.envs.sb3 import SB3VecEnv
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.jobs import storage
from idm_env.tasks import Task
from idm_env.validation import nearest


@dataclass
class Arguments(common.Arguments):
    """Arguments of PPO and SAC; names are those of Stable-Baselines3.

    Args:
        algorithm: ppo or sac.
        count: Environments that run together.
        hold: Steps for which an action is held in training; what learns sees one decision, and the sum of their
            rewards. Noise that is drawn anew at every step of 0.1 s moves no vehicle and is paid for in full. The
            policy is judged deciding at every step.
        n_steps: Decisions of each environment between updates (PPO), or in a chunk of learning (SAC).
        gamma: Discount per decision.
        activation: tanh or relu.
        batch_size: Samples of a gradient step.
        gae_lambda: Of PPO's advantages.
        n_epochs: Passes of PPO over its samples.
        clip_range: Of PPO's ratio.
        ent_coef: Weight of entropy: a number, or auto for SAC.
        log_std_init: Logarithm of PPO's first standard deviation of actions.
        anneal: The logarithm of that deviation falls evenly to ``log_std_last`` instead of being learned. What is
            learned falls to nothing, for noise costs effort at once and pays later, if ever.
        log_std_last: Logarithm of the last standard deviation, with ``anneal``.
        use_sde: Exploration that depends on the state instead of white noise.
        gradient_steps: Gradient steps of SAC per step of all environments.
        learning_starts: Samples that SAC collects before it learns.
    """

    out: Path = Path("runs/ppo")
    learning_rate: float = 1e-3
    clip: float = 0.5
    algorithm: Literal["ppo", "sac"] = "ppo"
    count: int = 64
    hold: int = 1
    n_steps: int = 300
    gamma: float = 0.999
    activation: str = "tanh"
    batch_size: int = 4800
    gae_lambda: float = 0.95
    n_epochs: int = 10
    clip_range: float = 0.2
    ent_coef: str = "0.0"
    log_std_init: float = -1.0
    anneal: bool = False
    log_std_last: float = -3.0
    use_sde: bool = False
    gradient_steps: int = 1
    learning_starts: int = 6400

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, words in (("algorithm", ("ppo", "sac")), ("activation", tuple(ACTIVATIONS))):
            if getattr(self, name) not in words:
                value = getattr(self, name)
                raise ValueError(f"{name} = '{value}' is unknown.{nearest(value, words)}")


class Normalised(BaseFeaturesExtractor):
    """Observations in the fixed normalisation of a ``Policy``."""

    mean: Tensor
    scale: Tensor

    def __init__(self, space: gymnasium.spaces.Box, mean: Sequence[float], scale: Sequence[float]) -> None:
        super().__init__(space, space.shape[0])
        self.register_buffer("mean", torch.tensor(mean))
        self.register_buffer("scale", torch.tensor(scale))

    def forward(self, observation: Tensor) -> Tensor:
        """Return ``(o − m) / s``."""
        return (observation - self.mean) / self.scale


class Desynchronised(SB3VecEnv):
    """The adapter, with the clocks of the first episodes set apart as for the agents that differentiate.

    Every action is held for ``hold`` steps, whose rewards are summed. An episode that ends before them is over for the
    learner at once; the next one begins under the action that is still held, unpaid.
    """

    def __init__(self, vector_env: DiffIDMVectorEnv, hold: int = 1) -> None:
        super().__init__(vector_env)
        self.hold = hold

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step ``hold`` times, and reset what ended; return observations, sums of rewards, dones and infos."""
        observation, reward, done, infos = super().step_wait()
        for _ in range(self.hold - 1):
            observation, more, ended, details = super().step_wait()
            reward = np.where(done, reward, reward + more)
            infos = [before if over else now for over, before, now in zip(done, infos, details, strict=True)]
            done = done | ended
        return observation, reward, done, infos

    def reset(self) -> np.ndarray:
        """Begin episodes at different clocks."""
        super().reset()
        return np.asarray(environments.desynchronise(cast(DiffIDMVectorEnv, self.vector_env)))


class Shared(Desynchronised):
    """The adapter with every agent of every environment a row of its own: one policy, and the reward of their team.

    Where vehicles enter and leave, an agent's episode ends with its trip; ``OnTheRoad`` leaves out what lies between.
    """

    def __init__(self, vector_env: DiffIDMVectorEnv, hold: int = 1) -> None:
        super().__init__(vector_env, hold)
        self.worlds, self.agents = vector_env.num_envs, len(vector_env.task.agents)
        self.num_envs = self.worlds * self.agents
        bounds = vector_env.task.bounds
        self.observation_space = gymnasium.spaces.Box(
            np.array(bounds.low, np.float32), np.array(bounds.high, np.float32)
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.present = present_in(vector_env.task)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the environments, one after the other."""
        self._seeds = [None if seed is None else seed + i for i in range(self.worlds)]
        return self._seeds

    def reset(self) -> np.ndarray:
        """Begin episodes at different clocks."""
        return super().reset().reshape(self.num_envs, -1)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for ``step_wait``."""
        super().step_async(actions.reshape(self.worlds, self.agents))

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step, and reset what ended; return observations, rewards, dones and infos of every agent."""
        observation, reward, done, infos = super().step_wait()
        details: list[dict[str, Any]] = []
        for info in infos:
            last = info.get("terminal_observation")
            rows = [None] * self.agents if last is None else last.reshape(self.agents, -1)
            details += [info if row is None else {**info, "terminal_observation": row} for row in rows]
        reward, done = (np.repeat(x, self.agents) for x in (reward, done))
        observation = observation.reshape(self.num_envs, -1)
        away = False if self.present is None else observation[:, self.present] <= 0.0
        return observation, reward, done | away, details


def present_in(task: Task) -> int | None:
    """Return which entry of an agent's observation tells whether it is on the road; None where all always are."""
    names = task.bounds.names
    return names.index("present") if "present" in names else None


_DRAWS = 100
"""Draws of a batch before SAC takes what it finds."""


class OnTheRoad(RolloutBuffer):
    """PPO's samples, of which those count whose agent is on the road: its observation's ``present`` is above 0."""

    def __init__(self, *sizes: Any, present: int, **keywords: Any) -> None:
        self.present = present
        super().__init__(*sizes, **keywords)

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """Yield batches without whoever is away, so that neither loss nor advantages' mean and deviation see him."""
        for samples in super().get(batch_size):
            present = samples.observations[:, self.present] > 0.0
            if int(present.sum()) > 1:
                yield RolloutBufferSamples(*(part[present] for part in samples))


class RoadReplay(ReplayBuffer):
    """SAC's memory, of which those samples are drawn whose agent was on the road."""

    def __init__(self, *sizes: Any, present: int, **keywords: Any) -> None:
        self.present = present
        super().__init__(*sizes, **keywords)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw until so many are found; whoever is away at all draws of a memory that holds nobody else is taken."""
        parts, count = list[list[Any]](), 0
        for _ in range(_DRAWS):
            batch = super().sample(batch_size, env)
            present = batch.observations[:, self.present] > 0.0
            parts.append([None if x is None else x[present] for x in batch])
            count += int(present.sum())
            if count >= batch_size:
                columns: Any = zip(*parts, strict=True)
                cut: list[Any] = [None if x[0] is None else torch.cat(x)[:batch_size] for x in columns]
                return ReplayBufferSamples(*cut)
        return batch


class RoadRewards(VecNormalize):
    """Rewards over the running deviation of returns, of agents that are on the road."""

    def __init__(self, vector: VecEnv, present: int | None, gamma: float) -> None:
        super().__init__(vector, norm_obs=False, gamma=gamma)
        self._present = present

    def _update_reward(self, reward: np.ndarray) -> None:
        """Count the returns of those who are there after a step."""
        self.returns = self.returns * self.gamma + reward
        present = ... if self._present is None else self.old_obs[:, self._present] > 0.0  # type: ignore[index]
        if np.size(self.returns[present]):
            self.ret_rms.update(self.returns[present])


def make_model(arguments: Arguments, env: VecEnv, policy: Policy, present: int | None = None) -> BaseAlgorithm:
    """Return SB3's algorithm, its actor of the size and the normalisation of ``policy``; ``present`` as above."""
    net: dict[str, Any] = {
        "net_arch": list(arguments.hidden),
        "activation_fn": ACTIVATIONS[arguments.activation],
        "features_extractor_class": Normalised,
        "features_extractor_kwargs": {"mean": policy.mean.tolist(), "scale": policy.scale.tolist()},
    }
    same: dict[str, Any] = {
        "learning_rate": arguments.learning_rate, "gamma": arguments.gamma, "batch_size": arguments.batch_size,
        "use_sde": arguments.use_sde, "seed": environments.first_seed(arguments.seed, 0), "device": "cpu",
    }  # fmt: skip
    entropy: Any = arguments.ent_coef if arguments.ent_coef.startswith("auto") else float(arguments.ent_coef)
    if arguments.algorithm == "sac":
        if present is not None:
            same |= {"replay_buffer_class": RoadReplay, "replay_buffer_kwargs": {"present": present}}
        return SAC(
            "MlpPolicy", env, policy_kwargs=net, ent_coef=entropy, gradient_steps=arguments.gradient_steps,
            learning_starts=arguments.learning_starts, **same,
        )  # fmt: skip
    net["log_std_init"] = arguments.log_std_init
    if present is not None:
        same |= {"rollout_buffer_class": OnTheRoad, "rollout_buffer_kwargs": {"present": present}}
    return PPO(
        "MlpPolicy", env, policy_kwargs=net, ent_coef=entropy, n_steps=arguments.n_steps, n_epochs=arguments.n_epochs,
        gae_lambda=arguments.gae_lambda, clip_range=arguments.clip_range, max_grad_norm=arguments.clip, **same,
    )  # fmt: skip


def layers(model: BaseAlgorithm, policy: Policy) -> list[tuple[nn.Linear, nn.Linear]]:
    """Return the linear layers of a policy, each with that of the SB3 model's actor."""
    parts: list[nn.Module]
    if isinstance(model, SAC):
        parts = [*model.actor.latent_pi, model.actor.mu]
    else:
        actor: Any = model.policy
        parts = [*actor.mlp_extractor.policy_net, actor.action_net]
    theirs = [p for p in parts if isinstance(p, nn.Linear)]
    ours = [p for p in policy.body if isinstance(p, nn.Linear)]
    return list(zip(ours, theirs, strict=True))


def set_deviation(model: BaseAlgorithm, arguments: Arguments, update: int) -> None:
    """Set PPO's standard deviation of actions for an update, where it is not learned."""
    if isinstance(model, PPO) and arguments.anneal:
        share = min(update / max(arguments.updates - 1, 1), 1.0)
        log_std: Any = model.policy.log_std
        log_std.requires_grad_(False)
        log_std.fill_(arguments.log_std_init + share * (arguments.log_std_last - arguments.log_std_init))


def check(model: BaseAlgorithm, update: int, kept: Path) -> None:
    """Raise DivergedError where a weight is not finite."""
    bad = [name for name, value in model.policy.named_parameters() if not bool(torch.isfinite(value).all())]
    if bad:
        raise DivergedError(
            f"update {update}: weights of {bad[0]} must be finite. {common.last_good(kept, update)} with a lower "
            "learning_rate."
        )


def copy_actor(model: BaseAlgorithm, policy: Policy, update: int, kept: Path) -> None:
    """Copy the actor of an SB3 model into a policy; DivergedError where a weight is not finite."""
    check(model, update, kept)
    for mine, other in layers(model, policy):
        mine.load_state_dict(other.state_dict())


MEMORY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of SAC's replay buffer."""


def learned(model: BaseAlgorithm, env: VecNormalize) -> dict[str, Any]:
    """Return what learning goes on with, as tensors and numbers."""
    rewards = env.ret_rms
    state: dict[str, Any] = {
        "schema": common.SCHEMA,
        "parameters": model.get_parameters(),
        "variables": {name: getattr(model, name).detach() for name in model._get_torch_save_params()[1]},
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "returns": [float(x) for x in (rewards.mean, rewards.var, rewards.count)],
    }
    if isinstance(model, SAC):
        memory: Any = model.replay_buffer
        state["memory"] = {name: torch.from_numpy(getattr(memory, name)[: memory.size()]) for name in MEMORY}
        state["place"] = memory.pos
    return state


def goes_on(model: BaseAlgorithm, env: VecNormalize, state: dict[str, Any]) -> None:
    """Put what ``learned`` returned into a new model."""
    model.set_parameters(state["parameters"], device="cpu")
    for name, value in state["variables"].items():
        getattr(model, name).data.copy_(value)
    model.num_timesteps, model._n_updates = int(state["steps"]), int(state["updates"])
    mean, variance, count = state["returns"]
    env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count = np.asarray(mean), np.asarray(variance), count
    if isinstance(model, SAC):
        memory: Any = model.replay_buffer
        for name in MEMORY:
            rows = state["memory"][name].numpy()
            getattr(memory, name)[: len(rows)] = rows
        memory.pos, memory.full = int(state["place"]), len(rows) == memory.buffer_size


def train(arguments: Arguments) -> list[dict[str, Any]]:
    """Train a policy; return the evaluations. ValueError and DivergedError say what went wrong, in one line."""
    began = time.process_time()
    torch.manual_seed(arguments.seed)
    name = arguments.algorithm
    squash = "tanh" if name == "sac" else "clip"
    policy, saved = common.begin(arguments, name, activation=arguments.activation, squash=squash)
    environment = environments.make_env(arguments.trained_in, arguments.count, output="numpy")
    present = present_in(environment.task)
    is_single = len(environment.task.agents) == 1 and present is None
    vector = (Desynchronised if is_single else Shared)(environment, arguments.hold)
    # Returns of 1/(1 − γ) rewards are large: both algorithms get rewards over the running deviation of returns.
    env = RoadRewards(vector, present, arguments.gamma)
    file, model = arguments.out / "learner.pt", make_model(arguments, env, policy, present)
    if saved:
        storage.read(file, lambda path: goes_on(model, env, torch.load(path, weights_only=True)), storage.AFRESH)
    elif arguments.clone or environment.task.as_driver:
        for mine, other in layers(model, policy):
            other.load_state_dict(mine.state_dict())
    chunk = arguments.n_steps * vector.num_envs
    steps = arguments.n_steps * arguments.count * arguments.hold
    done = model.num_timesteps // chunk
    if saved:  # an interruption between two files leaves the model one chunk ahead
        saved |= {"update": done - 1, "steps": done * steps}
    # Making or loading a model seeds its environments; these are the seeds of all agents, new ones after a resume.
    vector.seed(environments.first_seed(arguments.seed, arguments.count * (done + 1)))

    def store() -> None:
        storage.write(file, lambda path: torch.save(learned(model, env), path))

    with Monitor(name, arguments, began, saved) as monitor:
        if not saved:
            copy_actor(model, policy, -1, monitor.last)
            monitor.untrained(policy)
        for update in range(done, arguments.updates):
            rate = common.fall(arguments.learning_rate, update, arguments.updates)
            model.lr_schedule = FloatSchedule(rate)
            set_deviation(model, arguments, update)
            try:
                model.learn(chunk, reset_num_timesteps=False, log_interval=None)  # type: ignore[arg-type]
            except ValueError:  # SB3 meets weights that are not finite when it draws the next action
                check(model, update, monitor.last)
                raise
            copy_actor(model, policy, update, monitor.last)
            figures = {k: float(v) for k, v in model.logger.name_to_value.items() if "loss" in k or "std" in k}
            if not monitor.after(update, steps, policy, {}, {**figures, "learning_rate": rate}, store):
                break
    return monitor.history


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    common.command_line(train, Arguments, "ppo", argv)


if __name__ == "__main__":
    main()
