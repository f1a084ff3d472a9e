"""The policy of a team: its actors and the features that they read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require
from marl_explore.config.constants import Ability
from marl_explore.config.fields import check_types
from marl_explore.core.frontier import Normalization
from marl_explore.policies.actors import ACTION_MASK, TeamActor
from marl_explore.policies.networks import Network, NetworkSettings
from marl_explore.policies.networks.ablation import Ablated, require_abilities
from marl_explore.transforms.features import make_features
from marl_explore.transforms.memory import GOAL, MEMORY
from marl_explore.utils.memory import weights_memory

FOV: NestedKey = ("agents", "observation", "fov")


@dataclass(frozen=True)
class PolicyConfig(NetworkSettings):
    """Settings from which a policy's networks and features are built."""

    arena: ArenaConfig
    network: Network
    fpr: Normalization | None = "relative"
    ablate: tuple[Ability, ...] = ()
    shared: bool = False
    """Whether all robots share one actor."""
    by_type: bool = False
    """Whether the robots of each type (``ArenaConfig.types``) share one."""

    def __post_init__(self) -> None:
        """Raise an error for settings that are not allowed."""
        check_types(self)
        require_abilities(self.network, self.ablate)
        require(not (self.shared and self.by_type), "by_type", True, "all robots share one actor")

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The robots of each actor."""
        robots = tuple(range(self.arena.num_agents))
        if self.shared:
            return (robots,)
        return self.arena.types if self.by_type else tuple((robot,) for robot in robots)

    @property
    def num_actors(self) -> int:
        """Number of networks: one per robot or type, or one that all share."""
        return len(self.groups)

    @property
    def weights_memory(self) -> float:
        """Size of all actors' weights (bytes), found without making them."""
        return self.num_actors * weights_memory(lambda: self.network.make_actor(self.arena))

    def make_actors(self) -> list[nn.Module]:
        """A newly initialised network for each of ``groups``."""
        number = self.num_actors
        actors = [self.network.make_actor(self.arena) for _ in range(number)]
        return [Ablated(actor, self.ablate) for actor in actors] if self.ablate else actors


class Policy(TensorDictModuleBase):
    """A team of actors that computes its own features: it acts on any ``ExplorationEnv``.

    Reads "map", "position", "action_mask" and ("observation", "fov") of the group "agents" and
    writes ("agents", "action") int64 [*B, N]. Actions are sampled;
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` selects the argmax instead.

    Args:
        config: settings that the networks were built from.
        actors: a network for each of the configuration's ``groups``.
    """

    out_keys: list[NestedKey] = [("agents", "action")]  # noqa: RUF012

    def __init__(self, config: PolicyConfig, actors: Iterable[nn.Module]) -> None:
        super().__init__()
        self.config = config
        self.team = TeamActor(actors, config.groups)
        self._features = make_features(config.arena, config.network.features, config.fpr)
        read = [key for feature in self._features for key in feature.in_keys]
        own = {key for feature in self._features for key in feature.out_keys}
        # memory is one of its features
        needed = (*read, *self.team.in_keys, ACTION_MASK, FOV)
        self.in_keys: list[NestedKey] = [
            key for key in dict.fromkeys(needed) if key not in own and key[:2] != MEMORY
        ]

    @property
    def actors(self) -> nn.ModuleList:
        """The networks, one for each of the configuration's ``groups``."""
        return self.team.stacked.actors

    @property
    def sees(self) -> str:
        """The information that a robot's decisions use, as text."""
        return self.config.network.sees

    @property
    def any_team(self) -> bool:
        """Whether it works for any number of robots, all with the same sensor."""
        equal = len(self.config.arena.sight.ranges_cells) == 1
        return self.config.shared and self.config.network.any_team and equal

    def actor_of(self, robot: int) -> nn.Module:
        """The network of one robot."""
        if self.config.shared:  # also by more robots than it was trained with
            return self.actors[0]
        return self.actors[[robot in group for group in self.config.groups].index(True)]

    @property
    def _layout(self) -> tuple[Any, ...]:
        """What must be equal for actors to load each other's weights."""
        config, arena = self.config, self.config.arena
        robots = None if config.network.any_team else arena.num_agents
        side = None if config.network.any_sensor else arena.fov_size
        return config.network.layout, config.ablate, side, robots

    def in_world(self, arena: ArenaConfig) -> Policy:
        """The same actors for other robots, whose sensors its features are then about.

        Args:
            arena: the robots that are to act, and their world.

        Returns:
            This policy if its actors read nothing of which the sensors are known.

        Raises:
            ValueError: for a team or sensors that the actors cannot be used with.
        """
        if not self.config.network.any_sensor:
            self.check(arena.num_agents, arena.fov_size)
            return self
        config = replace(self.config, arena=arena)
        if config.num_actors != len(self.actors):
            whose = "types of robots" if config.by_type else "robots"
            raise ValueError(
                f"the policy has {len(self.actors)} actors, and the team {config.num_actors} "
                f"{whose}"
            )
        return Policy(config, self.actors)

    def init_from(self, other: Policy) -> None:
        """Copy the weights of another policy's actors; those of a shared actor to every robot.

        Raises:
            ValueError: when its networks differ, or it has fewer actors.
        """
        most = max(group[0] for group in self.config.groups)
        enough = other.config.shared or other.config.arena.num_agents > most
        if self._layout != other._layout or not enough:
            raise ValueError(
                f"{len(self.actors)} actors {self._layout} cannot start from {len(other.actors)} "
                f"{other._layout}"
            )
        for (robot, *_), actor in zip(self.config.groups, self.actors, strict=True):
            actor.load_state_dict(other.actor_of(robot).state_dict())

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action")."""
        return self.write(tensordict, self.team(self.observe(tensordict)))

    @staticmethod
    def write(tensordict: TensorDictBase, acted: TensorDictBase) -> TensorDictBase:
        """Write the actions that the team has chosen, and its goals where there is a memory."""
        if tensordict.get(MEMORY, None) is not None:
            tensordict.set(GOAL, acted.get(GOAL))
        return tensordict.set(("agents", "action"), acted.get(("agents", "action")))

    def observe(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The team's input: the entries that it reads, and its features."""
        observation = tensordict.select(*self.in_keys)
        if (memory := tensordict.get(MEMORY, None)) is not None:
            observation.set(MEMORY, memory)
        fov = observation.get(FOV)
        self.check(robots=fov.shape[-3], fov_size=fov.shape[-1])
        return self._features(observation)

    def check(self, robots: int, fov_size: int) -> None:
        """Raise an error for another team or sensor than the policy was trained for.

        Raises:
            ValueError: naming both.
        """
        arena = self.config.arena
        if robots != arena.num_agents and not self.any_team:
            raise ValueError(
                f"the policy was trained for num_agents={arena.num_agents}, and the environment "
                f"has {robots} robots"
            )
        periods = arena.move_period
        if self.team.to_goals and isinstance(periods, tuple) and len(periods) != robots:
            raise ValueError(
                f"the policy is for robots with move_period={periods}, and the environment has "
                f"{robots} robots: Policy.in_world is for others"
            )
        if fov_size != arena.fov_size:
            raise ValueError(
                f"the policy was trained for fov_radius={arena.fov_radius}, and the environment's "
                f"field of view is {fov_size} x {fov_size} cells"
                + ": Policy.in_world is for other sensors"
                * self.config.network.any_sensor
            )
