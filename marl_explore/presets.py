"""Ready-made training runs by name."""

from __future__ import annotations

from dataclasses import replace

from marl_explore.config import TrainConfig

_FAST = TrainConfig(
    reward="team",
    fpr="proximity",
    hidden=(128, 128),
    critic_reads="state",
    episodes=2500,
    terminate_at_coverage=1.0,
    num_envs=64,
    rollout_steps=50,
    minibatches=2,
    gamma=0.95,
    lr_decay=True,
)
_BEST = replace(
    _FAST,
    reward="progress",
    algorithm="mappo",
    architecture="deepset",
    hidden=(256, 128),
    communicate_every=3,
    communicate_after=4,
    episodes=12500,
    num_envs=128,
    rollout_steps=25,
    ppo_epochs=4,
    gamma=0.98,
)

PRESETS: dict[str, TrainConfig] = {
    "paper-mlp-case1": TrainConfig(architecture="mlp", reward="case1"),
    "paper-mlp-case2": TrainConfig(architecture="mlp", reward="case2"),
    "paper-cnn-case1": TrainConfig(architecture="cnn", reward="case1"),
    "paper-cnn-case2": TrainConfig(architecture="cnn", reward="case2"),
    "fast": _FAST,
    "best": _BEST,
}
"""The paper's four policies, one that learns in minutes, and one for any team that beats the
planners."""
