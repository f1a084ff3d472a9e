"""The environment with its features, ready for an actor."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.envs import TransformedEnv

from marl_explore.arenas import Generator
from marl_explore.config.arena import ArenaConfig
from marl_explore.core.frontier import Normalization
from marl_explore.core.native import Backend
from marl_explore.core.rewards import Reward
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.transforms.features import make_features


def make_env(
    config: ArenaConfig | None = None,
    num_envs: int = 1,
    reward: str | Reward = "case2",
    max_steps: int = 200,
    terminate_at_coverage: float | None = None,
    arenas: str | Generator = "uniform",
    seed: int = 0,
    stream: str = "train",
    first_arena: int | None = None,
    device: torch.device | str = "cpu",
    fpr: Normalization | None = "relative",
    backend: Backend = "auto",
    features: Sequence[str] = ("fpr", "net"),
) -> TransformedEnv:
    """An ``ExplorationEnv`` with transforms that compute further parts of the observation.

    The state of the episodes is ``make_env(...).base_env.state_dict()``.

    Args:
        config, num_envs, reward, max_steps: as for ``ExplorationEnv``.
        terminate_at_coverage, arenas, seed: as for ``ExplorationEnv``.
        stream, first_arena, device: as for ``ExplorationEnv``.
        fpr: normalisation of the frontier table: "relative", "proximity", "absolute" or None.
        backend: of the frontier table: "auto", "torch" or "native".
        features: parts of the observation to compute (``transforms.features.FEATURES``).
    """
    env = ExplorationEnv(
        config,
        num_envs=num_envs,
        reward=reward,
        max_steps=max_steps,
        terminate_at_coverage=terminate_at_coverage,
        arenas=arenas,
        seed=seed,
        stream=stream,
        first_arena=first_arena,
        device=device,
    )
    return TransformedEnv(env, make_features(env.config, features, fpr, backend))
