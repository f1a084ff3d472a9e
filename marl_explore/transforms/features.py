"""All parts of the observation by name, and chains of transforms that compute them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from tensordict import NestedKey
from torchrl.envs import Compose, Transform

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.frontier import Normalization
from marl_explore.core.native import Backend
from marl_explore.transforms.frontier import FrontierReachability
from marl_explore.transforms.goals import GoalCandidates
from marl_explore.transforms.memory import RememberTeam
from marl_explore.transforms.neighbors import CommunicationNeighbors
from marl_explore.transforms.surroundings import Clock, LocalMap, StepGain
from marl_explore.transforms.team import FrontierTerritory, Teammates

LINKED: NestedKey = ("agents", "linked")
"""The entry in which environments publish links."""


class FeatureOptions(NamedTuple):
    """Options from which feature transforms are made."""

    arena: ArenaConfig
    fpr: Normalization | None = "relative"
    backend: Backend = "auto"


class Feature(NamedTuple):
    """A part of the observation, ("agents", "observation", its name)."""

    dims: int
    """Number of dimensions of one robot's entry."""
    make: Callable[[FeatureOptions], Transform] | None
    """Its transform; None: the environment computes it itself."""


def _candidates(options: FeatureOptions) -> Transform:
    sight, period = options.arena.sight, options.arena.move_period
    memory = RememberTeam(sight=sight, move_period=period)
    return Compose(memory, GoalCandidates(options.backend, sight))


FEATURES: dict[str, Feature] = {
    "fov": Feature(2, None),
    "fpr": Feature(2, lambda o: FrontierReachability(normalize=o.fpr, backend=o.backend)),
    "net": Feature(1, lambda _: CommunicationNeighbors(linked_key=LINKED)),
    "gain": Feature(1, lambda o: StepGain(sight=o.arena.sight)),
    "territory": Feature(2, lambda o: FrontierTerritory(linked_key=LINKED, sight=o.arena.sight)),
    "teammates": Feature(2, lambda _: Teammates(linked_key=LINKED)),
    "clock": Feature(1, lambda _: Clock()),
    "frontiers": Feature(2, _candidates),
    "rivals": Feature(3, _candidates),
    "mates": Feature(2, _candidates),
    "context": Feature(1, _candidates),
    "local": Feature(3, lambda _: LocalMap(linked_key=LINKED)),
}
"""A new feature is a transform and a row here; rows with the same function share its transform."""


def make_features(
    arena: ArenaConfig,
    names: Sequence[str] = ("fpr", "net"),
    fpr: Normalization | None = "relative",
    backend: Backend = "auto",
) -> Compose:
    """A chain of transforms that computes these parts of the observation.

    Args:
        arena: sensors and ranges.
        names: of ``FEATURES``; those that the environment computes itself need no transform.
        fpr: normalisation of the frontier table.
        backend: of the frontier table.

    Raises:
        ValueError: for an unknown feature, listing the known ones.
    """
    for name in names:
        if name not in FEATURES:
            raise ValueError(f"features={name!r} is not allowed: use some of {[*FEATURES]}")
    options = FeatureOptions(arena, fpr, backend)
    made = dict.fromkeys(feature.make for name, feature in FEATURES.items() if name in names)
    chain: list[Transform] = []
    for make in made:
        part = () if make is None else make(options)
        chain += part if isinstance(part, (Compose, tuple)) else (part,)
    return Compose(*chain)
