"""Policies of other packages, by name: ``package.module:attribute`` (docs/benchmark.md).

A function or class acts for one robot, on what that robot observes. A TensorDict module acts for
whole teams, on what the environment gives.
"""

from __future__ import annotations

import copy
import inspect
import os
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require
from marl_explore.config.constants import NORMALIZATIONS, NUM_ACTIONS, STAY
from marl_explore.core.hashing import combine, text_key
from marl_explore.envs.given import as_integer, checked_action
from marl_explore.policies.observations import robot_observations
from marl_explore.robot.observation import Observation
from marl_explore.transforms.features import make_features
from marl_explore.utils.chance import own_chance, set_chance

NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
OBSERVES = ("robot", "pettingzoo")
"""What a policy of one robot may ask to be called with: an ``Observation``, or the dictionary that
``parallel_env`` gives an agent."""
GIVEN = ("robot", "config", "seed")
"""What a class may take: the robot's number, the arena's settings, and an integer that is another
one for every robot and episode."""
Seen = Observation | dict[str, Any]
RobotPolicy = Callable[[Seen], Any]


def outside_policy(name: str, config: ArenaConfig) -> RobotPolicies | TeamPolicy:
    """The policy with a name "package.module:attribute", ready to act in ``config``.

    Raises:
        ValueError: naming what is wrong: the module, the attribute, or what it is.
    """
    found = load(name)
    require(callable(found), "policy", name, "it is no function, no class and no module")
    if for_team(found):
        return TeamPolicy(name, found, config)
    return RobotPolicies(name, found, config)


def load(name: str) -> Any:
    """The attribute with this name; the module is also looked for in the working folder.

    Raises:
        ValueError: when there is none.
    """
    module, _, path = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # an installed program does not look there
    try:
        found: Any = import_module(module)
    except Exception as error:  # whatever happens in the code of others
        why = f"the module {module!r} cannot be imported ({type(error).__name__}: {error})"
        raise ValueError(f"policy={name!r} is not allowed: {why}") from error
    for part in path.split("."):
        require(hasattr(found, part), "policy", name, f"{module!r} has no attribute {path!r}")
        found = getattr(found, part)
    return found


def for_team(found: Any) -> bool:
    """Whether a policy acts for whole teams: a TensorDict module, or marked ``for_team = True``."""
    kind = found if inspect.isclass(found) else type(found)
    return issubclass(kind, TensorDictModuleBase) or getattr(found, "for_team", False)


def package_files(name: str) -> list[Path]:
    """The file of the module that a policy is in, or the folder of its package."""
    load(name)
    top = sys.modules[name.partition(":")[0].partition(".")[0]]
    file = getattr(top, "__file__", None)
    folders = [Path(folder) for folder in getattr(top, "__path__", ())]
    return folders or ([Path(file)] if file else [])


def version_of(name: str) -> str | None:
    """The ``__version__`` of the module or package that a policy is in, if it has one."""
    load(name)
    module = name.partition(":")[0]
    for place in (module, module.partition(".")[0]):
        if (version := getattr(sys.modules[place], "__version__", None)) is not None:
            return str(version)
    return None


class TeamPolicy:
    """A TensorDict module of another package, with a check of its actions.

    Args:
        name: of the policy.
        found: the module, of which a copy acts, or its class.
        config: the arena and its robots.
    """

    whole_batch = True
    """It may remember its episodes by their places in the batch."""

    def __init__(self, name: str, found: Any, config: ArenaConfig) -> None:
        self.name, self.robots = name, config.num_agents
        self.sees, self.reference = _told(found)
        if inspect.isclass(found):
            self._act = _made(name, found, {"config": config})
        else:
            self._act = copy.deepcopy(found)  # some remember their episode

    def to(self, device: torch.device) -> TeamPolicy:
        """The same with its weights on a device."""
        if isinstance(self._act, nn.Module):
            self._act.to(device)
        return self

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action").

        Raises:
            ValueError: when the module does not.
        """
        acted = self._act(tensordict)
        if not isinstance(acted, TensorDictBase):
            got = type(acted).__name__
            raise ValueError(f"policy={self.name!r} must return a TensorDict, got {got}")
        try:
            action = checked_action(acted, self.robots)
        except ValueError as error:
            raise ValueError(f"policy={self.name!r} is not allowed: {error}") from error
        return tensordict.set(("agents", "action"), action)


class RobotPolicies:
    """A policy of one robot for all robots of all arenas, each on its own.

    A function is called for every robot. Of a class there is an object for every robot, made anew
    when an episode begins. Robots that failed are not asked. What a call draws from ``random``,
    numpy's and torch's own generators follows from the episode, the robot and the step alone, so
    an episode is the same in any batch.

    Args:
        name: of the policy.
        found: the function or class.
        config: the arena and its robots.
    """

    def __init__(self, name: str, found: Any, config: ArenaConfig) -> None:
        self.name, self.config = name, config
        self.sees, self.reference = _told(found)
        self._found = found
        observes = getattr(found, "observes", OBSERVES[0])
        fpr: Any = getattr(found, "fpr", "relative")
        require(observes in OBSERVES, f"{name}.observes", observes, f"use one of {OBSERVES}")
        require(fpr in NORMALIZATIONS, f"{name}.fpr", fpr, f"use one of {NORMALIZATIONS}")
        self._observed = _dictionary if observes == "pettingzoo" else _own_copy
        self._features = make_features(config, ("fpr", "net"), fpr)
        self._policies: dict[tuple[int, int], list[RobotPolicy]] = {}
        with own_chance():
            self._make(0, 0)  # an error comes before anything is run

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action") int64 [B, N].

        Raises:
            ValueError: for an action that is none, naming robot and step.
        """
        seen = self._features(tensordict.clone(recurse=False))
        alive, steps = seen["agents", "alive"], seen["step_count"].flatten().tolist()
        action = torch.full_like(alive, STAY, dtype=torch.int64)
        keys = _keys(seen["draw_key"], "step", seen["step_count"], self.config.num_agents)
        observations = robot_observations(seen)
        with own_chance():
            policies = self._of_episodes(seen["draw_key"], steps)
            for arena, robot in alive.nonzero().tolist():
                set_chance(keys[arena][robot])
                observation = self._observed(observations(arena, robot))
                chosen = policies[arena][robot](observation)
                action[arena, robot] = self._checked(chosen, robot, steps[arena])
        return tensordict.set(("agents", "action"), action)

    def _of_episodes(self, draw_key: Tensor, steps: list[int]) -> list[list[RobotPolicy]]:
        """The policies of every arena's robots, made where an episode begins.

        They go by the episode's key, since batches may lose arenas; of arenas with the same key, by
        their order.
        """
        keys = _keys(draw_key, "robot", 0, self.config.num_agents)
        before: Counter[int] = Counter()
        episodes = []
        for key in draw_key.flatten().tolist():
            episodes.append((key, before[key]))
            before[key] += 1
        for episode, step, own in zip(episodes, steps, keys, strict=True):
            if step == 0 or episode not in self._policies:
                self._policies[episode] = [self._made_anew(*robot) for robot in enumerate(own)]
        self._policies = {episode: self._policies[episode] for episode in episodes}
        return [self._policies[episode] for episode in episodes]

    def _made_anew(self, robot: int, seed: int) -> RobotPolicy:
        set_chance(seed)
        return self._make(robot, seed)

    def _make(self, robot: int, seed: int) -> RobotPolicy:
        if not inspect.isclass(self._found):
            return self._found
        given = {"robot": robot, "config": self.config, "seed": seed}
        return _made(self.name, self._found, given)

    def _checked(self, chosen: Any, robot: int, step: int) -> int:
        action = as_integer(chosen)
        if action is None or not 0 <= action < NUM_ACTIONS:
            raise ValueError(
                f"policy={self.name!r} is not allowed: at step {step} robot {robot} chose "
                f"{chosen!r}, and an action is an integer from 0 to {NUM_ACTIONS - 1}"
            )
        return action


def _told(found: Any) -> tuple[str, bool]:
    """What a policy says of itself: what it sees, and whether it is a reference."""
    return str(getattr(found, "sees", "-")), bool(getattr(found, "reference", False))


def _made(name: str, kind: type, given: Mapping[str, Any]) -> Any:
    """An object of a class, with those of the given arguments that it takes."""
    takes = inspect.signature(kind).parameters
    unknown = [p.name for p in takes.values() if p.name not in given and _required(p)]
    allowed = f"its class may take {', '.join(given)}, and needs {', '.join(unknown)}"
    require(not unknown, "policy", name, allowed)
    made = kind(**{key: value for key, value in given.items() if key in takes})
    require(callable(made), "policy", name, "objects of its class cannot be called")
    return made


def _required(parameter: inspect.Parameter) -> bool:
    several = parameter.kind in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return parameter.default is inspect.Parameter.empty and not several


def _keys(draw_key: Tensor, purpose: str, step: Tensor | int, robots: int) -> list[list[int]]:
    """Seeds of all robots at one step, of at least 0, [B][N]."""
    keys = combine(draw_key, text_key(f"policy {purpose}"), torch.arange(robots), step)
    return (keys & torch.iinfo(torch.int64).max).tolist()


def _own_copy(observation: Observation) -> Observation:
    """The observation in arrays of its own: whatever becomes of them, the world stays as it is."""
    return observation._replace(**dict(_copies(observation)))


def _copies(observation: Observation) -> Iterator[tuple[str, Any]]:
    for name, value in observation._asdict().items():
        if hasattr(value, "copy"):
            yield name, value.copy()


def _dictionary(observation: Observation) -> dict[str, Any]:
    """The same as ``adapters.pettingzoo`` gives an agent."""
    parts = (observation.fov.ravel(), observation.fpr.ravel(), observation.net)
    return {
        "observation": np.concatenate(parts),
        "action_mask": observation.action_mask.astype(np.int8),
    }
