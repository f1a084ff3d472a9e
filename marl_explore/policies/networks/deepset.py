"""An actor whose size does not depend on the team or the arena."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require, require_integer, require_widths
from marl_explore.config.constants import FORBIDDEN_LOGIT
from marl_explore.config.fields import check_types
from marl_explore.core.grid import COMMUNICATE, NUM_ACTIONS, NUM_DIRECTIONS
from marl_explore.core.information_gain import TERRITORY_SIZE
from marl_explore.policies.networks.base import Network
from marl_explore.policies.networks.layers import ACTOR_GAIN, initialize, mlp, relu
from marl_explore.policies.networks.state import StateCritic
from marl_explore.transforms.surroundings import CLOCK_PERIOD, LOCAL_VIEW
from marl_explore.transforms.team import SHORT_STEPS

_TABLE_SIZES = 3 + TERRITORY_SIZE + 1  # per direction: FPR, territory, gain


@dataclass(frozen=True)
class DeepSet(Network):
    """One actor for any team in any arena: other robots form a set, directions share a network."""

    hidden: tuple[int, ...] = (256, 128)
    """Widths of the layers after the pooling."""
    norm_last: bool = False
    """Whether the last hidden layer is normalised too."""
    communicate_every: int = 1
    """Robots may communicate only every so many steps of a shared clock: 1, 2, 3 or 6."""
    communicate_after: int = 0
    """Minimum steps since the last exchange with a linked robot before communicating again."""
    code_width: int = 32
    """Width of the encoding of another robot, and of the layer that scores directions."""
    context: int = 16
    """Width of the summary of all other inputs that this layer reads."""

    name = "deepset"
    features = ("fov", "fpr", "gain", "territory", "teammates", "clock", "local")
    any_team = True
    sees = "own map, positions of robots in range, what was exchanged when, a clock"

    def __post_init__(self) -> None:
        """Check the options."""
        check_types(self)
        require_widths("hidden", self.hidden)
        for option in ("code_width", "context"):
            require_integer(option, getattr(self, option), 1)
        require_integer("communicate_after", self.communicate_after, 0)
        periods = tuple(n for n in range(1, CLOCK_PERIOD + 1) if CLOCK_PERIOD % n == 0)
        require(
            self.communicate_every in periods,
            "communicate_every",
            self.communicate_every,
            f"use one of {periods}",
        )

    @property
    def layout(self) -> DeepSet:
        """The network without the communication options, which do not affect weights."""
        return replace(self, communicate_every=1, communicate_after=0)

    def make_actor(self, arena: ArenaConfig) -> DeepSetActor:
        """As ``Network.make_actor``."""
        return DeepSetActor(arena, self)

    def make_state_critic(self, arena: ArenaConfig) -> StateCritic:
        """As ``Network.make_state_critic``."""
        return StateCritic(arena, self.hidden, self.norm_last)


class DeepSetActor(nn.Module):
    """Logits [*B, 10] of one robot of any team in any arena.

    Every other robot is encoded on its own and the encodings are pooled (mean and maximum over all
    except unlinked robots that a relay has just merged it with), after Zaheer et al., "Deep Sets",
    2017. One network scores the table rows of all eight directions, so what it learns about one
    applies to the others. When the shared clock allows one robot to communicate, it allows the
    others too, and both robots of a pair count the same steps since their last exchange.

    Args:
        arena: only its field of view matters.
        options: see ``DeepSet``.
    """

    inputs = DeepSet.features

    def __init__(self, arena: ArenaConfig, options: DeepSet) -> None:
        super().__init__()
        self.communicate_every = options.communicate_every
        self.communicate_after = options.communicate_after
        width, context = options.code_width, options.context
        code = nn.Sequential(nn.Linear(6, width), relu(), nn.Linear(width, width), relu())
        self.code = initialize(code, math.sqrt(2))
        own = arena.fov_size**2 + NUM_DIRECTIONS * _TABLE_SIZES + 1 + CLOCK_PERIOD
        inputs = own + 3 * (2 * LOCAL_VIEW + 1) ** 2 + 2 * width
        self.layers = mlp(
            inputs, NUM_ACTIONS + context, options.hidden, options.norm_last, ACTOR_GAIN
        )
        score = nn.Sequential(nn.Linear(_TABLE_SIZES + context, width), relu())
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
        other = (teammates != 0).any(-1, keepdim=True)  # the robot's own row is all 0
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
        """1 where communication is allowed now, else 0, float32 [*B]."""
        due = clock[..., 1 :: self.communicate_every].sum(-1)  # the clock is at one of these steps
        if not self.communicate_after:
            return due
        near, since = teammates[..., 0], teammates[..., -1]
        steps = self.communicate_after - 0.5  # halfway between integers: rounding does not matter
        return due * (near * (since > steps / (steps + SHORT_STEPS))).amax(-1)
