"""The paper's MLP: an actor per robot and a shared critic (Table I)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_widths
from marl_explore.config.constants import NUM_ACTIONS
from marl_explore.config.fields import check_types
from marl_explore.policies.networks.base import Network
from marl_explore.policies.networks.inputs import PAPER_INPUTS, concat_observation, robots_read
from marl_explore.policies.networks.layers import ACTOR_GAIN, CRITIC_GAIN, mlp
from marl_explore.policies.networks.state import StateCritic


@dataclass(frozen=True)
class MLP(Network):
    """Linear layers with ReLU, separated by layer normalisation; defaults are the paper's."""

    hidden: tuple[int, ...] = (2400, 300)
    """Widths of the hidden layers."""
    norm_last: bool = False
    """Whether the last hidden layer is normalised too."""

    name = "mlp"
    features = PAPER_INPUTS
    exported_as = "mlp"

    def __post_init__(self) -> None:
        """Check the widths."""
        check_types(self)
        require_widths("hidden", self.hidden)

    def make_actor(self, arena: ArenaConfig) -> MLPActor:
        """As ``Network.make_actor``."""
        return MLPActor(arena, self)

    def make_observation_critic(self, arena: ArenaConfig, robot: int | None) -> MLPCritic:
        """As ``Network.make_observation_critic``."""
        return MLPCritic(arena, self, robot)

    def make_state_critic(self, arena: ArenaConfig) -> StateCritic:
        """As ``Network.make_state_critic``."""
        return StateCritic(arena, self.hidden, self.norm_last)


class MLPActor(nn.Module):
    """Logits [*B, 10] of one robot from its concatenated observation."""

    inputs = PAPER_INPUTS

    def __init__(self, arena: ArenaConfig, options: MLP) -> None:
        super().__init__()
        inputs, hidden = arena.observation_size, options.hidden
        self.layers = mlp(inputs, NUM_ACTIONS, hidden, options.norm_last, ACTOR_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Logits [*B, 10]."""
        return self.layers(concat_observation(fov, fpr, net)).float()


class MLPCritic(nn.Module):
    """Value [*B, 1] of the joint observation, or of one robot's."""

    def __init__(self, arena: ArenaConfig, options: MLP, robot: int | None) -> None:
        super().__init__()
        self.seen = robots_read(arena, robot)
        inputs = len(self.seen) * arena.observation_size
        self.layers = mlp(inputs, 1, options.hidden, options.norm_last, CRITIC_GAIN)

    def forward(self, fov: Tensor, fpr: Tensor, net: Tensor) -> Tensor:
        """Value [*B, 1] from inputs with a robot axis."""
        rows = concat_observation(fov, fpr, net)[..., self.seen.start : self.seen.stop, :]
        return self.layers(rows.flatten(-2)).float()
