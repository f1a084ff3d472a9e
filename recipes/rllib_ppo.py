"""RLlib's PPO with action masks on the PettingZoo environment.

python recipes/rllib_ppo.py

All robots share one policy. The module below reads the mask from the observation and never samples
what it forbids. Needs the extra "rllib" (docs/adapters.md, "RLlib").
"""

from __future__ import annotations

import sys
from typing import Any

import torch
import tyro
from torch import Tensor, nn

try:
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.columns import Columns
    from ray.rllib.core.rl_module.apis import ValueFunctionAPI
    from ray.rllib.core.rl_module.rl_module import RLModuleSpec
    from ray.rllib.core.rl_module.torch import TorchRLModule
    from ray.rllib.env import EnvContext
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    from ray.tune.registry import register_env
except ModuleNotFoundError as error:
    sys.exit(f'error: this program needs {error.name}: pip install "marl-explore[rllib]"')

from marl_explore import ArenaConfig, parallel_env

STEPS, BATCH = 25, 400
"""Length of an episode; team steps per update."""
FORBIDDEN = torch.finfo(torch.float32).min
"""The logit of a forbidden action: its probability is 0, and its gradient finite."""


def exploration(context: EnvContext) -> ParallelPettingZooEnv:
    """The environment in RLlib: one per process, each with arenas of its own."""
    arena = ArenaConfig(height=6, width=6, num_agents=3, communication_range=2.0)
    first = context.worker_index
    return ParallelPettingZooEnv(
        parallel_env(arena, "team", STEPS, fpr="proximity", first_arena=first)
    )


class MaskedActorCritic(TorchRLModule, ValueFunctionAPI):
    """An actor that respects the action mask, and a critic, both of one robot's observation."""

    def setup(self) -> None:
        """Make the networks."""
        observed: Any = self.observation_space
        actions: Any = self.action_space
        features = observed["observation"].shape[0]
        self.actor = mlp(features, actions.n)
        self.critic = mlp(features, 1)

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Tensor]:
        seen = batch[Columns.OBS]
        logits = self.actor(seen["observation"])
        return {Columns.ACTION_DIST_INPUTS: logits.masked_fill(seen["action_mask"] == 0, FORBIDDEN)}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Tensor:
        """The value of every observation, float [B]."""
        return self.critic(batch[Columns.OBS]["observation"]).squeeze(-1)


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers of 64."""
    layers = (nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
    return nn.Sequential(*layers, nn.Linear(64, outputs))


def settings(workers: int, seed: int) -> PPOConfig:
    """RLlib's settings: who collects, and how the shared policy learns."""
    register_env("exploration", exploration)
    return (
        PPOConfig()
        .environment("exploration")
        .debugging(seed=seed)
        .env_runners(num_env_runners=workers)  # more arenas per process would be the same ones
        .multi_agent(policies={"robot"}, policy_mapping_fn=lambda *_, **__: "robot")
        .rl_module(rl_module_spec=RLModuleSpec(module_class=MaskedActorCritic))
        .training(
            train_batch_size_per_learner=BATCH,
            minibatch_size=300,
            num_epochs=10,
            lr=1e-3,
            gamma=0.95,
            lambda_=0.95,
            entropy_coeff=0.01,
        )
    )


def main(iterations: int = 30, workers: int = 0, seed: int = 0) -> list[float]:
    """Train three robots on 6 x 6 cells; returns the mean return of the team in every iteration.

    Args:
        iterations: number of updates.
        workers: processes that collect; 0: this one.
        seed: of arenas, networks and actions.
    """
    torch.manual_seed(seed)
    cpus = max(workers, 1)  # of a Ray of its own, also where another one runs
    ray.init("local", num_cpus=cpus, include_dashboard=False, log_to_driver=False)
    algorithm = settings(workers, seed).build_algo()
    returns: list[float] = []
    for iteration in range(1, iterations + 1):
        result = algorithm.train()["env_runners"]
        robots = result["agent_episode_returns_mean"]  # alike: all get the team's reward
        returns.append(sum(robots.values()) / len(robots))
        print(f"iteration {iteration:3d}: return {returns[-1]:6.2f}")
    algorithm.stop()
    ray.shutdown()
    return returns


if __name__ == "__main__":
    tyro.cli(main)
