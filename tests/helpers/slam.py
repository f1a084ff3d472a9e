"""A simulated SLAM and Nav2 for explorers: a true world at 5 cm, lidars, maps that grow, wheels."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from marl_explore.robot.explorer import OccupancyMap, Place

RADIUS = 0.17
"""Of the robots' bodies (metres)."""
NORTH_FIRST = -1
_RING = 0.9 * RADIUS * np.array([(math.cos(i), math.sin(i)) for i in range(16)]).T


class World:
    """A floor plan: ``#`` is a wall, ``=`` glass, letters are doors, digits where robots start.

    Lidars see through glass.

    Args:
        plan: lines, the first one is in the north.
        scale: metres of a character.
        resolution: of the truth (metres).
    """

    def __init__(self, plan, scale=0.25, resolution=0.05):
        rows = plan.strip("\n").split("\n")[::NORTH_FIRST]
        width = max(map(len, rows))
        letters = np.array([list(row.ljust(width, "#")) for row in rows])
        self.resolution, parts = resolution, round(scale / resolution)
        self._letters = letters.repeat(parts, 0).repeat(parts, 1)
        self.wall = self._letters == "#"
        self.glass = self._letters == "="
        self.starts = {
            letters[cell]: Place((cell[1] + 0.5) * scale, (cell[0] + 0.5) * scale)
            for cell in zip(*np.char.isdigit(letters).nonzero(), strict=True)
        }
        self.size = width * scale, len(rows) * scale

    def close(self, door):
        self.wall |= self._letters == door

    def open(self, door):
        self.wall &= self._letters != door

    def add_box(self, x, y, side):
        """An obstacle; the cells that it covers, for ``wall``."""
        low, high = (np.array((y, x)) - side / 2, np.array((y, x)) + side / 2)
        box = tuple(
            slice(round(a / self.resolution), round(b / self.resolution))
            for a, b in zip(low, high, strict=True)
        )
        self.wall[box] = True
        return box

    def is_wall(self, x, y, glass=False):
        """Whether points are in walls, or outside; or in glass."""
        row = np.floor(np.asarray(y) / self.resolution).astype(int)
        column = np.floor(np.asarray(x) / self.resolution).astype(int)
        height, width = self.wall.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        solid = self.wall | self.glass if glass else self.wall
        return ~inside | solid[row.clip(0, height - 1), column.clip(0, width - 1)]


class Rover:
    """One robot: what its SLAM knows, and how it drives to ``goal`` as Nav2 would.

    Args:
        world: the truth.
        start: where it is in the world.
        frame: where its map's frame is in the world.
        resolution: of its map (metres).
        reach: of its lidar (metres).
        speed: metres per second.
    """

    RAYS = 300

    def __init__(self, world, start, frame=None, resolution=0.05, reach=3.5, speed=0.4):
        self.world, self.at = world, start
        self.frame, self.resolution = frame or Place(0.0, 0.0), resolution
        self.reach, self.speed = reach, speed
        corners = [
            self.frame.within((x, y)) for x in (0, world.size[0]) for y in (0, world.size[1])
        ]
        low, high = np.min(corners, 0) - 1.013, np.max(corners, 0) + 1.007  # odd origins
        self.low = low
        shape = np.ceil((high - low) / resolution).astype(int)
        self.score = np.zeros((shape[1], shape[0]), np.int16)
        self.goal, self.goals, self.way = None, [], []
        self.driven = 0.0
        self._planned = -math.inf

    @property
    def place(self):
        """Where it is in its map's frame."""
        x, y = self.frame.within((self.at.x, self.at.y))
        return Place(x, y, self.at.yaw - self.frame.yaw)

    def scan(self, bodies=()):
        """Turn the lidar once; other robots are discs."""
        angles = np.linspace(0, 2 * math.pi, self.RAYS, endpoint=False)
        steps = np.arange(0.0, self.reach, self.resolution / 2)
        x = self.at.x + np.cos(angles)[:, None] * steps
        y = self.at.y + np.sin(angles)[:, None] * steps
        hit = self.world.is_wall(x, y)
        for body in bodies:
            hit |= np.hypot(x - body.x, y - body.y) < RADIUS
        first = np.where(hit.any(1), hit.argmax(1), len(steps))
        row, column = self._cells(x, y)
        passed = np.zeros(self.score.shape, bool)
        before = np.arange(len(steps)) < first[:, None]
        passed[row[before], column[before]] = True
        ends = np.flatnonzero(first < len(steps))
        returned = np.zeros(self.score.shape, bool)
        returned[row[ends, first[ends]], column[ends, first[ends]]] = True
        self.score += np.where(returned, 3, np.where(passed, -1, 0)).astype(np.int16)
        np.clip(self.score, -4, 6, out=self.score)
        self.score[(passed | returned) & (self.score == 0)] = -1  # what is known stays known

    def map(self):
        """What SLAM publishes: the known rectangle and a margin."""
        rows, columns = (self.score != 0).nonzero()
        top, left = max(rows.min() - 3, 0), max(columns.min() - 3, 0)
        part = self.score[top : rows.max() + 4, left : columns.max() + 4]
        percent = np.where(part > 0, 100, np.where(part < 0, 0, -1)).astype(np.int8)
        corner = self.low + np.array((left, top)) * self.resolution
        return OccupancyMap(percent, self.resolution, Place(*corner.tolist()))

    def send(self, goal):
        self.goals.append(goal)
        self.goal, self._planned = goal, -math.inf

    def drive(self, seconds, now, bodies=()):
        """Follow a way over its own map to the goal; stand still where there is none."""
        if self.goal is None:
            return
        if now - self._planned >= 3:
            self.way, self._planned = plan(self.map(), self.place, self.goal), now
        left = self.speed * seconds
        while self.way and left > 0:
            x, y = self.way[0]
            step = self.place.distance((x, y))
            share = min(1.0, left / step) if step else 1.0
            here = self.place
            inner = Place(here.x + share * (x - here.x), here.y + share * (y - here.y))
            new = self.frame.then(inner)._replace(yaw=self.at.yaw)
            if self._touches(new, bodies):
                self.way = []
                return
            self.driven += share * step
            left -= step
            self.at = new
            if share == 1:
                self.way.pop(0)

    def _touches(self, at, bodies):
        hits, before = (
            self.world.is_wall(place.x + _RING[0], place.y + _RING[1], glass=True).sum()
            for place in (at, self.at)
        )
        return hits > before or any(
            body.distance(at) < min(2 * RADIUS, body.distance(self.at)) for body in bodies
        )

    def _cells(self, x, y):
        cos, sin = math.cos(self.frame.yaw), math.sin(self.frame.yaw)
        x, y = x - self.frame.x, y - self.frame.y
        u, v = cos * x + sin * y, cos * y - sin * x
        column = np.floor((u - self.low[0]) / self.resolution).astype(int)
        row = np.floor((v - self.low[1]) / self.resolution).astype(int)
        return row.clip(0, len(self.score) - 1), column.clip(0, self.score.shape[1] - 1)

    def explored(self, truth):
        """Share of the world's points (in ``truth``, bool) that it knows to be free."""
        rows, columns = truth.nonzero()
        x, y = (columns + 0.5) * self.world.resolution, (rows + 0.5) * self.world.resolution
        return (self.score[self._cells(x, y)] < 0).mean()


def plan(grid, place, goal, radius=RADIUS + 0.03, tolerance=0.3):
    """Points of the shortest way; none if the goal is outside the map or cannot be reached."""
    percent, side = grid.percent, grid.resolution
    height, width = percent.shape
    near = distance_transform_edt(percent < 50) * side if (percent >= 50).any() else None
    free = np.ones(percent.shape, bool) if near is None else near >= radius
    cells = [
        (int((p[1] - grid.origin.y) // side), int((p[0] - grid.origin.x) // side))
        for p in (place, goal)
    ]
    if not all(0 <= row < height and 0 <= column < width for row, column in cells):
        return []
    rows, columns = np.indices(free.shape)
    off, away = (np.hypot(rows - row, columns - column) * side for row, column in cells)
    if off[free].min(initial=math.inf) > tolerance:
        return []
    begin = int(np.where(free, off, math.inf).argmin())
    number = np.arange(free.size).reshape(free.shape)
    starts, ends, lengths = [], [], []
    for up, across in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = np.s_[: height - up, max(-across, 0) : width - max(across, 0)]
        b = np.s_[up:, max(across, 0) : width + min(across, 0)]
        both = free[a] & free[b]
        starts.append(number[a][both])
        ends.append(number[b][both])
        lengths.append(np.full(int(both.sum()), math.hypot(up, across)))
    graph = coo_matrix(
        (np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))),
        shape=(free.size, free.size),
    ).tocsr()
    distance, before = dijkstra(graph, False, begin, return_predecessors=True)
    reachable = np.isfinite(distance.reshape(free.shape)) & (away <= tolerance)
    if not reachable.any():
        return []
    cell = int(np.where(reachable, away, math.inf).argmin())
    points = []
    while cell >= 0:
        row, column = divmod(cell, width)
        points.append((grid.origin.x + (column + 0.5) * side, grid.origin.y + (row + 0.5) * side))
        cell = int(before[cell])
    return points[::-1]


class Trial:
    """Explorers in a simulated world; times in seconds.

    Args:
        world: the truth.
        cores: ``ExplorerCore`` by name.
        rovers: by name.
        maps_every: time between two maps.
        wheels: name -> whether the robot drives now.
        poses_every: how far a robot goes between two poses (metres), as with slam_toolbox.
    """

    STEP = 0.5

    def __init__(
        self, world, cores, rovers, maps_every=1.0, wheels=lambda name: True, poses_every=0.0
    ):
        self.poses_every, self._posed = poses_every, {}
        self.world, self.cores, self.rovers = world, cores, rovers
        self.maps_every, self.wheels = maps_every, wheels
        self.now, self.dead, self.outputs = 0.0, set(), {}
        self.states = {name: [] for name in cores}
        self._next_map = 0.0

    def alive(self):
        return [name for name in self.cores if name not in self.dead]

    def step(self):
        self.now += self.STEP
        sends_maps = self.now >= self._next_map
        self._next_map += self.maps_every * sends_maps
        for name in self.alive():
            rover = self.rovers[name]
            bodies = [other.at for mate, other in self.rovers.items() if mate != name]
            if self.wheels(name):
                rover.drive(self.STEP, self.now, bodies)
            rover.scan(bodies)
            if rover.driven - self._posed.get(name, -math.inf) >= self.poses_every:
                self._posed[name] = rover.driven
                self.send(name, "take_place", rover.place)
            if sends_maps:
                self.send(name, "take_map", rover.map())
        for name in self.alive():
            output = self.outputs[name] = self.cores[name].advance(self.clock())
            if self.states[name][-1:] != [output.status.state]:
                self.states[name].append(output.status.state)
            if output.goal is not None:
                self.rovers[name].send(output.goal)
                self.send(name, "take_goal", output.goal)

    def clock(self):
        """What all explorers take for the time."""
        return self.now

    def send(self, name, method, what):
        """From a robot's SLAM or explorer to all explorers that should hear it."""
        if method != "take_goal":
            getattr(self.cores[name], method)(what)
        for mate in self.alive():
            if mate != name and name in self.cores[mate].team.mates:
                getattr(self.cores[mate], method)(what, name)

    def until(self, happened, most=600.0):
        """Run until something has happened; it has to within so many seconds."""
        end = self.now + most
        while not happened():
            self.step()
            said = {name: output.status for name, output in self.outputs.items()}
            assert self.now < end, (self.now, said)

    def state(self, name):
        return self.outputs[name].status.state if name in self.outputs else None

    def run(self, seconds):
        end = self.now + seconds
        while self.now < end:
            self.step()
