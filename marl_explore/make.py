"""The environment with its features, ready for an actor."""

from __future__ import annotations

from typing import Any

from torchrl.envs import Compose, TransformedEnv

from marl_explore.core.frontier import Normalization
from marl_explore.env import ExplorationEnv
from marl_explore.transforms import CommunicationNeighbors, FrontierReachability
from marl_explore.transforms.frontier import Backend


def make_env(
    *args: Any,
    fpr: Normalization | None = "relative",
    backend: Backend = "auto",
    **kwargs: Any,
) -> TransformedEnv:
    """An ``ExplorationEnv`` that also observes FPR and NET.

    Args:
        *args: as ``ExplorationEnv``.
        fpr: normalisation of the frontier table: "relative", "proximity", "absolute" or None.
        backend: what computes the frontier table: "auto", "torch" or "native".
        **kwargs: as ``ExplorationEnv``.
    """
    env = ExplorationEnv(*args, **kwargs)
    return TransformedEnv(
        env,
        Compose(
            FrontierReachability(normalize=fpr, backend=backend),
            CommunicationNeighbors(range_cells=env.config.communication_cells),
        ),
    )
