"""Runs and networks that are small enough for a test."""

from __future__ import annotations

from dataclasses import replace

from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.networks import CNN, MLP, DeepSet, Goals
from marl_explore.training.config import TrainConfig

NETWORKS = {
    "mlp": MLP(hidden=(16, 16)),
    "cnn": CNN(hidden=16, state_hidden=(16, 16)),
    "deepset": DeepSet(hidden=(16, 16)),
    "goals": Goals(code_width=8, pair_width=4),
}
TINY = TrainConfig(
    arena=ArenaConfig(height=6, width=6, num_agents=2),
    network=NETWORKS["mlp"],
    episodes=24,
    episode_steps=10,
    num_envs=4,
    rollout_steps=10,
    ppo_epochs=2,
)

BY_TYPE = replace(
    TINY,
    arena=ArenaConfig(
        height=6,
        width=6,
        sensing_range=(1.5, 1.1, 1.1, 1.5),
        communication_range=(3.0, 2.0, 2.0, 3.0),
    ),
    actors="type",
)
"""HAPPO with an actor for robots 0 and 3, and one for robots 1 and 2."""


def tiny(num_agents=2, **settings):
    """``TINY`` with another team and other settings."""
    return replace(TINY, arena=replace(TINY.arena, num_agents=num_agents), **settings)
