"""The base class of networks: options, what a network reads, and how its modules are made."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, Literal

from tensordict.nn import TensorDictModule
from torch import nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.networks.inputs import observation_keys
from marl_explore.policies.networks.state import STATE_KEYS, STATE_WIDTHS, StateCritic

CriticInput = Literal["observation", "state"]


@dataclass(frozen=True)
class Network(ABC):
    """A kind of network for actors and critics; the fields of a subclass are its options.

    A new kind is one file with a subclass, and one row in ``networks.NETWORKS``. Options are JSON
    values and tuples; ``__post_init__`` raises a ValueError that names a wrong one.
    """

    name: ClassVar[str]
    """Its name in settings, on command lines and in policy files."""
    features: ClassVar[tuple[str, ...]]
    """Parts of the observation that its actors read (``transforms.features.FEATURES``)."""
    any_team: ClassVar[bool] = False
    """Whether a shared actor works for any number of robots."""
    any_sensor: ClassVar[bool] = False
    """Whether its actors work with any sensors: what they read is in units of the robot's own."""
    sees: ClassVar[str] = "own FOV, FPR, NET"
    """The information that a robot's decisions use, as text."""
    chooses: ClassVar[Literal["moves", "goals"]] = "moves"
    """What its actors choose among: the ten actions, or candidate goals (docs/goals.md)."""
    exported_as: ClassVar[str | None] = None
    """Its numpy version for robots (``robot.policy``); None: it has none."""

    @abstractmethod
    def make_actor(self, arena: ArenaConfig) -> nn.Module:
        """A new actor: from the parts of one robot's observation to the logits of its choices."""

    def make_state_critic(self, arena: ArenaConfig) -> nn.Module:
        """A new critic of the true state, whose entries are ``state.STATE_KEYS``: value [*B, 1]."""
        return StateCritic(arena, STATE_WIDTHS, norm_last=False)

    def make_observation_critic(self, arena: ArenaConfig, robot: int | None) -> nn.Module | None:
        """A new critic of the joint observation, or of one robot's; None: not supported."""
        return None

    def make_critic(
        self, arena: ArenaConfig, critic_input: CriticInput, robot: int | None = None
    ) -> TensorDictModule:
        """A critic that writes "state_value" [*B, 1].

        Args:
            arena: size and robots.
            critic_input: the observations or the true state.
            robot: reads only this robot's observation; None: those of all.

        Raises:
            ValueError: when there is no critic of observations.
        """
        if critic_input == "state":
            return TensorDictModule(self.make_state_critic(arena), STATE_KEYS, ["state_value"])
        found = self.make_observation_critic(arena, robot)
        if found is None:
            raise ValueError(
                f"critic_input={critic_input!r} is not allowed: with {self.name} actors the "
                "critic must read the state"
            )
        return TensorDictModule(found, observation_keys(self.features), ["state_value"])

    @property
    def critic_inputs(self) -> tuple[CriticInput, ...]:
        """The possible inputs of a critic for its actors."""
        has_own = type(self).make_observation_critic is not Network.make_observation_critic
        return ("observation", "state") if has_own else ("state",)

    @property
    def layout(self) -> Network:
        """The network without options that do not affect weights: equal layouts fit together."""
        return self

    def to_json(self) -> dict[str, Any]:
        """Name and options, as stored in policy files and run folders."""
        return {"network": self.name, "options": asdict(self)}

    @classmethod
    def option_names(cls) -> tuple[str, ...]:
        """Names of the options."""
        return tuple(field.name for field in fields(cls))
