"""Runs ``RobotCore`` in simulated labs, all arenas side by side."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_integer
from marl_explore.config.constants import Normalization
from marl_explore.lab.measures import LabRecord
from marl_explore.lab.planner_policy import MakePolicy
from marl_explore.lab.world import LabWorld, Noise
from marl_explore.policies.export import export_npz
from marl_explore.policies.policy import Policy
from marl_explore.robot import (
    BarrierClock,
    ExportedPolicy,
    Pose,
    RobotCore,
    RobotSettings,
    Scan,
)

_MOST_SECONDS = 300.0  # limit for one step; robots give up much earlier


def exported_policies(
    policy: Policy, sample: bool = True, seed: int = 0, robots: int | None = None
) -> MakePolicy:
    """A trained policy as robots run it, in numpy.

    Args:
        policy: the team.
        sample: whether actions are sampled; False: the most likely actions.
        seed: of the sampled actions; every arena and robot has its own.
        robots: size of the team; None: of that which the policy was trained for.

    Raises:
        ValueError: for a policy that is for another number of robots, or cannot be exported.
    """
    robots = policy.config.arena.num_agents if robots is None else robots
    policy.check(robots, policy.config.arena.fov_size)
    with tempfile.TemporaryDirectory() as folder:
        path = export_npz(policy, Path(folder) / "policy.npz")
        actors = [ExportedPolicy(path, robot, sample, seed) for robot in range(robots)]
    return lambda arena, robot: actors[robot].with_seed([seed, arena, robot])


class LabRunner:
    """Teams of robots in simulated labs; every step ends for all arenas together.

    Args:
        policy: a trained policy, whose actions are sampled, or the policy of each robot.
        arenas: obstacles bool [A, H, W] and start cells int64 [A, N, 2].
        noise: of ranges and poses.
        config: sizes and ranges; None: the trained policy's, or the paper's.
        fpr: normalisation of the frontier table; a trained policy brings its own.
        seed: of noise, initial headings and sampled actions.

    Raises:
        ValueError: for starts that are occupied or shared, a layout of another size, or a policy
            for another team or field of view.
        ModuleNotFoundError: without VMAS (the extra "lab").
    """

    def __init__(
        self,
        policy: Policy | MakePolicy,
        arenas: tuple[Tensor, Tensor],
        noise: Noise | None = None,
        config: ArenaConfig | None = None,
        fpr: Normalization | None = "relative",
        seed: int = 0,
    ) -> None:
        if isinstance(policy, Policy):
            config, fpr = config or policy.config.arena, policy.config.fpr
            policy = policy.in_world(config)
            policy = exported_policies(policy, seed=seed, robots=config.num_agents)
        self.config = config or ArenaConfig()
        self.world = LabWorld(self.config, arenas, noise, seed)
        robots = range(self.config.num_agents)
        # the lidar turns once per step, so a scan may be as old as a step
        settings = RobotSettings(max_scan_age=math.inf)
        self.teams = [
            [
                RobotCore(i, self.config, policy(arena, i), BarrierClock(robots), fpr, settings)
                for i in robots
            ]
            for arena in range(len(arenas[0]))
        ]

    def run(self, steps: int = 60) -> LabRecord:
        """Explore for ``steps`` steps; call this only once.

        Raises:
            RuntimeError: when a step does not end.
        """
        require_integer("steps", steps, 1)
        maps, cells, actions = [], [], []
        for _ in range(steps + 1):
            self._drive_until_all_sense()
            self._scan()
            cells.append(self.world.cells())
            maps.append(self._each(lambda core: core.knowledge.map))
            actions.append(self._each(lambda core: core.action))
        sent: Counter[str] = Counter()
        for core in self._cores():
            sent += core.mail.sent_bytes
        return LabRecord(
            config=self.config,
            obstacles=self.world.obstacles,
            maps=torch.stack(maps, 1),
            cells=torch.stack(cells, 1),
            actions=torch.stack(actions[:-1], 1),
            robot_contacts=self.world.contacts["robots"],
            obstacle_contacts=self.world.contacts["obstacles"],
            seconds=self.world.now,
            sent_bytes=dict(sent),
        )

    def _cores(self) -> Iterator[RobotCore]:
        for team in self.teams:
            yield from team

    def _each(self, value: Callable[[RobotCore], Any]) -> Tensor:
        """A value of every robot, [A, N, ...]."""
        rows = [np.stack([value(core) for core in team]) for team in self.teams]
        return torch.from_numpy(np.stack(rows))

    def _drive_until_all_sense(self) -> None:
        limit = self.world.now + _MOST_SECONDS
        velocities = torch.zeros(len(self.teams), self.config.num_agents, 2)
        while True:
            self.world.drive(velocities)
            self._tell_poses()
            velocities = self._advance()
            if all(core.is_sensing for core in self._cores()):
                return
            if self.world.now > limit:
                stuck = [i for i, t in enumerate(self.teams) if not all(c.is_sensing for c in t)]
                raise RuntimeError(f"arenas {stuck} did not end a step in {_MOST_SECONDS} s")

    def _advance(self) -> Tensor:
        """Advance all robots until there are no more messages; velocities float32 [A, N, 2]."""
        velocities = torch.zeros(len(self.teams), self.config.num_agents, 2)
        for arena, team in enumerate(self.teams):
            quiet = False
            while not quiet:
                outputs = [core.advance(self.world.now) for core in team]
                letters = [letter for output in outputs for letter in output.messages]
                for letter in letters:
                    for receiver in letter.to:
                        team[receiver].receive(letter, self.world.now)
                quiet = not letters
            velocities[arena] = torch.tensor([output.velocity for output in outputs])
        return velocities

    def _tell_poses(self) -> None:
        now = self.world.now
        for team, row in zip(self.teams, self.world.measured_poses().tolist(), strict=True):
            poses = [Pose(now, robot, *pose) for robot, pose in enumerate(row)]
            for core in team:
                for pose in poses:
                    core.receive(pose, now)

    def _scan(self) -> None:
        """One turn of every lidar, and the robots' decisions."""
        now = self.world.now
        for team, rows in zip(self.teams, self.world.measured_ranges(), strict=True):
            for core, ranges in zip(team, rows, strict=True):
                core.receive(Scan(now, ranges), now)
        self._advance()
