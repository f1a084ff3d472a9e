"""The paper's CNN: an actor per robot and a shared critic (Fig. 2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer, require_widths
from marl_explore.config.constants import NUM_ACTIONS, NUM_DIRECTIONS, NUM_FEATURES
from marl_explore.config.fields import check_types
from marl_explore.policies.networks.base import Network
from marl_explore.policies.networks.inputs import PAPER_INPUTS, by_robot, robots_read
from marl_explore.policies.networks.layers import ACTOR_GAIN, CRITIC_GAIN, initialize, relu
from marl_explore.policies.networks.state import STATE_WIDTHS, StateCritic

_FPR_SIZE = NUM_DIRECTIONS * NUM_FEATURES


@dataclass(frozen=True)
class CNN(Network):
    """Convolutions on FOV, layers on FPR and NET; widths not given in the paper are our choice."""

    hidden: int = 300
    """Width of the layer after the encoder."""
    channels: tuple[int, ...] = (8, 16)
    """Channels of the convolutions."""
    widths: tuple[int, int, int] = (64, 64, 16)
    """Widths of the encodings of FOV, FPR and NET."""
    state_hidden: tuple[int, ...] = STATE_WIDTHS
    """Widths of a critic that reads the state."""

    name = "cnn"
    features = PAPER_INPUTS
    exported_as = "cnn"

    def __post_init__(self) -> None:
        """Check the widths."""
        check_types(self)
        require_integer("hidden", self.hidden, 1)
        for option in ("channels", "widths", "state_hidden"):
            require_widths(option, getattr(self, option))

    def make_actor(self, arena: ArenaConfig) -> CNNActor:
        """As ``Network.make_actor``."""
        return CNNActor(arena, self)

    def make_observation_critic(self, arena: ArenaConfig, robot: int | None) -> CNNCritic:
        """As ``Network.make_observation_critic``."""
        return CNNCritic(arena, self, robot)

    def make_state_critic(self, arena: ArenaConfig) -> StateCritic:
        """As ``Network.make_state_critic``."""
        return StateCritic(arena, self.state_hidden, norm_last=False)


class _Conv2d(nn.Conv2d):
    """A convolution that takes any batch dimensions, [*B, C, H, W]."""

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input.flatten(0, -4)).unflatten(0, input.shape[:-3])


class CNNEncoder(nn.Module):
    """Features of one robot's observation: convolutions on FOV, layers on FPR and NET."""

    def __init__(self, arena: ArenaConfig, options: CNN) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = 1
        for channel in options.channels:
            layers += [_Conv2d(before, channel, kernel_size=3, stride=1, padding=1), relu()]
            before = channel
        fov, fpr, net = options.widths
        layers += [nn.Flatten(-3), nn.Linear(before * arena.fov_size**2, fov), relu()]
        self.fov = nn.Sequential(*layers)
        self.fpr = nn.Sequential(nn.Linear(_FPR_SIZE, fpr), relu())
        self.net = nn.Sequential(nn.Linear(arena.num_agents, net), relu())
        self.size = sum(options.widths)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Features [*B, 144] for the default widths."""
        seen = self.fov(fov.unsqueeze(-3))
        return torch.cat((seen, self.fpr(fpr.flatten(-2)), self.net(net)), -1)


def _head(inputs: int, outputs: int, options: CNN) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, options.hidden), relu(), nn.Linear(options.hidden, outputs)
    )


class CNNActor(nn.Module):
    """Logits [*B, 10] of one robot, with a ``CNNEncoder`` (the paper's Fig. 2a)."""

    inputs = PAPER_INPUTS

    def __init__(self, arena: ArenaConfig, options: CNN) -> None:
        super().__init__()
        self.encoder = CNNEncoder(arena, options)
        self.head = _head(self.encoder.size, NUM_ACTIONS, options)
        initialize(nn.Sequential(self.encoder, self.head), ACTOR_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        return self.head(self.encoder(fov, fpr, net)).float()


class CNNCritic(nn.Module):
    """Value [*B, 1] of all observations or of one; a ``CNNEncoder`` per robot (Fig. 2b)."""

    def __init__(self, arena: ArenaConfig, options: CNN, robot: int | None) -> None:
        super().__init__()
        self.seen = robots_read(arena, robot)
        encoders = [CNNEncoder(arena, options) for _ in self.seen]
        self.encoders = nn.ModuleList(encoders)
        self.head = _head(sum(encoder.size for encoder in encoders), 1, options)
        initialize(nn.Sequential(self.encoders, self.head), CRITIC_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Value [*B, 1] from inputs with a robot axis."""
        robots = [*by_robot(PAPER_INPUTS, fov, fpr, net)][self.seen.start : self.seen.stop]
        features = [enc(*robot) for enc, robot in zip(self.encoders, robots, strict=True)]
        return self.head(torch.cat(features, -1)).float()
