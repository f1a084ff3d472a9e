"""The environment of a training run."""

from __future__ import annotations

from torchrl.envs import EnvBase, RewardSum

from marl_explore.envs.factory import make_env
from marl_explore.training.config import TrainConfig
from marl_explore.training.rollout_metrics import FinalKnowledge


def make_training_env(
    config: TrainConfig, num_envs: int | None = None, first_arena: int = 0, device: str = "cpu"
) -> EnvBase:
    """The environment of a training run or a part of its arenas, with returns and coverage."""
    env = make_env(
        config.arena,
        num_envs=num_envs or config.num_envs,
        reward=config.reward,
        max_steps=config.episode_steps,
        terminate_at_coverage=config.terminate_at_coverage,
        arenas=config.arenas,
        seed=config.seed,
        first_arena=first_arena,
        device=device,
        fpr=config.fpr,
        features=config.network.features,
    )
    env.append_transform(RewardSum())
    env.append_transform(FinalKnowledge())
    return env
