"""The paper's networks: an MLP and a CNN, each as an actor per robot and as a shared critic.

Networks are plain modules on ``(fov, fpr, net)``: float [*B, 2k+1, 2k+1], [*B, 8, 3], [*B, N] for
an actor, and the same with a robot axis after ``*B`` for a critic. The functions at the end wrap
them for TensorDicts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor

from marl_explore.config import Architecture, ArenaConfig, CriticInput
from marl_explore.core.grid import NUM_ACTIONS, NUM_DIRECTIONS

OBSERVATION_KEYS: list[NestedKey] = [
    ("agents", "observation", key) for key in ("fov", "fpr", "net")
]
ACTION_MASK: NestedKey = ("agents", "action_mask")
ACTION: NestedKey = ("agents", "action")
LOG_PROB: NestedKey = ("agents", "action_log_prob")
STATE_KEYS: list[NestedKey] = ["obstacles", ("agents", "position"), ("agents", "map")]
_EVENT_DIMS = (2, 2, 1)  # of fov, fpr and net
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


def _concatenate(fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
    return torch.cat((fov.flatten(-2), fpr.flatten(-2), net), -1)


class MLPActor(nn.Module):
    """Logits [*B, 10] of one robot from its concatenated observation."""

    def __init__(
        self, config: ArenaConfig, hidden: Sequence[int] = (2400, 300), norm_last: bool = False
    ) -> None:
        super().__init__()
        self.layers = mlp(config.observation_size, NUM_ACTIONS, hidden, norm_last, ACTOR_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        return self.layers(_concatenate(fov, fpr, net))


class MLPCritic(nn.Module):
    """Value [*B, 1] of the joint observation."""

    def __init__(
        self, config: ArenaConfig, hidden: Sequence[int] = (2400, 300), norm_last: bool = False
    ) -> None:
        super().__init__()
        self.layers = mlp(config.num_agents * config.observation_size, 1, hidden, norm_last)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Value [*B, 1] from inputs with a robot axis."""
        return self.layers(_concatenate(fov, fpr, net).flatten(-2))


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
            layers += [nn.Conv2d(before, channel, kernel_size=3, stride=1, padding=1), nn.ReLU()]
            before = channel
        fov, fpr, net = widths
        layers += [nn.Flatten(), nn.Linear(before * config.fov_size**2, fov), nn.ReLU()]
        self.fov = nn.Sequential(*layers)
        self.fpr = nn.Sequential(nn.Linear(_FPR_SIZE, fpr), nn.ReLU())
        self.net = nn.Sequential(nn.Linear(config.num_agents, net), nn.ReLU())
        self.size = sum(widths)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Features [*B, 144] for the default widths."""
        batch = fov.shape[:-2]
        seen = self.fov(fov.reshape(-1, 1, *fov.shape[-2:])).view(*batch, -1)
        return torch.cat((seen, self.fpr(fpr.flatten(-2)), self.net(net)), -1)


class CNNActor(nn.Module):
    """Logits [*B, 10] of one robot through a ``CNNEncoder`` (the paper's Fig. 2a)."""

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
        return self.head(self.encoder(fov, fpr, net))


class CNNCritic(nn.Module):
    """Value [*B, 1] of the joint observation, one ``CNNEncoder`` per robot (Fig. 2b)."""

    def __init__(
        self,
        config: ArenaConfig,
        hidden: int = 300,
        channels: Sequence[int] = (8, 16),
        widths: tuple[int, int, int] = (64, 64, 16),
    ) -> None:
        super().__init__()
        encoders = [CNNEncoder(config, channels, widths) for _ in range(config.num_agents)]
        size = sum(encoder.size for encoder in encoders)
        self.encoders = nn.ModuleList(encoders)
        self.head = nn.Sequential(nn.Linear(size, hidden), nn.ReLU(), nn.Linear(hidden, 1))
        initialize(nn.Sequential(self.encoders, self.head), CRITIC_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Value [*B, 1] from inputs with a robot axis."""
        robots = _by_robot(fov, fpr, net)
        features = [enc(*robot) for enc, robot in zip(self.encoders, robots, strict=True)]
        return self.head(torch.cat(features, -1))


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
        known = (grid >= 0).flatten(-3)
        place = (position / self.size).flatten(-2)
        return self.layers(torch.cat((obstacles.flatten(-2), known, place), -1).float())


class StackedActors(nn.Module):
    """The actors of a team side by side: logits [*B, N, 10] from inputs with a robot axis."""

    def __init__(self, actors: Iterable[nn.Module]) -> None:
        super().__init__()
        self.actors = nn.ModuleList(actors)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Logits [*B, N, 10]; actor i reads row i."""
        robots = _by_robot(fov, fpr, net)
        logits = [actor(*robot) for actor, robot in zip(self.actors, robots, strict=True)]
        return torch.stack(logits, -2)


def _by_robot(*inputs: Tensor) -> Iterable[tuple[Tensor, ...]]:
    """The inputs of each robot, the robot axis taken off."""
    split = (x.unbind(-1 - dims) for x, dims in zip(inputs, _EVENT_DIMS, strict=True))
    return zip(*split, strict=True)


def make_actor(
    config: ArenaConfig,
    architecture: Architecture,
    hidden: Sequence[int],
    norm_last: bool = False,
) -> nn.Module:
    """One robot's actor network; of ``hidden`` a CNN uses the last width."""
    if architecture == "mlp":
        return MLPActor(config, hidden, norm_last)
    return CNNActor(config, hidden[-1])


def make_critic(
    config: ArenaConfig,
    architecture: Architecture,
    hidden: Sequence[int],
    reads: CriticInput,
    norm_last: bool = False,
) -> TensorDictModule:
    """The shared critic, writing "state_value" [*B, 1] from the observations or the true state."""
    if reads == "state":
        return TensorDictModule(StateCritic(config, hidden, norm_last), STATE_KEYS, ["state_value"])
    if architecture == "mlp":
        return TensorDictModule(
            MLPCritic(config, hidden, norm_last), OBSERVATION_KEYS, ["state_value"]
        )
    return TensorDictModule(CNNCritic(config, hidden[-1]), OBSERVATION_KEYS, ["state_value"])


class TeamActor(TensorDictModuleBase):
    """The policy of a collector: all robots' actors in one module, writing actions and log-probs.

    It does what ``probabilistic_actor(StackedActors(actors))`` does in a fraction of the time
    that a chain of modules takes. Actions are sampled, unless
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` asks for the likeliest.
    """

    in_keys: list[NestedKey] = [*OBSERVATION_KEYS, ACTION_MASK]  # noqa: RUF012
    out_keys: list[NestedKey] = [ACTION, LOG_PROB]  # noqa: RUF012

    def __init__(self, actors: Iterable[nn.Module]) -> None:
        super().__init__()
        self.stacked = StackedActors(actors)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action") int64 [*B, N] and ("agents", "action_log_prob")."""
        logits = self.stacked(*(tensordict.get(key) for key in OBSERVATION_KEYS))
        logits = logits.masked_fill(~tensordict.get(ACTION_MASK), -torch.inf)
        policy = Categorical(logits=logits, validate_args=False)
        likeliest = exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE)
        action = policy.mode if likeliest else policy.sample()
        tensordict.set(ACTION, action)
        return tensordict.set(LOG_PROB, policy.log_prob(action))


def probabilistic_actor(network: nn.Module) -> ProbabilisticTensorDictSequential:
    """A masked categorical policy in the entries of the group "agents".

    With one robot's network it acts on that robot's slice of the group (an actor of HAPPO), with
    ``StackedActors`` on the whole group. Sampling is the default;
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` takes the likeliest action.
    """
    logits: NestedKey = ("agents", "logits")
    return ProbabilisticActor(
        TensorDictModule(network, OBSERVATION_KEYS, [logits]),
        in_keys={"logits": logits, "mask": ACTION_MASK},
        out_keys=[ACTION],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=LOG_PROB,
        default_interaction_type=InteractionType.RANDOM,
    )
