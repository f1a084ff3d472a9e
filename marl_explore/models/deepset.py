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
from marl_explore.transforms.team import SHORT_STEPS

_TABLE_SIZES = 3 + TERRITORY_SIZE + 1  # of a direction: FPR, territory, gain


class DeepSetActor(nn.Module):
    """Logits [*B, 10] of one robot of any team on any arena.

    Every other robot is encoded on its own, and the codes are pooled (mean and maximum over all but
    those out of range that a relay has just merged it with), after Zaheer et al., "Deep Sets",
    2017. What the tables say of a direction is scored by one network for all eight: what it learns
    of one holds for the others.

    Args:
        config: the arena; of it only the field of view matters.
        hidden: widths of the layers after the pooling.
        norm_last: whether the last one is normalised too.
        view: r of ``LocalMap``.
        period: of ``Clock``.
        width: of the code of another robot, and of the layer that scores directions.
        context: numbers that tell this layer of everything else.
        communicate_every: steps between the times at which it may communicate, by the clock that
            all robots share: when one does, the others may too. It divides the period.
        communicate_after: fewest steps since the last exchange with one of the robots in range
            before it may communicate; both robots of a pair count the same.
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
        context: int = 16,
        communicate_every: int = 1,
        communicate_after: int = 0,
    ) -> None:
        super().__init__()
        self.communicate_every, self.communicate_after = communicate_every, communicate_after
        code = nn.Sequential(nn.Linear(6, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.code = initialize(code, math.sqrt(2))
        own = config.fov_size**2 + NUM_DIRECTIONS * _TABLE_SIZES + 1 + period
        inputs = own + 3 * (2 * view + 1) ** 2 + 2 * width
        self.layers = mlp(inputs, NUM_ACTIONS + context, hidden, norm_last, ACTOR_GAIN)
        score = nn.Sequential(nn.Linear(_TABLE_SIZES + context, width), nn.ReLU())
        self.score = initialize(score.append(nn.Linear(width, 1)), ACTOR_GAIN)

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
        table = torch.cat((fpr, territory, gain.unsqueeze(-1)), -1)
        parts = (fov.flatten(-2), table.flatten(-2), clock, local.flatten(-3))
        pooled = (codes.sum(-2) / number, codes.amax(-2))
        logits, context = self.layers(torch.cat((*parts, *pooled), -1)).tensor_split(
            [NUM_ACTIONS], -1
        )
        context = context.unsqueeze(-2).expand(*table.shape[:-1], -1)
        moves = self.score(torch.cat((table, context), -1)).squeeze(-1)
        logits = logits.float() + nn.functional.pad(
            moves.float(), (0, NUM_ACTIONS - NUM_DIRECTIONS)
        )
        logits[..., COMMUNICATE] += FORBIDDEN_LOGIT * (1 - self._may_communicate(teammates, clock))
        return logits

    def _may_communicate(self, teammates: Tensor, clock: Tensor) -> Tensor:
        """1 where it is time to, else 0, float32 [*B]."""
        due = clock[..., 1 :: self.communicate_every].sum(-1)  # the hand is at one of these times
        if not self.communicate_after:
            return due
        near, since = teammates[..., 0], teammates[..., -1]
        steps = self.communicate_after - 0.5  # between two whole numbers: no rounding matters
        return due * (near * (since > steps / (steps + SHORT_STEPS))).amax(-1)
