"""The arena as a VMAS scenario: boxes, discs of a TurtleBot3's size, wheels and lidars."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from vmas.simulator.core import Agent, Box, Landmark, Sphere, World
from vmas.simulator.dynamics.diff_drive import DiffDrive
from vmas.simulator.scenario import BaseScenario
from vmas.simulator.sensors import Lidar
from vmas.simulator.utils import Color

from marl_explore.config.arena import ArenaConfig

if TYPE_CHECKING:
    from vmas.simulator.rendering import Geom

ROBOT_RADIUS = 0.105
"""Of a TurtleBot3 Burger (metres)."""
RAYS = 360
MAX_RANGE = 3.5
"""Of its lidar (metres)."""
STEP_SECONDS = 0.1
_PIXELS = 600  # longer side of a picture
_AWAY = 100.0  # position of boxes that a layout does not need (metres)


def centres(cells: Tensor, config: ArenaConfig) -> Tensor:
    """Middles of cells [*B, 2] (row, column), float32 [*B, 2] (x east, y north; metres)."""
    row, column = cells.unbind(-1)
    east = column + 0.5 - config.width / 2
    return torch.stack((east, config.height / 2 - row - 0.5), -1).float() * config.cell_size


class LabScenario(BaseScenario):
    """The arenas of a batch, given as layouts; made by ``vmas.simulator.environment.Environment``.

    Its keyword arguments are config, an ``ArenaConfig``; obstacles, bool [B, H, W]; positions,
    int64 [B, N, 2]; and headings, float [B, N] (radians).
    """

    def make_world(self, batch_dim: int, device: torch.device, **layout: Any) -> World:
        """The boxes and robots of all layouts."""
        self.config: ArenaConfig = layout["config"]
        self.obstacles, self.positions = layout["obstacles"], layout["positions"]
        self.headings = layout["headings"]
        # one substep without drag: robots drive exactly as commanded
        world = World(batch_dim, device, dt=STEP_SECONDS, substeps=1, drag=0.0, collision_force=60)
        size = self.config.cell_size
        for number in range(int(self.obstacles.flatten(1).sum(-1).max())):
            box = Landmark(f"box_{number}", collide=True, shape=Box(size, size), color=Color.GRAY)
            world.add_landmark(box)
        for number in range(self.config.num_agents):
            world.add_agent(self._robot(world, number))
        self._show_whole_arena()
        return world

    def _show_whole_arena(self) -> None:
        """Make pictures show the whole arena."""
        height, width = self.config.height, self.config.width
        self.viewer_size = (
            _PIXELS * width // max(height, width),
            _PIXELS * height // max(height, width),
        )
        # VMAS shows the square of this value, in metres, on each side of the middle
        self.viewer_zoom = math.sqrt(min(height, width) * self.config.cell_size / 2)

    @staticmethod
    def _robot(world: World, number: int) -> Agent:
        return Agent(
            f"robot_{number}",
            shape=Sphere(ROBOT_RADIUS),
            u_range=[0.22, 2.84],  # a TurtleBot3's
            dynamics=DiffDrive(world, integration="rk4"),
            sensors=[Lidar(world, n_rays=RAYS, max_range=MAX_RANGE, render=False)],
            render_action=False,
        )

    def reset_world_at(self, env_index: int | None = None) -> None:
        """Put boxes and robots where the layouts have them."""
        rows = range(self.world.batch_dim) if env_index is None else [env_index]
        for row in rows:
            boxes = centres(self.obstacles[row].nonzero(), self.config)
            for number, landmark in enumerate(self.world.landmarks):
                away = torch.tensor([_AWAY, _AWAY + number])
                landmark.set_pos(boxes[number] if number < len(boxes) else away, batch_index=row)
            starts = centres(self.positions[row], self.config)
            for number, robot in enumerate(self.world.agents):
                robot.set_pos(starts[number], batch_index=row)
                robot.set_rot(self.headings[row, number].reshape(1), batch_index=row)

    def extra_render(self, env_index: int = 0) -> list[Geom]:
        """A line from the middle of each robot in its heading, drawn before the robots."""
        from vmas.simulator.rendering import Line  # the import loads a display library

        lines = []
        for robot in self.world.agents:
            x, y = robot.state.pos[env_index].tolist()
            yaw = float(robot.state.rot[env_index])
            ahead = x + 2 * ROBOT_RADIUS * math.cos(yaw), y + 2 * ROBOT_RADIUS * math.sin(yaw)
            line = Line((x, y), ahead, width=2)
            line.set_color(*Color.RED.value)
            lines.append(line)
        return lines

    def observation(self, agent: Agent) -> Tensor:
        """Pose of an agent: x, y (metres) and yaw (radians), [B, 3]."""
        return torch.cat((agent.state.pos, agent.state.rot), -1)

    def reward(self, agent: Agent) -> Tensor:
        """Not used: nothing is learned here."""
        return torch.zeros(self.world.batch_dim)
