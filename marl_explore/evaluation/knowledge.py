"""What a robot cannot know, and whether a policy acts on it.

A policy is decentralised if the action of a robot follows from what that robot observes. The test
plays some episodes, changes all that one robot cannot know, and compares its actions.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from marl_explore.arenas import Generator, in_order
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer
from marl_explore.core.grid import NUM_ACTIONS, STAY
from marl_explore.core.hashing import combine
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.evaluation.episodes import TEST_STREAM, Actor, play
from marl_explore.evaluation.outside import RobotPolicies
from marl_explore.evaluation.registry import find_policy
from marl_explore.utils.chance import own_chance, set_chance

ARENAS, STEPS = 4, 60
"""Played by a check unless told otherwise."""
Change = Callable[[TensorDictBase, int, torch.Generator], None]
"""Changes, in place, an observation of teams, batch [B], in something a robot cannot know."""

ACTION: NestedKey = ("agents", "action")
_SYMMETRIC = ("linked", "steps_since_merge")
"""Entries about pairs: what others know of a robot and themselves, that robot knows too."""
_NAMED = ("map", "position", "alive", "linked")
"""Entries of robots with a change of their own."""
_OUTCOMES = ("reward", "done", "terminated", "truncated")


def _obstacles(step: TensorDictBase, robot: int, chance: torch.Generator) -> None:
    step["obstacles"] = torch.rand(step["obstacles"].shape, generator=chance) < 0.5


def _future(step: TensorDictBase, robot: int, chance: torch.Generator) -> None:
    step["draw_key"] = step["draw_key"] + 1


def _walkers(step: TensorDictBase, robot: int, chance: torch.Generator) -> None:
    if (walkers := step.get("walkers", None)) is not None:
        step["walkers"] = _cells_like(walkers, step, chance)


def _positions(step: TensorDictBase, robot: int, chance: torch.Generator) -> None:
    agents = step["agents"]
    position, hidden = agents["position"], ~agents["linked"][:, robot]
    position[hidden] = _cells_like(position, step, chance)[hidden]


def _cells_like(cells: Tensor, step: TensorDictBase, chance: torch.Generator) -> Tensor:
    """Other cells in the arenas, int64 [B, any, 2]."""
    sides = step["obstacles"].shape[-2:]
    drawn = [torch.randint(side, cells.shape[:-1], generator=chance) for side in sides]
    return torch.stack(drawn, -1)


def _of_others(
    step: TensorDictBase, robot: int, chance: torch.Generator, keys: Collection[NestedKey]
) -> None:
    """Change the other robots' rows of some entries."""
    for key in keys:
        entry = step["agents", key] if isinstance(key, str) else step[("agents", *key)]
        other = _otherwise(entry, chance)
        if key == "action_mask":
            other[..., STAY] = True  # some action is always allowed
        other[:, robot] = entry[:, robot]
        if key in _SYMMETRIC:
            other[:, :, robot] = entry[:, :, robot]
        entry.copy_(other)


def _otherwise(entry: Tensor, chance: torch.Generator) -> Tensor:
    """Other values of the same kind."""
    if entry.dtype == torch.bool:
        return ~entry
    if entry.dtype == torch.int8:  # cells of maps
        return torch.randint(-1, 2, entry.shape, generator=chance, dtype=torch.int8)
    return 1 - entry if entry.is_floating_point() else entry + 1


def _rest(step: TensorDictBase, robot: int, chance: torch.Generator) -> None:
    agents = step["agents"]
    keys = [key for key in agents.keys(True, True) if key not in (*_NAMED, "action")]
    _of_others(step, robot, chance, keys)
    if (action := agents.get("action", None)) is not None:
        other = (action + 1) % NUM_ACTIONS
        other[:, robot] = action[:, robot]
        agents["action"] = other


def _outcomes(step: TensorDictBase, robot: int, chance: torch.Generator) -> None:
    for key in _OUTCOMES:
        if (entry := step.get(key, None)) is not None:
            step[key] = _otherwise(entry, chance)


CHANGES: dict[str, Change] = {
    "the obstacles": _obstacles,
    "where people are": _walkers,
    "what will happen": _future,
    "where robots are that it is not linked to": _positions,
    "the maps of other robots": partial(_of_others, keys=("map",)),
    "the links of other robots": partial(_of_others, keys=("linked",)),
    "which other robots have failed": partial(_of_others, keys=("alive",)),
    "what other robots see, count and do": _rest,
    "the team's reward and end": _outcomes,
}
"""All that one robot cannot know, in words, and how it is changed."""


def changed_beyond(
    step: TensorDictBase, robot: int, changes: Collection[str] = tuple(CHANGES), seed: int = 0
) -> TensorDictBase:
    """A copy of an observation in which what one robot cannot know is different.

    Args:
        step: observation of teams, batch [B], as ``ExplorationEnv`` gives it.
        robot: what it observes itself stays as it is.
        changes: names of ``CHANGES``.
        seed: of what is drawn.
    """
    changed = step.clone()
    chance = torch.Generator().manual_seed(seed)
    for name in changes:
        CHANGES[name](changed, robot, chance)
    return changed


class Leak(NamedTuple):
    """An action that changed with what the robot cannot know."""

    robot: int
    step: int
    arena: int
    happened: str
    """The two actions, or the error."""
    changes: tuple[str, ...]
    """Those that suffice by themselves, or all if none does; () if the robot observed the same."""

    def __str__(self) -> str:
        """What happened, in words."""
        where = f"at step {self.step} of arena {self.arena} robot {self.robot} {self.happened}"
        if not self.changes:
            return (
                f"an action does not follow from what its robot observed: {where} when it observed "
                "the same once more. Robots must not share anything nor look at the environment, "
                "and what they draw must follow from the given seed, or come from random, numpy's "
                "or torch's own generators"
            )
        changes = "; ".join(self.changes)
        return f"a robot acts on what it cannot know: {where} when this was changed: {changes}"


def require_decentralised(
    name: str,
    config: ArenaConfig,
    num_arenas: int = ARENAS,
    steps: int = STEPS,
    seed: int = 0,
    arenas: str | Generator = "uniform",
) -> None:
    """Raise an error if a robot of a policy acts on what it cannot know, in some test episodes.

    Args:
        name: of the policy, as for ``find_policy``.
        config: the arenas and their robots.
        num_arenas: arenas played.
        steps: length of the episodes.
        seed: of the arenas and of everything drawn.
        arenas: a suite's name or a generator, as for ``ExplorationEnv``.

    Raises:
        ValueError: saying what was changed, for which robot, and at which step its action changed.
    """
    leak = find_leak(partial(find_policy, name, config), config, num_arenas, steps, seed, arenas)
    if leak is not None:
        raise ValueError(f"policy={name!r} is not allowed: {leak}")


@torch.no_grad()
def find_leak(
    make: Callable[[], Actor],
    config: ArenaConfig,
    num_arenas: int = ARENAS,
    steps: int = STEPS,
    seed: int = 0,
    arenas: str | Generator = "uniform",
) -> Leak | None:
    """The first action that depends on what its robot cannot know; None if none does.

    Args:
        make: makes the policy; called several times, since a policy may remember its episode.
        config, num_arenas, steps, seed, arenas: as for ``require_decentralised``.
    """
    require_integer("num_arenas", num_arenas, 1)
    require_integer("steps", steps, 1)
    with own_chance():
        policy = make()
        history = _played(policy, config, num_arenas, steps, seed, arenas)
        alone = isinstance(policy, RobotPolicies)  # each robot is given its observation only
        # what a policy of one robot draws follows from the key, which it is not given
        changes = tuple(name for name in CHANGES if not (alone and CHANGES[name] is _future))
        for robot in range(config.num_agents):
            for tried in ((), changes):
                if leak := _first(make(), history, robot, tried, seed):
                    if alone or not tried:
                        return leak
                    until = history[: leak.step + 2]
                    each = [n for n in tried if _first(make(), until, robot, (n,), seed)]
                    return leak._replace(changes=tuple(each) or tried)
    return None


def _played(
    policy: Actor,
    config: ArenaConfig,
    num_arenas: int,
    steps: int,
    seed: int,
    arenas: str | Generator,
) -> list[TensorDictBase]:
    """The observations of episodes. The world that they are from is gone then."""
    where = in_order(arenas, config)
    env = ExplorationEnv(
        config, num_arenas, max_steps=steps, arenas=where, seed=seed, stream=TEST_STREAM
    )
    decisions = iter(range(steps))

    def drawing(step: TensorDictBase) -> TensorDictBase:
        set_chance(_key(seed, next(decisions)))
        return policy(step)

    return list(play(drawing, env, steps))


def _key(seed: int, step: int) -> int:
    return int(combine(seed, step))


def _first(
    policy: Actor,
    history: Sequence[TensorDictBase],
    robot: int,
    changes: Sequence[str],
    seed: int,
) -> Leak | None:
    """The first action of a robot that is another one when something is changed all along."""
    for number, (step, after) in enumerate(pairwise(history)):
        key = _key(seed, number)
        changed = changed_beyond(step, robot, changes, key)
        set_chance(key)
        try:
            acted = policy(changed)[ACTION][:, robot]
        except Exception as error:  # whatever a policy does without what it cannot know
            return Leak(robot, number, 0, f"fails ({type(error).__name__}: {error})", ())
        before = after[ACTION][:, robot]
        different = (acted != before) & step["agents", "alive"][:, robot]
        if different.any():
            arena = int(different.nonzero()[0])
            told = f"chose {int(before[arena])}, and {int(acted[arena])}"
            return Leak(robot, number, arena, told, ())
    return None
