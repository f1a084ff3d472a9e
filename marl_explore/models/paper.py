"""The paper's networks: an MLP and a CNN, each as an actor per robot and as a shared critic."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from marl_explore.codes import NUM_FEATURES
from marl_explore.config import ArenaConfig
from marl_explore.core.grid import NUM_ACTIONS, NUM_DIRECTIONS
from marl_explore.models.inputs import PAPER_INPUTS, by_robot, in_a_row
from marl_explore.models.layers import ACTOR_GAIN, CRITIC_GAIN, initialize, mlp

_FPR_SIZE = NUM_DIRECTIONS * NUM_FEATURES


class MLPActor(nn.Module):
    """Logits [*B, 10] of one robot from its concatenated observation."""

    inputs = PAPER_INPUTS

    def __init__(
        self, config: ArenaConfig, hidden: Sequence[int] = (2400, 300), norm_last: bool = False
    ) -> None:
        super().__init__()
        self.layers = mlp(config.observation_size, NUM_ACTIONS, hidden, norm_last, ACTOR_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        return self.layers(in_a_row(fov, fpr, net)).float()


class MLPCritic(nn.Module):
    """Value [*B, 1] of the joint observation, or of one robot's."""

    def __init__(
        self,
        config: ArenaConfig,
        hidden: Sequence[int] = (2400, 300),
        norm_last: bool = False,
        robot: int | None = None,
    ) -> None:
        super().__init__()
        self.seen = _rows(config, robot)
        self.layers = mlp(len(self.seen) * config.observation_size, 1, hidden, norm_last)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Value [*B, 1] from inputs with a robot axis."""
        rows = in_a_row(fov, fpr, net)[..., self.seen.start : self.seen.stop, :]
        return self.layers(rows.flatten(-2)).float()


def _rows(config: ArenaConfig, robot: int | None) -> range:
    """Robots whose observations a critic reads."""
    return range(config.num_agents) if robot is None else range(robot, robot + 1)


class _Conv2d(nn.Conv2d):
    """A convolution that takes any batch dimensions, [*B, C, H, W]."""

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input.flatten(0, -4)).unflatten(0, input.shape[:-3])


class CNNEncoder(nn.Module):
    """Features of one robot's observation: convolutions on FOV beside layers on FPR and NET."""

    def __init__(
        self,
        config: ArenaConfig,
        channels: Sequence[int] = (8, 16),
        widths: tuple[int, int, int] = (64, 64, 16),
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = 1
        for channel in channels:
            layers += [_Conv2d(before, channel, kernel_size=3, stride=1, padding=1), nn.ReLU()]
            before = channel
        fov, fpr, net = widths
        layers += [nn.Flatten(-3), nn.Linear(before * config.fov_size**2, fov), nn.ReLU()]
        self.fov = nn.Sequential(*layers)
        self.fpr = nn.Sequential(nn.Linear(_FPR_SIZE, fpr), nn.ReLU())
        self.net = nn.Sequential(nn.Linear(config.num_agents, net), nn.ReLU())
        self.size = sum(widths)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Features [*B, 144] for the default widths."""
        seen = self.fov(fov.unsqueeze(-3))
        return torch.cat((seen, self.fpr(fpr.flatten(-2)), self.net(net)), -1)


class CNNActor(nn.Module):
    """Logits [*B, 10] of one robot through a ``CNNEncoder`` (the paper's Fig. 2a)."""

    inputs = PAPER_INPUTS

    def __init__(
        self,
        config: ArenaConfig,
        hidden: int = 300,
        channels: Sequence[int] = (8, 16),
        widths: tuple[int, int, int] = (64, 64, 16),
    ) -> None:
        super().__init__()
        self.encoder = CNNEncoder(config, channels, widths)
        self.head = nn.Sequential(
            nn.Linear(self.encoder.size, hidden), nn.ReLU(), nn.Linear(hidden, NUM_ACTIONS)
        )
        initialize(nn.Sequential(self.encoder, self.head), ACTOR_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        return self.head(self.encoder(fov, fpr, net)).float()


class CNNCritic(nn.Module):
    """Value [*B, 1] of the joint observation or of one robot's, a ``CNNEncoder`` each (Fig. 2b)."""

    def __init__(
        self,
        config: ArenaConfig,
        hidden: int = 300,
        channels: Sequence[int] = (8, 16),
        widths: tuple[int, int, int] = (64, 64, 16),
        robot: int | None = None,
    ) -> None:
        super().__init__()
        self.seen = _rows(config, robot)
        encoders = [CNNEncoder(config, channels, widths) for _ in self.seen]
        size = sum(encoder.size for encoder in encoders)
        self.encoders = nn.ModuleList(encoders)
        self.head = nn.Sequential(nn.Linear(size, hidden), nn.ReLU(), nn.Linear(hidden, 1))
        initialize(nn.Sequential(self.encoders, self.head), CRITIC_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Value [*B, 1] from inputs with a robot axis."""
        robots = [*by_robot(PAPER_INPUTS, fov, fpr, net)][self.seen.start : self.seen.stop]
        features = [enc(*robot) for enc, robot in zip(self.encoders, robots, strict=True)]
        return self.head(torch.cat(features, -1)).float()
