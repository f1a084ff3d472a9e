"""An actor whose inputs do not grow with the team or the arena."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from marl_explore.codes import FORBIDDEN_LOGIT
from marl_explore.config import ArenaConfig
from marl_explore.core.grid import COMMUNICATE, NUM_ACTIONS, NUM_DIRECTIONS
from marl_explore.core.outlook import TERRITORY_SIZE
from marl_explore.models.layers import ACTOR_GAIN, initialize, mlp

_TABLE_SIZES = 3 + TERRITORY_SIZE + 1  # of a direction: FPR, territory, gain


class DeepSetActor(nn.Module):
    """Logits [*B, 10] of one robot of any team on any arena.

    Every other robot is encoded on its own, and the codes are pooled (mean and maximum over those
    it has met or sees), after Zaheer et al., "Deep Sets", 2017.

    Args:
        config: the arena; of it only the field of view matters.
        hidden: widths of the layers after the pooling.
        norm_last: whether the last one is normalised too.
        view: r of ``LocalMap``.
        period: of ``Clock``.
        width: of the code of another robot.
        communicate_every: steps between the times at which it may communicate, by the clock that
            all robots share: when one does, the others may too. It divides the period.
    """

    inputs = ("fov", "fpr", "gain", "territory", "teammates", "clock", "local")

    def __init__(
        self,
        config: ArenaConfig,
        hidden: Sequence[int] = (256, 128),
        norm_last: bool = False,
        view: int = 4,
        period: int = 6,
        width: int = 32,
        communicate_every: int = 1,
    ) -> None:
        super().__init__()
        self.communicate_every = communicate_every
        code = nn.Sequential(nn.Linear(6, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.code = initialize(code, math.sqrt(2))
        own = config.fov_size**2 + NUM_DIRECTIONS * _TABLE_SIZES + 1 + period
        inputs = own + 3 * (2 * view + 1) ** 2 + 2 * width
        self.layers = mlp(inputs, NUM_ACTIONS, hidden, norm_last, ACTOR_GAIN)

    def forward(
        self,
        fov: Tensor,
        fpr: Tensor,
        gain: Tensor,
        territory: Tensor,
        teammates: Tensor,
        clock: Tensor,
        local: Tensor,
    ) -> Tensor:
        """Logits [*B, 10]."""
        other = (teammates != 0).any(-1, keepdim=True)  # all is 0 of the robot itself
        codes = self.code(teammates) * other
        number = other.sum(-2).clamp_min(1)
        parts = (fov.flatten(-2), fpr.flatten(-2), gain, territory.flatten(-2), clock)
        pooled = (codes.sum(-2) / number, codes.amax(-2))
        logits = self.layers(torch.cat((*parts, local.flatten(-3), *pooled), -1)).float()
        due = clock[..., 1 :: self.communicate_every].sum(-1)  # the hand is at one of these times
        logits[..., COMMUNICATE] += FORBIDDEN_LOGIT * (1 - due)
        return logits
