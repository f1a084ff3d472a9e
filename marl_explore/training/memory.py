"""Memory of a training run, estimated before it is begun."""

from __future__ import annotations

from marl_explore.policies.policy import PolicyConfig
from marl_explore.training.config import TrainConfig
from marl_explore.training.environment import make_training_env
from marl_explore.utils.memory import require_memory, weights_memory

COPIES = 4
"""Numbers kept per weight: itself, its gradient, and Adam's two moments."""


def policy_config(config: TrainConfig) -> PolicyConfig:
    """Settings of the policy that a run trains."""
    return PolicyConfig(
        config.arena,
        config.network,
        config.fpr,
        config.ablate,
        shared=config.algorithm == "mappo",
        by_type=config.actors == "type",
    )


def require_training_memory(config: TrainConfig) -> None:
    """Raise an error for a run that does not fit this machine, or whose environment fails.

    Raises:
        ValueError: naming the settings that need the memory, or what the environment refuses.
    """
    critic = weights_memory(lambda: config.network.make_critic(config.arena, config.critic_input))
    critics = critic * (config.arena.num_agents if config.algorithm == "ippo" else 1)
    weights = COPIES * (policy_config(config).weights_memory + critics)
    require_memory(f"the weights of network={config.network!r}", weights)
    batch = sum(
        2 * scene.batch_frames * make_training_env(scene, num_envs=1).reset().bytes()
        for scene in config.scene_configs  # twice: each step has the next observation too
    )
    require_memory(
        f"a batch of num_envs={config.num_envs} x rollout_steps={config.rollout_steps}",
        weights + batch,
    )
