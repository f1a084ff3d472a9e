"""A robot's memory of its team: in the TensorDict of an environment, or kept beside one."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import Transform

from marl_explore.config.shapes import Sight
from marl_explore.core.memory import (
    Observation,
    Sightings,
    TeamMemory,
    blank_memory,
    remember,
    where_begun,
)
from marl_explore.core.motion import has_to_give_way
from marl_explore.core.ways import crowded, has_to_make_room

MEMORY: NestedKey = ("agents", "memory")
GOAL: NestedKey = ("agents", "memory", "goal")
"""The only entry of the memory that a policy writes: the cell that each robot goes to."""
ALL_COVERED: NestedKey = ("agents", "memory", "all_covered")
"""Whether the robot could reach frontiers, all of them covered (``GoalCandidates`` writes it)."""
HEADING: NestedKey = ("agents", "memory", "heading")
"""Direction of the robot's last move; -1 before the first."""
STALLED: NestedKey = ("agents", "memory", "stalled")
"""Steps since the robot's map last grew."""
REFUSED: NestedKey = ("agents", "memory", "refused")
"""Whether the robot has to give way: a move was refused, and it has not had its turn since."""
CROWDED: NestedKey = ("agents", "memory", "crowded")
"""Whether the robot has to make room for others (``core.ways``)."""
OBSERVED: list[NestedKey] = [
    "step_count",
    ("agents", "map"),
    ("agents", "position"),
    ("agents", "linked"),
    ("agents", "steps_since_merge"),
]
DANGEROUS: NestedKey = ("agents", "dangerous")
CROWD_KEYS: list[NestedKey] = [
    ("agents", "map"),
    ("agents", "position"),
    ("agents", "linked"),
    ("agents", "action_mask"),
    ("agents", "observation", "fov"),
]
"""What ``core.ways.crowded`` reads."""


def observation_of(tensordict: TensorDictBase) -> Observation:
    """What robots remember of an environment's step."""
    return Observation(*(tensordict.get(key) for key in OBSERVED))


def crowded_in(tensordict: TensorDictBase) -> Tensor:
    """``core.ways.crowded`` of an environment's step, bool [*B, N]."""
    return crowded(*(tensordict.get(key) for key in CROWD_KEYS))


def to_tensordict(
    memory: TeamMemory, all_covered: Tensor, refused: Tensor, crowded: Tensor
) -> TensorDict:
    """The memory as the group of entries ``MEMORY``, batch [*B, N]."""
    entries = {**memory.seen._asdict(), **memory._asdict()}
    entries |= {"all_covered": all_covered, "refused": refused, "crowded": crowded}
    del entries["seen"]
    return TensorDict(entries, batch_size=memory.heading.shape)


def from_tensordict(entries: TensorDictBase) -> TeamMemory:
    """The inverse of ``to_tensordict``; entries of later versions are 0 where they are missing."""
    zero = torch.zeros_like(entries.get("stuck"))
    seen = Sightings(*(entries.get(name) for name in Sightings._fields))
    rest = (entries.get(name, zero) for name in TeamMemory._fields if name != "seen")
    return TeamMemory(seen, *rest)


class RememberTeam(Transform):
    """Keeps the memory of every robot (docs/goals.md) in the entries ("agents", "memory", ...).

    On an environment all state is in the TensorDict, so it is exact in every collector. An arena's
    memory is blank when its episode begins; a reset with ``set_state`` to a later step takes the
    memory that it is given. A step reads the memory of the step before, in which a policy has
    written the ``goal`` it chose.

    Called as a module, once per step, it adds its own memory to a TensorDict without one, so that a
    policy can act on an environment without it. What others then write into that group, such as the
    goal, it finds there in the next step.

    Args:
        radius: of the square that a robot sees (cells).
        sight: of the robots, instead of that square (``ArenaConfig.sight``).
        move_period: as in ``ArenaConfig``.
    """

    def __init__(
        self,
        radius: int = 1,
        sight: Sight | None = None,
        move_period: int | tuple[int, ...] = 1,
    ) -> None:
        in_keys = [*dict.fromkeys((*OBSERVED, *CROWD_KEYS, DANGEROUS))]
        super().__init__(in_keys=in_keys, out_keys=[MEMORY])
        self.sight = Sight.square(radius) if sight is None else sight
        self.move_period = move_period
        self._kept: TensorDictBase | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add the memory to a TensorDict that has none."""
        if tensordict.get(MEMORY, None) is not None:
            return tensordict
        kept, maps = self._kept, tensordict.get(("agents", "map"))
        if kept is not None:
            covered = kept.get("covered")
            if (covered.shape, covered.device) != (maps.shape, maps.device):
                kept = None  # other arenas
        tensordict.set(MEMORY, self._remember(tensordict, kept))
        self._kept = tensordict.get(MEMORY)  # the group itself: ``set`` may have copied it
        return tensordict

    def only(self, arenas: Tensor) -> None:
        """Forget all but some arenas of the batch [B], int64 [b]: the next one has only those."""
        if self._kept is not None:
            self._kept = self._kept[arenas]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = tensordict.get(MEMORY)
        return next_tensordict.set(MEMORY, self._remember(next_tensordict, before))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        memory, given = self._remember(tensordict_reset, None), tensordict.get(MEMORY, None)
        if given is not None:
            begun = _begun(tensordict_reset)
            started = where_begun(begun, from_tensordict(memory), from_tensordict(given))
            flags = (
                torch.where(begun.unsqueeze(-1), memory.get(key), _flag(given, key))
                for key in ("all_covered", "refused", "crowded")
            )
            memory = to_tensordict(started, *flags)
        return tensordict_reset.set(MEMORY, memory)

    def _remember(self, tensordict: TensorDictBase, before: TensorDictBase | None) -> TensorDict:
        """The memory after the observation in a TensorDict, blank at the start of an episode."""
        observed = observation_of(tensordict)
        memory = blank = blank_memory(observed.grid, observed.position)
        covered = torch.zeros_like(blank.heading, dtype=torch.bool)
        refused = tensordict.get(DANGEROUS, covered)
        beset = crowded_in(tensordict)
        if before is not None:
            begun = _begun(tensordict)
            memory = where_begun(begun, blank, from_tensordict(before))
            covered = before.get("all_covered") & ~begun.unsqueeze(-1)
            earlier = _flag(before, "refused")
            refused = has_to_give_way(refused, earlier, self.move_period, observed.now)
            earlier, last = _flag(before, "crowded"), memory.position
            grid, position = observed.grid, observed.position
            beset = has_to_make_room(beset, earlier, grid, position, last, observed.now)
        after = remember(memory, observed, covered, self.sight)
        # until candidates are found, none are covered
        return to_tensordict(after, torch.zeros_like(covered), refused, beset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory's entries to the observation spec."""
        return self._with_memory(observation_spec, observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Add the memory's entries to the state spec: a step depends on them."""
        parent = self.parent
        assert parent is not None
        return self._with_memory(state_spec, parent.observation_spec)

    def _with_memory(self, spec: Composite, observation: Composite) -> Composite:
        spec = spec.clone()
        spec[MEMORY] = memory_spec(observation["agents", "map"])
        return spec


def _flag(memory: TensorDictBase, key: str) -> Tensor:
    """An entry bool [*B, N] of a memory; false in one of before there was such an entry."""
    return memory.get(key, torch.zeros_like(memory.get("all_covered")))


def _begun(tensordict: TensorDictBase) -> Tensor:
    """Whether each team's episode begins, bool [*B]."""
    return (tensordict.get("step_count") == 0).squeeze(-1)


def memory_spec(maps: Bounded) -> Composite:
    """Specs of the memory of a team whose maps are int8 [*B, N, H, W]."""
    *batch, robots, height, width = maps.shape
    team, device = (*batch, robots), maps.device

    def integer(*shape: int) -> Unbounded:
        return Unbounded(shape=(*team, *shape), dtype=torch.int64, device=device)

    def flag(*shape: int) -> Binary:
        return Binary(shape=(*team, *shape), dtype=torch.bool, device=device)

    return Composite(
        step=integer(robots),
        cell=integer(robots, 2),
        waited=flag(robots),
        known_by=flag(robots, height, width),
        covered=flag(height, width),
        stuck=integer(),
        known=integer(),
        stalled=integer(),
        position=integer(2),
        heading=Bounded(-1, 7, shape=team, dtype=torch.int64, device=device),
        goal=integer(2),
        all_covered=flag(),
        refused=flag(),
        crowded=flag(),
        shape=team,
        device=device,
    )
