"""A world for robots in which things go wrong: messages, clocks and robots themselves."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace
from itertools import count
from typing import NamedTuple

import numpy as np

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.robot import BarrierClock, Envelope, Scan
from marl_explore.robot.planners import PLANNERS
from tests.helpers.robot_world import RADIUS, RANGE, RAYS, World, to_disc


@dataclass(frozen=True)
class Faults:
    """What goes wrong; times in seconds."""

    drop: float = 0.0
    """Share of messages that never arrive."""
    duplicate: float = 0.0
    """Share of messages that arrive twice."""
    delay: float = 0.0
    """Longest delay of a message."""
    least_delay: float = 0.0
    """Shortest delay of a message."""
    corrupt: float = 0.0
    """Share of messages of which a byte changes on the way."""
    dies_at: float | None = None
    """When the last robot dies."""
    joins_at: float = 0.0
    """When robot 0 is switched on."""
    clock_jump: float = 0.0
    """By how much the clock of all robots and sensors jumps, after a minute."""
    own_jump: float = 0.0
    """By how much the clock of robot 1 jumps, for half a minute from the second minute on."""
    isolated: float = 0.0
    """How long robot 1 hears nobody and is heard by nobody, from the second half minute on."""


class FaultyWorld(World):
    """A ``World`` with faults; messages travel as bytes.

    Args:
        faults: what goes wrong.
        chance: a generator of random numbers.
        arguments: as for ``World``.
    """

    def __init__(self, faults, chance, *arguments, **options):
        super().__init__(*arguments, **options)
        self.obstacles = self.obstacles.copy()
        self.faults, self.chance = faults, chance
        self._mail, self._order, self.time = [], count(), 0.0
        self.refused, self._ticks = 0, 0
        self._half = self.frame.cell_size / 2
        self.put()
        self.gap = math.inf
        self._switch()

    def put(self, *cells, code=True):
        """Put boxes into cells, or take them away."""
        for cell in cells:
            self.obstacles[cell] = code
        boxes = np.argwhere(self.obstacles).tolist()
        self._boxes = np.array([self.frame.centre(box) for box in boxes]).reshape(-1, 2)

    def step(self):
        """One step, with what is due by then."""
        before, self.time = self.time, self.time + self.STEP
        if before < 60.0 <= self.time:
            self.now += self.faults.clock_jump
            self.poses = [replace(pose, stamp=self.now) for pose in self.poses]
        self._switch()
        self._ticks += 1
        while self._mail and self._mail[0][0] <= self.time:
            self._hand_over(*heapq.heappop(self._mail)[2:])
        super().step()
        self._touch()

    def _switch(self):
        """Robots that are off now."""
        last = len(self.cores) - 1
        self.dead.discard(0)
        if self.time < self.faults.joins_at:
            self.dead.add(0)
        if self.faults.dies_at is not None and self.time >= self.faults.dies_at:
            self.dead.add(last)

    def _clock(self, robot):
        jumped = robot == 1 and 120.0 <= self.time < 150.0
        return self.now + self.faults.own_jump * jumped

    def _is_isolated(self, *robots):
        return 1 in robots and 30.0 <= self.time < 30.0 + self.faults.isolated

    def give(self, core, event):
        """Hand an event to a robot, which may refuse it."""
        try:
            core.receive(event, self._clock(core.robot))
        except ValueError:
            self.refused += 1

    def give_poses(self, core):
        """The poses of all robots that it can hear of."""
        for pose in self.poses:
            known = pose.robot == core.robot or not self._is_isolated(core.robot, pose.robot)
            if known:
                self.give(core, pose)

    def _until_quiet(self):
        if self._ticks % 3 == 0:  # lidars turn three times a second
            for core in self.alive():
                if not core.is_sensing:
                    self.give(core, self._scan(core.robot))
        return super()._until_quiet()

    def _scan(self, robot):
        pose = self.poses[robot]
        angles = pose.yaw + 2 * math.pi / RAYS * np.arange(RAYS)
        heading = np.stack((np.cos(angles), np.sin(angles)), -1)
        slope = np.where(np.abs(heading) < 1e-9, 1e-9, heading)[None]
        apart = (self._boxes - (pose.x, pose.y))[:, None]
        low, high = (apart - self._half) / slope, (apart + self._half) / slope
        enters, leaves = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
        hits = np.where((leaves > enters) & (enters > 0), enters, math.inf)
        ranges = hits.min(0, initial=math.inf)
        for other in self.poses:
            if other.robot != robot:
                east, north = other.x - pose.x, other.y - pose.y
                ranges = np.minimum(ranges, to_disc(angles, east, north, RADIUS))
        ranges[ranges >= RANGE] = math.inf
        return Scan(self.now, ranges)

    def advance(self, core):
        """A robot's output now."""
        return core.advance(self._clock(core.robot))

    def _deliver(self, envelope):
        for receiver in envelope.to:
            copies = 1 + (self.chance.random() < self.faults.duplicate)
            for _ in range(copies):
                if self.chance.random() < self.faults.drop:
                    continue
                at = self.time + self.chance.uniform(self.faults.least_delay, self.faults.delay)
                data = self._carried(envelope.encode())
                if self.faults.delay:
                    item = (at, next(self._order), envelope.sender, receiver, data)
                    heapq.heappush(self._mail, item)
                else:
                    self._hand_over(envelope.sender, receiver, data)

    def _carried(self, data):
        if self.chance.random() >= self.faults.corrupt:
            return data
        damaged = bytearray(data)
        damaged[self.chance.integers(len(data))] ^= 1 << int(self.chance.integers(8))
        return bytes(damaged)

    def _hand_over(self, sender, receiver, data):
        if receiver in self.dead or self._is_isolated(sender, receiver):
            return
        try:
            envelope = Envelope.decode(data, receiver)
        except ValueError:
            self.refused += 1
            return
        self.give(self.cores[receiver], envelope)

    def _touch(self):
        """The smallest distance of a robot's body to a box or the border of its cell's boxes."""
        for pose in self.poses:
            apart = np.maximum(np.abs(self._boxes - (pose.x, pose.y)) - self._half, 0)
            self.gap = min(self.gap, float(np.hypot(*apart.T).min(initial=math.inf)) - RADIUS)

    def wrong_cells(self, robot):
        """Known cells of a robot's map that are not as the world has them.

        Those where a dead robot stands may be either.
        """
        known = self.cores[robot].knowledge.map.copy()
        truth = self.obstacles.astype(np.int8)
        for dead in self.dead:
            pose = self.poses[dead]
            known[self.frame.cell(pose.x, pose.y)] = -1
        return int(((known >= 0) & (known != truth)).sum())


ALL = Faults(
    drop=0.3, duplicate=0.3, delay=2.0, corrupt=0.2, dies_at=40.0, joins_at=50.0, own_jump=3.0
)
MIXES = {
    "none": Faults(),
    "drop 10 %": Faults(drop=0.1),
    "drop 30 %": Faults(drop=0.3),
    "drop 50 %": Faults(drop=0.5),
    "drop 70 %": Faults(drop=0.7),
    "drop 90 %": Faults(drop=0.9),
    "duplicates": Faults(duplicate=0.5),
    "delays up to 1 s": Faults(delay=1.0),
    "delays up to 5 s": Faults(delay=5.0),
    "delays of 3 s": Faults(delay=3.0, least_delay=3.0),
    "delays, duplicates and drops": Faults(delay=5.0, duplicate=0.3, drop=0.3),
    "corrupt bytes": Faults(corrupt=0.5),
    "a death": Faults(dies_at=30.0),
    "a death and drops": Faults(dies_at=30.0, drop=0.5),
    "a late joiner": Faults(joins_at=120.0),
    "a late joiner and delays": Faults(joins_at=120.0, delay=3.0),
    "clocks jump forward": Faults(clock_jump=3600.0),
    "clocks jump back": Faults(clock_jump=-30.0),
    "one clock jumps": Faults(own_jump=5.0),
    "isolation": Faults(isolated=1200.0),
    "all of it": ALL,
}
"""The mixes of the fault campaign (``python -m benchmarks.robot_faults``)."""


_SETTLING = 20.0
"""How long the world goes on after the end (seconds): a robot that was not heard for long is an
obstacle until it has exchanged maps with the others, or they look at its cell again."""


class Outcome(NamedTuple):
    """How a run ended."""

    finished: bool
    """Whether the map of every living robot is complete."""
    seconds: float
    """Of simulated time."""
    wrong_cells: int
    """In the maps of living robots."""
    closest: float
    """Smallest distance of two robots' bodies (metres)."""
    gap: float
    """Smallest distance of a robot's body and a box (metres)."""


def explore(faults, seed, planner="nearest-timer", side=7, robots=3, most_seconds=3600.0):
    """A team explores a random arena while things go wrong, until it is done or out of time."""
    config = ArenaConfig(side, side, num_agents=robots)
    start = ExplorationEnv(config, seed=seed).reset()
    policies = [PLANNERS[planner](robot, config, seed) for robot in range(robots)]
    world = FaultyWorld(
        faults,
        np.random.default_rng(seed),
        config,
        start["obstacles"][0].numpy(),
        start["agents", "position"][0].tolist(),
        policies,
        make_clock=lambda: BarrierClock(range(robots), patience=15.0),
        seed=seed,
    )
    last_fault = max(60.0, faults.joins_at, 30.0 + faults.isolated, faults.dies_at or 0.0)
    while world.time < last_fault or not all(core.is_complete for core in world.alive()):
        world.step()
        if world.time > most_seconds + last_fault:
            break
    living, ended = world.alive(), world.time
    finished = all(core.is_complete for core in living)
    while world.time < ended + _SETTLING:
        world.step()
    return Outcome(
        finished,
        ended,
        sum(world.wrong_cells(core.robot) for core in living),
        world.closest - 2 * RADIUS,
        world.gap,
    )
