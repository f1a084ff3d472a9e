"""Which frontier a robot goes to: a short way, much to see, and none that is a teammate's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from marl_explore.robot.explorer.frontiers import Candidate
from marl_explore.robot.explorer.grids import CoarseGrid
from marl_explore.robot.explorer.places import Place
from marl_explore.robot.explorer.settings import ExplorerSettings
from marl_explore.robot.explorer.wavefront import NO_WAY, Lengths

NEARER_BY = 1.0
"""Difference of ways to which being nearer is resolved (metres)."""
TIE = 0.5
"""Ways that differ by less are equal when robots have chosen the same frontier (metres)."""


class Rival(NamedTuple):
    """A teammate that is heard."""

    name: str
    place: Place
    lengths: Lengths
    """Of ways from where it is."""
    goal: Place | None
    """What it has chosen."""


def price(
    candidate: Candidate,
    grid: CoarseGrid,
    rivals: Sequence[Rival],
    own: str,
    settings: ExplorerSettings,
) -> float:
    """What a goal costs, in metres of way: the way, less its gain, and more for each rival.

    A frontier is a teammate's as far as that is nearer to it, and if it has chosen it and is first:
    nearer, or as near with the lower name.
    """
    total = candidate.way - settings.gain * candidate.gain
    for rival in rivals:
        length = int(rival.lengths[candidate.cell])
        if length == NO_WAY:
            continue
        way = length * grid.side / 2
        total += settings.territory * _sigmoid((candidate.way - way) / NEARER_BY)
        near = (
            rival.goal and rival.goal.distance(grid.middle(candidate.cell)) < settings.goal_radius
        )
        if near and (round(way / TIE), rival.name) < (round(candidate.way / TIE), own):
            total += settings.territory
    return total


def _sigmoid(number: float) -> float:
    return 1 / (1 + math.exp(-max(-30.0, min(number, 30.0))))
