"""Planners as the policies of robots in the lab: on board where there is one, else with torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.planners import PLANNERS
from marl_explore.robot import planners as on_board
from marl_explore.robot import runtime
from marl_explore.robot.observation import Observation

MakePolicy = Callable[[int, int], runtime.Policy]
"""The policy of a robot: (arena, robot) -> (``Observation`` -> action)."""


def planner_policies(name: str, config: ArenaConfig, seed: int = 0) -> MakePolicy:
    """A planner as the policy of every robot.

    Args:
        name: of ``marl_explore.planners.PLANNERS``.
        config: the arena and its robots.
        seed: of the random choices; every arena and robot has its own.

    Raises:
        ValueError: for an unknown planner, and one that uses what no robot knows.
    """
    if name in on_board.PLANNERS:
        return lambda arena, robot: on_board.PLANNERS[name](robot, config, 0).with_seed(
            [seed, arena, robot]
        )
    if name not in PLANNERS:
        raise ValueError(f"planner={name!r} is not one of {', '.join(PLANNERS)}")
    if getattr(PLANNERS[name](config), "reference", False):
        raise ValueError(f"planner={name!r} is not allowed: it uses what no robot knows")
    return lambda arena, robot: PlannerPolicy(PLANNERS[name](config), robot, [seed, arena, robot])


class PlannerPolicy:
    """A planner in torch that decides for one robot.

    It gets a team in which the entries of all robots are this robot's, but for the positions of
    those that it is linked to: planners decide for every robot from its own entries.

    Args:
        planner: a new one, since some remember their episode.
        robot: its number.
        seed: of its random choices.
    """

    def __init__(
        self, planner: TensorDictModuleBase, robot: int, seed: int | Sequence[int]
    ) -> None:
        self.planner, self.robot = planner, robot
        self._chance = np.random.default_rng(seed)

    def __call__(self, observed: Observation) -> int:
        """An action."""
        team = team_of(observed, self.robot)
        with torch.random.fork_rng(devices=()), torch.no_grad():
            torch.manual_seed(int(self._chance.integers(2**62)))
            action: Tensor = self.planner(team).get(("agents", "action"))
        return int(action[0, self.robot])


def team_of(observed: Observation, robot: int) -> TensorDict:
    """What planners read, batch [1], from the observation of one robot.

    Args:
        observed: the robot's observation.
        robot: its number.
    """
    robots = len(observed.net)
    position = torch.tensor([[observed.position] * robots])
    linked = torch.eye(robots, dtype=torch.bool)[None]
    for mate, cell in observed.mates.items():
        position[0, mate] = torch.tensor(cell)
        linked[0, robot, mate] = linked[0, mate, robot] = True

    def of_all(entry: np.ndarray | Tensor) -> Tensor:
        one = torch.as_tensor(entry)
        return one.expand(1, robots, *one.shape).clone()

    merged = torch.tensor((observed.steps_since_merge == 0).sum() > 1)  # itself is one of them
    own = ("map", "action_mask", "steps_since_merge", "unshared")
    agents = {name: of_all(getattr(observed, name)) for name in own}
    agents |= {
        "position": position,
        "linked": linked,
        "merged": of_all(merged),
        "dangerous": of_all(torch.tensor(observed.refused)),
        "observation": TensorDict({"fov": of_all(observed.fov)}, [1, robots]),
    }
    return TensorDict(
        {"step_count": torch.tensor([[observed.step]]), "agents": TensorDict(agents, [1])}, [1]
    )
