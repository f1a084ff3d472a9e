"""Simulated labs side by side: drives robots and reads their sensors."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_not_negative
from marl_explore.config.fields import check_types
from marl_explore.core.world import check_starts
from marl_explore.utils.extras import require_extra

Floats = NDArray[np.floating]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the measurement noise."""

    range_share: float = 0.0
    """Of a range, as a fraction of it."""
    position: float = 0.0
    """Of x and y (metres)."""
    heading: float = 0.0
    """Of yaw (radians)."""

    def __post_init__(self) -> None:
        """Check the deviations."""
        check_types(self)
        units = {"range_share": "of a range", "position": "metres", "heading": "radians"}
        for name, unit in units.items():
            require_not_negative(name, getattr(self, name), unit)


class LabWorld:
    """A arenas with N robots each, in VMAS; time passes only in ``drive``.

    Args:
        config: sizes and ranges.
        arenas: obstacles bool [A, H, W] and start cells int64 [A, N, 2].
        noise: of ranges and poses.
        seed: of noise and initial headings.

    Raises:
        ValueError: for starts that are occupied or shared, or a layout of another size.
        ModuleNotFoundError: without VMAS (the extra "lab").
    """

    def __init__(
        self,
        config: ArenaConfig,
        arenas: tuple[Tensor, Tensor],
        noise: Noise | None = None,
        seed: int = 0,
    ) -> None:
        self.config, self.noise = config, noise or Noise()
        self.obstacles, self.starts = arenas
        self._check()
        self.now = 0.0
        """Seconds."""
        self.contacts: Counter[str] = Counter()
        """How often two "robots", or a robot and one of the "obstacles", began to touch."""
        self._touching: dict[str, NDArray[np.bool_]] = {}
        self._chance = np.random.default_rng(seed)
        self._build()

    def _check(self) -> None:
        size, robots = (self.config.height, self.config.width), self.config.num_agents
        if tuple(self.obstacles.shape[1:]) != size or tuple(self.starts.shape[1:]) != (robots, 2):
            raise ValueError(
                f"arenas of shapes {tuple(self.obstacles.shape)} and {tuple(self.starts.shape)} "
                f"are not allowed: the configuration has {size} cells and {robots} robots"
            )
        check_starts(self.obstacles, self.starts)

    def _build(self) -> None:
        require_extra("vmas")
        from vmas.simulator.environment import Environment

        from marl_explore.lab.scenario import LabScenario

        shape = self.starts.shape[:2]
        headings = torch.from_numpy(self._chance.uniform(-math.pi, math.pi, shape)).float()
        self._vmas = Environment(
            LabScenario(),
            num_envs=len(self.obstacles),
            device="cpu",
            seed=0,
            config=self.config,
            obstacles=self.obstacles,
            positions=self.starts,
            headings=headings,
        )
        self.step_seconds: float = self._vmas.world.dt

    # ------------------------------------------------------------------ ground truth

    def poses(self) -> Tensor:
        """x, y (metres) and yaw (radians) of all robots, float32 [A, N, 3]."""
        return torch.stack([self._vmas.scenario.observation(a) for a in self._vmas.agents], 1)

    def cells(self) -> Tensor:
        """The robots' cells, int64 [A, N, 2]."""
        poses, config = self.poses(), self.config
        row = config.height / 2 - poses[..., 1] / config.cell_size
        column = config.width / 2 + poses[..., 0] / config.cell_size
        return torch.stack((row, column), -1).floor().long()

    def render(self, arena: int = 0) -> NDArray[np.uint8]:
        """A picture of one arena from above, north up, [P, P, 3]; with EGL, without a display."""
        picture: NDArray[np.uint8] = self._vmas.render(mode="rgb_array", env_index=arena)
        return picture

    # ------------------------------------------------------------------ measurements

    def measured_poses(self) -> Floats:
        """``poses`` with noise, [A, N, 3]."""
        deviation = [self.noise.position, self.noise.position, self.noise.heading]
        return self._chance.normal(self.poses().numpy(), deviation)

    def measured_ranges(self) -> Floats:
        """One turn of every lidar (metres; inf is no return), counter-clockwise, [A, N, R]."""
        turns = []
        for agent in self._vmas.agents:
            ranges = agent.sensors[0].measure().numpy()
            factor = self._chance.normal(1.0, self.noise.range_share, ranges.shape)
            returned = ranges < agent.sensors[0]._max_range - 1e-3
            turns.append(np.where(returned, ranges * factor, math.inf))
        return np.stack(turns, 1)

    # ------------------------------------------------------------------ motion

    def drive(self, velocities: Tensor) -> None:
        """Advance time by one step.

        Args:
            velocities: forward (metres per second) and turn (radians per second), [A, N, 2].
        """
        for robot, agent in enumerate(self._vmas.agents):
            agent.action.u = velocities[:, robot]
            agent.dynamics.process_action()
        self._vmas.world.step()
        self.now += self.step_seconds
        self.count_contacts()

    def count_contacts(self) -> None:
        """Count the contacts that began in this step."""
        from marl_explore.lab.scenario import ROBOT_RADIUS, centres

        place = self.poses()[..., :2]
        pairs = torch.cdist(place, place) < 2 * ROBOT_RADIUS
        self._count("robots", pairs.triu(1).numpy())
        corners = self.obstacles.nonzero()
        offset = (place[corners[:, 0]] - centres(corners[:, 1:], self.config).unsqueeze(1)).abs()
        gap = (offset - self.config.cell_size / 2).clamp_min(0).norm(dim=-1)
        self._count("obstacles", (gap < ROBOT_RADIUS).numpy())

    def _count(self, kind: str, touching: NDArray[np.bool_]) -> None:
        before = self._touching.get(kind, np.zeros_like(touching))
        self.contacts[kind] += int((touching & ~before).sum())
        self._touching[kind] = touching
