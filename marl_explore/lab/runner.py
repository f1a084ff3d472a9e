"""Grid actions carried out by ``RobotCore`` in the lab, all arenas side by side."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_explore.codes import Normalization
from marl_explore.config import ArenaConfig, require_integer
from marl_explore.core.world import check_starts
from marl_explore.export import export_npz
from marl_explore.lab.measures import LabRecord
from marl_explore.policies import Policy
from marl_explore.robot import BarrierClock, ExportedPolicy, Pose, RobotCore, Scan, Settings
from marl_explore.robot import core as robot_core

MakePolicy = Callable[[int, int], robot_core.Policy]
"""The policy of a robot: (arena, robot) -> (``Observation`` -> action)."""
_MOST_SECONDS = 300.0  # of one step; robots give up much earlier


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is measured."""

    range_share: float = 0.0
    """Of a range, as a share of it."""
    position: float = 0.0
    """Of x and of y (metres)."""
    heading: float = 0.0
    """Of yaw (radians)."""


def exported_policies(policy: Policy, sample: bool = True, seed: int = 0) -> MakePolicy:
    """A trained policy as robots run it, by numpy.

    Args:
        policy: the team.
        sample: whether actions are drawn, or the likeliest are taken.
        seed: of the drawn actions; every arena and robot has its own.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = export_npz(policy, Path(folder) / "policy.npz")
        robots = policy.spec.arena.num_agents
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
        seed: of noise, first headings and sampled actions.

    Raises:
        ValueError: for starts that are occupied or shared, or a layout of another size.
        ModuleNotFoundError: without VMAS, the extra "lab".
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
        self.obstacles, self.starts = arenas
        if isinstance(policy, Policy):
            config, fpr = config or policy.spec.arena, policy.spec.fpr
            policy = exported_policies(policy, seed=seed)
        self.config = config or ArenaConfig()
        self._check()
        self.noise = noise or Noise()
        self._chance = np.random.default_rng(seed)
        robots = range(self.config.num_agents)
        # the lidar turns once per step: its scan may be as old as that
        settings = Settings(max_scan_age=math.inf)
        self.teams = [
            [
                RobotCore(i, self.config, policy(arena, i), BarrierClock(robots), fpr, settings)
                for i in robots
            ]
            for arena in range(len(self.obstacles))
        ]
        self._now = 0.0
        self._touching: dict[str, NDArray[np.bool_]] = {}
        self._contacts: Counter[str] = Counter()
        self._lab = self._build()

    def run(self, steps: int = 60) -> LabRecord:
        """Explore for so many steps; to be called once.

        Raises:
            RuntimeError: when a step does not end.
        """
        require_integer("steps", steps, 1)
        maps, cells, actions = [], [], []
        for _ in range(steps + 1):
            self._drive_until_all_sense()
            self._scan()
            cells.append(self._true_cells())
            maps.append(self._each(lambda core: core.knowledge.map))
            actions.append(self._each(lambda core: core.action))
        sent: Counter[str] = Counter()
        for core in self._cores():
            sent += core.mail.sent_bytes
        return LabRecord(
            config=self.config,
            obstacles=self.obstacles,
            maps=torch.stack(maps, 1),
            cells=torch.stack(cells, 1),
            actions=torch.stack(actions[:-1], 1),
            robot_contacts=self._contacts["robots"],
            obstacle_contacts=self._contacts["obstacles"],
            seconds=self._now,
            sent_bytes=dict(sent),
        )

    def _check(self) -> None:
        size, robots = (self.config.height, self.config.width), self.config.num_agents
        if tuple(self.obstacles.shape[1:]) != size or tuple(self.starts.shape[1:]) != (robots, 2):
            raise ValueError(
                f"arenas of shapes {tuple(self.obstacles.shape)} and {tuple(self.starts.shape)} "
                f"are not allowed: the configuration has {size} cells and {robots} robots"
            )
        check_starts(self.obstacles, self.starts)

    def _build(self) -> Any:
        """The VMAS environment."""
        from vmas.simulator.environment import Environment

        from marl_explore.lab.scenario import LabScenario

        shape = self.starts.shape[:2]
        headings = torch.from_numpy(self._chance.uniform(-math.pi, math.pi, shape)).float()
        return Environment(
            LabScenario(),
            num_envs=len(self.obstacles),
            device="cpu",
            seed=0,
            config=self.config,
            obstacles=self.obstacles,
            positions=self.starts,
            headings=headings,
        )

    def _cores(self) -> Iterator[RobotCore]:
        for team in self.teams:
            yield from team

    def _each(self, value: Callable[[RobotCore], Any]) -> Tensor:
        """Something of every robot, [A, N, ...]."""
        rows = [np.stack([value(core) for core in team]) for team in self.teams]
        return torch.from_numpy(np.stack(rows))

    # --------------------------------------------------------------------- time

    def _drive_until_all_sense(self) -> None:
        limit = self._now + _MOST_SECONDS
        while True:
            self._now += self._lab.world.dt
            self._tell_poses()
            velocities = self._advance()
            if all(core.is_sensing for core in self._cores()):
                return
            if self._now > limit:
                stuck = [i for i, t in enumerate(self.teams) if not all(c.is_sensing for c in t)]
                raise RuntimeError(f"arenas {stuck} did not end a step in {_MOST_SECONDS} s")
            for robot, agent in enumerate(self._lab.agents):
                agent.action.u = velocities[:, robot]
                agent.dynamics.process_action()
            self._lab.world.step()
            self._count_contacts()

    def _advance(self) -> Tensor:
        """Let all robots act and hear until nobody says more; velocities float32 [A, N, 2]."""
        velocities = torch.zeros(*self.starts.shape)
        for arena, team in enumerate(self.teams):
            quiet = False
            while not quiet:
                outputs = [core.advance(self._now) for core in team]
                letters = [letter for output in outputs for letter in output.messages]
                for letter in letters:
                    for receiver in letter.to:
                        team[receiver].receive(letter, self._now)
                quiet = not letters
            velocities[arena] = torch.tensor([output.velocity for output in outputs])
        return velocities

    # ------------------------------------------------------------------ sensors

    def _poses(self) -> Tensor:
        """True x, y, yaw of all robots, [A, N, 3]."""
        return torch.stack([self._lab.scenario.observation(a) for a in self._lab.agents], 1)

    def _tell_poses(self) -> None:
        deviation = [self.noise.position, self.noise.position, self.noise.heading]
        measured = self._chance.normal(self._poses().numpy(), deviation)
        for team, row in zip(self.teams, measured.tolist(), strict=True):
            poses = [Pose(self._now, robot, *pose) for robot, pose in enumerate(row)]
            for core in team:
                for pose in poses:
                    core.receive(pose, self._now)

    def _scan(self) -> None:
        """One turn of every lidar, and what the robots decide on it."""
        for robot, agent in enumerate(self._lab.agents):
            ranges = agent.sensors[0].measure().numpy()
            factor = self._chance.normal(1.0, self.noise.range_share, ranges.shape)
            ranges = np.where(ranges < agent.sensors[0]._max_range - 1e-3, ranges * factor, 0.0)
            for team, row in zip(self.teams, ranges, strict=True):
                team[robot].receive(Scan(self._now, row), self._now)
        self._advance()

    # ----------------------------------------------------------------- measures

    def _true_cells(self) -> Tensor:
        poses, config = self._poses(), self.config
        row = config.height / 2 - poses[..., 1] / config.cell_size
        column = config.width / 2 + poses[..., 0] / config.cell_size
        return torch.stack((row, column), -1).floor().long()

    def _count_contacts(self) -> None:
        """Contacts that began in this instant."""
        from marl_explore.lab.scenario import ROBOT_RADIUS, centres

        place = self._poses()[..., :2]
        pairs = torch.cdist(place, place) < 2 * ROBOT_RADIUS
        self._count("robots", pairs.triu(1).numpy())
        corners = self._lab.scenario.obstacles.nonzero()
        offset = (place[corners[:, 0]] - centres(corners[:, 1:], self.config).unsqueeze(1)).abs()
        gap = (offset - self.config.cell_size / 2).clamp_min(0).norm(dim=-1)
        self._count("obstacles", (gap < ROBOT_RADIUS).numpy())

    def _count(self, kind: str, touching: NDArray[np.bool_]) -> None:
        before = self._touching.get(kind, np.zeros_like(touching))
        self._contacts[kind] += int((touching & ~before).sum())
        self._touching[kind] = touching
