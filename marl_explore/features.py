"""Which features the actors of an architecture read, as one chain of transforms."""

from __future__ import annotations

from torchrl.envs import Compose, Transform

from marl_explore.config import Architecture, ArenaConfig
from marl_explore.core.frontier import Normalization
from marl_explore.transforms import (
    Clock,
    CommunicationNeighbors,
    FrontierReachability,
    FrontierTerritory,
    LocalMap,
    StepGain,
    Teammates,
)
from marl_explore.transforms.frontier import Backend


def make_features(
    arena: ArenaConfig,
    architecture: Architecture = "mlp",
    fpr: Normalization | None = "relative",
    backend: Backend = "auto",
) -> Compose:
    """FPR and NET, and for "deepset" what else its actors read."""
    cells = arena.communication_cells
    features: list[Transform] = [
        FrontierReachability(normalize=fpr, backend=backend),
        CommunicationNeighbors(range_cells=cells),
    ]
    if architecture == "deepset":
        features += [
            StepGain(radius=arena.fov_radius),
            FrontierTerritory(range_cells=cells, radius=arena.fov_radius),
            Teammates(range_cells=cells),
            Clock(),
            LocalMap(range_cells=cells),
        ]
    return Compose(*features)


def set_range(features: Compose, cells: float) -> None:
    """Count robots up to this distance (cells) as in range."""
    for feature in features:
        if hasattr(feature, "range_cells"):
            feature.range_cells = cells
