"""Ready-made training runs by name."""

from __future__ import annotations

from dataclasses import replace

from marl_explore.policies.networks import CNN, MLP, Goals
from marl_explore.training.config import TrainConfig

_FAST = TrainConfig(
    reward="team",
    fpr="proximity",
    network=MLP(hidden=(128, 128)),
    critic_input="state",
    episodes=2500,
    terminate_at_coverage=1.0,
    num_envs=64,
    rollout_steps=50,
    num_minibatches=2,
    gamma=0.95,
    lr_decay=True,
)
_BEST = replace(
    _FAST,
    reward="progress",
    algorithm="mappo",
    network=Goals(prior=5.0),
    critic_input="observation",
    scenes=("uniform/2", "uniform/3", "uniform/4", "uniform/6"),
    episodes=2600,
    num_envs=88,
    rollout_steps=25,
    ppo_epochs=5,
    actor_lr=1e-3,
    critic_lr=1e-3,
    max_grad_norm=2.0,
    gamma=0.99,
    entropy_coeff=0.006,
)

_PAPER = TrainConfig(gamma=0.9, fpr="proximity")
"""The paper's numbers, and the reading of what it leaves open with which robots explore most
(docs/results.md)."""

PRESETS: dict[str, TrainConfig] = {
    "paper-mlp-case1": replace(_PAPER, network=MLP(), reward="case1"),
    "paper-mlp-case2": replace(_PAPER, network=MLP(), reward="case2"),
    "paper-cnn-case1": replace(_PAPER, network=CNN(), reward="case1"),
    "paper-cnn-case2": replace(_PAPER, network=CNN(), reward="case2"),
    "fast": _FAST,
    "best": _BEST,
}
"""The paper's four policies, a run that takes minutes, and ``best``, a policy for any team and
arena that is faster than the planners."""
