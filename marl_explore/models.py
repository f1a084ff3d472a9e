"""The paper's networks: an MLP and a CNN, each as an actor per robot and as a shared critic.

Networks are plain modules on ``(fov, fpr, net)``: float [*B, 2k+1, 2k+1], [*B, 8, 3], [*B, N] for
an actor, and the same with a robot axis after ``*B`` for a critic. What they return is float32,
also under autocast: losses are computed in full precision. An actor that reads other parts of the
observation names them in ``inputs``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import (
    TensorDictModule,
)
from torch import Tensor, nn

from marl_explore.config import Ability, Architecture, ArenaConfig, CriticInput
from marl_explore.core.grid import COMMUNICATE, NUM_ACTIONS, NUM_DIRECTIONS
from marl_explore.core.mapping import known_mask

PAPER_INPUTS = ("fov", "fpr", "net")


def observation_keys(inputs: Sequence[str]) -> list[NestedKey]:
    """Entries of the group "agents" that hold these parts of the observation."""
    return [("agents", "observation", key) for key in inputs]


OBSERVATION_KEYS = observation_keys(PAPER_INPUTS)
STATE_KEYS: list[NestedKey] = ["obstacles", ("agents", "position"), ("agents", "map")]
_EVENT_DIMS = {
    "fov": 2,
    "fpr": 2,
    "net": 1,
    "gain": 1,
    "territory": 2,
    "teammates": 2,
    "clock": 1,
    "local": 3,
}
_FPR_SIZE = NUM_DIRECTIONS * 3

ACTOR_GAIN, CRITIC_GAIN = 0.01, 1.0


def mlp(
    inputs: int,
    outputs: int,
    hidden: Sequence[int] = (2400, 300),
    norm_last: bool = False,
    gain: float = CRITIC_GAIN,
) -> nn.Sequential:
    """Linear layers with ReLU, separated by layer normalisation (the paper's Table I).

    Args:
        inputs: features in.
        outputs: features out.
        hidden: widths of the hidden layers.
        norm_last: whether the last hidden layer is normalised too.
        gain: scale of the orthogonal initialisation of the last layer.
    """
    layers: list[nn.Module] = []
    for index, width in enumerate(hidden):
        layers += [nn.Linear(inputs, width), nn.ReLU()]
        if norm_last or index < len(hidden) - 1:
            layers.append(nn.LayerNorm(width))
        inputs = width
    layers.append(nn.Linear(inputs, outputs))
    return initialize(nn.Sequential(*layers), gain)


def initialize(network: nn.Sequential, gain: float) -> nn.Sequential:
    """Orthogonal weights (gain sqrt 2, ``gain`` in the last layer) and zero biases."""
    layers = [m for m in network.modules() if isinstance(m, (nn.Linear, nn.Conv2d))]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else math.sqrt(2))
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)
    return network


def in_a_row(fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
    """The numbers of each observation [*B, (2k + 1)^2 + 24 + N]."""
    return torch.cat((fov.flatten(-2), fpr.flatten(-2), net), -1)


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
    ) -> None:
        super().__init__()
        code = nn.Sequential(nn.Linear(6, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.code = initialize(code, math.sqrt(2))
        own = config.fov_size**2 + 2 * _FPR_SIZE + NUM_DIRECTIONS + 1 + period
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
        return self.layers(torch.cat((*parts, local.flatten(-3), *pooled), -1)).float()


class StateCritic(nn.Module):
    """Value [*B, 1] of the true state: obstacles, positions, and what every map knows."""

    size: Tensor

    def __init__(
        self, config: ArenaConfig, hidden: Sequence[int] = (2400, 300), norm_last: bool = False
    ) -> None:
        super().__init__()
        inputs = config.num_cells * (1 + config.num_agents) + 2 * config.num_agents
        self.layers = mlp(inputs, 1, hidden, norm_last)
        size = torch.tensor([config.height, config.width], dtype=torch.float32)
        self.register_buffer("size", size, persistent=False)

    def forward(self, obstacles: Tensor, position: Tensor, grid: Tensor) -> Tensor:
        """Value of bool [*B, H, W], int64 [*B, N, 2] and int8 [*B, N, H, W]."""
        parts = (obstacles.float().flatten(-2), known_mask(grid).flatten(-3))
        place = (position / self.size).flatten(-2)
        return self.layers(torch.cat((*parts, place), -1)).float()


class Ablated(nn.Module):
    """An actor that does without some of its inputs, which it reads as 0, or never communicates.

    Args:
        actor: the network.
        without: what it does without.
    """

    def __init__(self, actor: nn.Module, without: Sequence[Ability]) -> None:
        super().__init__()
        self.actor = actor
        self.inputs: tuple[str, ...] = actor.inputs  # type: ignore[assignment]
        self.without = frozenset(without)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        read = (
            torch.zeros_like(entry) if name in self.without else entry
            for name, entry in zip(self.inputs, inputs, strict=True)
        )
        logits = self.actor(*read)
        if "communication" in self.without:
            logits = logits.index_fill(-1, torch.tensor(COMMUNICATE, device=logits.device), _NEVER)
        return logits


_NEVER = -1e4
"""Logit of an action that is never chosen, in every precision."""


def robots_first(names: Sequence[str], *inputs: Tensor) -> list[Tensor]:
    """The inputs [*B, N, ...] of these names with the robot axis in front."""
    return [x.movedim(-1 - _EVENT_DIMS[name], 0) for name, x in zip(names, inputs, strict=True)]


def by_robot(names: Sequence[str], *inputs: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """The inputs [*B, N, ...] of each robot, the robot axis taken off."""
    return zip(*robots_first(names, *inputs), strict=True)


def make_actor(
    config: ArenaConfig,
    architecture: Architecture,
    hidden: Sequence[int],
    norm_last: bool = False,
    without: Sequence[Ability] = (),
) -> nn.Module:
    """One robot's actor network; of ``hidden`` a CNN uses the last width."""
    actor: nn.Module
    if architecture == "cnn":
        actor = CNNActor(config, hidden[-1])
    else:
        kind = MLPActor if architecture == "mlp" else DeepSetActor
        actor = kind(config, hidden, norm_last)
    return Ablated(actor, without) if without else actor


def make_critic(
    config: ArenaConfig,
    architecture: Architecture,
    hidden: Sequence[int],
    reads: CriticInput,
    norm_last: bool = False,
    robot: int | None = None,
) -> TensorDictModule:
    """A critic, writing "state_value" [*B, 1].

    Args:
        config: the arena.
        architecture: of a critic that reads observations.
        hidden: widths; a CNN uses the last one.
        reads: the observations or the true state.
        norm_last: whether the last hidden layer of an MLP is normalised too.
        robot: the only one whose observation it reads; None: those of all.
    """
    if reads == "state":
        return TensorDictModule(StateCritic(config, hidden, norm_last), STATE_KEYS, ["state_value"])
    critic = (
        MLPCritic(config, hidden, norm_last, robot)
        if architecture == "mlp"
        else CNNCritic(config, hidden[-1], robot=robot)
    )
    return TensorDictModule(critic, OBSERVATION_KEYS, ["state_value"])
