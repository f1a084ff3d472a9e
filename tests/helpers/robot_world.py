"""A plain world for robots: exact beams through grid cells, exact motion, messages at once."""

from __future__ import annotations

import math

import numpy as np

from marl_explore.robot import BarrierClock, Pose, RobotCore, RobotSettings, Scan
from marl_explore.robot.geometry import Frame, Mount

RADIUS = 0.105
RAYS = 360
RANGE = 3.5


def cast(obstacles, frame, x, y, angle, longest=RANGE):
    """Distance to the first obstacle along a beam, by walking from border to border; 0 for none."""
    height, width = obstacles.shape
    across, down = x / frame.cell_size + width / 2, height / 2 - y / frame.cell_size
    step_across, step_down = math.cos(angle), -math.sin(angle)
    gone = 0.0
    while gone * frame.cell_size < longest:
        to_borders = []
        for place, step in ((across, step_across), (down, step_down)):
            if step > 1e-12:
                to_borders.append((math.floor(place + 1e-9) + 1 - place) / step)
            elif step < -1e-12:
                to_borders.append((math.ceil(place - 1e-9) - 1 - place) / step)
        forward = min(to_borders)
        gone += forward
        across, down = across + step_across * forward, down + step_down * forward
        column = math.floor(across + 1e-6 * math.copysign(1, step_across))
        row = math.floor(down + 1e-6 * math.copysign(1, step_down))
        if not (0 <= row < height and 0 <= column < width):
            return 0.0
        if obstacles[row, column]:
            return gone * frame.cell_size if gone * frame.cell_size < longest else 0.0
    return 0.0


def scan_of(obstacles, frame, pose, others=(), stamp=None, poles=(), walls=(), mount=None):
    """A perfect scan of boxes and of other robots, which are discs; inf is no return.

    Poles are discs (x, y, radius) and walls lines ((x, y), (x, y)), in metres. The lidar is at
    ``mount``, and the scan does not say so.
    """
    eye = pose.of_sensor(mount or Mount())
    angles = eye.yaw + 2 * math.pi / RAYS * np.arange(RAYS)
    ranges = np.array([cast(obstacles, frame, eye.x, eye.y, angle) for angle in angles])
    ranges[ranges == 0] = math.inf
    for x, y, radius in (*poles, *((other.x, other.y, RADIUS) for other in others)):
        ranges = np.minimum(ranges, to_disc(angles, x - eye.x, y - eye.y, radius))
    for (x0, y0), (x1, y1) in walls:
        ends = (x0 - eye.x, y0 - eye.y), (x1 - eye.x, y1 - eye.y)
        ranges = np.minimum(ranges, to_wall(angles, *ends))
    ranges[ranges >= RANGE] = math.inf
    return Scan(pose.stamp if stamp is None else stamp, ranges)


def to_disc(angles, east, north, radius):
    """Distances along beams to a disc, inf for none."""
    along = east * np.cos(angles) + north * np.sin(angles)
    inside = radius**2 - (east**2 + north**2 - along**2)
    hit = along - np.sqrt(np.maximum(inside, 0))
    return np.where((inside > 0) & (hit > 0), hit, math.inf)


def to_wall(angles, start, end):
    """Distances along beams to a line from start to end, inf for none."""
    (x, y), (along_x, along_y) = start, np.subtract(end, start)
    across = np.cos(angles) * along_y - np.sin(angles) * along_x
    across = np.where(np.abs(across) < 1e-12, 1e-12, across)
    distance = (x * along_y - y * along_x) / across
    share = (x * np.sin(angles) - y * np.cos(angles)) / across
    return np.where((distance > 0) & (share >= 0) & (share <= 1), distance, math.inf)


class World:
    """A team of ``RobotCore`` in an arena; times are seconds from 0 on.

    Args:
        config: the arena.
        obstacles: bool [H, W].
        positions: [N, 2] cells.
        policies: one per robot.
        make_clock: a robot's clock.
        seed: of the first headings.
        lost: envelope -> whether it never arrives.
        options: arguments of ``RobotCore``.
    """

    STEP = 0.1

    def __init__(
        self, config, obstacles, positions, policies, make_clock=None, seed=0, lost=None, **options
    ):
        make_clock = make_clock or (lambda: BarrierClock(range(config.num_agents)))
        chance = np.random.default_rng(seed)
        self.obstacles, self.frame, self.now = np.asarray(obstacles), Frame.of(config), 0.0
        self.poses = [
            Pose(0.0, i, *self.frame.centre(tuple(cell)), chance.uniform(-math.pi, math.pi))
            for i, cell in enumerate(positions)
        ]
        self.cores = [
            RobotCore(i, config, policy, make_clock(), **options)
            for i, policy in enumerate(policies)
        ]
        self.dead = set()
        self.lost = lost or (lambda envelope: False)
        self.closest = math.inf

    def alive(self):
        return [core for core in self.cores if core.robot not in self.dead]

    def step(self):
        """One step of time: poses, scans for who waits for one, messages until quiet, motion."""
        self.now += self.STEP
        self.poses = [Pose(self.now, p.robot, p.x, p.y, p.yaw) for p in self.poses]
        for core in self.alive():
            self.give_poses(core)
        outputs = self._until_quiet()
        for core in self.alive():
            if core.is_sensing:
                self.give(core, self._scan(core.robot))
        outputs |= self._until_quiet()
        for robot, output in outputs.items():
            self.poses[robot] = self._moved(self.poses[robot], *output.velocity)
        self._measure()

    def give(self, core, event):
        """Hand a measurement to a robot."""
        core.receive(event, self.now)

    def give_poses(self, core):
        """Hand the poses of all robots to a robot."""
        for pose in self.poses:
            self.give(core, pose)

    def advance(self, core):
        """A robot's output now."""
        return core.advance(self.now)

    def run(self, ticks, most_steps=20_000):
        """Until every robot alive has sensed tick ``ticks``."""
        for _ in range(most_steps):
            if all(core.tick - core.is_sensing >= ticks for core in self.alive()):
                return
            self.step()
        raise AssertionError(f"stuck: {[(c.tick, c._phase.__name__) for c in self.cores]}")

    def _scan(self, robot):
        others = [pose for pose in self.poses if pose.robot != robot]
        return scan_of(self.obstacles, self.frame, self.poses[robot], others)

    def _until_quiet(self):
        outputs = {}
        quiet = False
        while not quiet:
            quiet = True
            for core in self.alive():
                outputs[core.robot] = output = self.advance(core)
                for envelope in output.messages:
                    quiet = False
                    self._deliver(envelope)
        return outputs

    def _deliver(self, envelope):
        if self.lost(envelope):
            return
        for receiver in envelope.to:
            if receiver not in self.dead:
                self.cores[receiver].receive(envelope, self.now)

    def _moved(self, pose, forward, turn):
        """Exactly along an arc."""
        middle = pose.yaw + turn * self.STEP / 2
        half = turn * self.STEP / 2
        chord = forward * self.STEP * (math.sin(half) / half if half else 1.0)
        x, y = pose.x + chord * math.cos(middle), pose.y + chord * math.sin(middle)
        return Pose(pose.stamp, pose.robot, x, y, pose.yaw + turn * self.STEP)

    def _measure(self):
        for i, a in enumerate(self.poses):
            for b in self.poses[:i]:
                self.closest = min(self.closest, math.hypot(a.x - b.x, a.y - b.y))


def scripted(actions):
    """A policy that takes given actions in turn, then stays."""
    remaining = iter(actions)
    return lambda observation: next(remaining, 8)


PATIENT = RobotSettings(max_scan_age=math.inf, stop_when_complete=False)
"""For worlds where a scan is taken once per tick."""
