"""One robot without a transport: takes stamped events, returns velocities and messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import (
    COMMUNICATE,
    NUM_ACTIONS,
    NUM_DIRECTIONS,
    STAY,
    Normalization,
)
from marl_explore.robot.agreement import Way, agree, target
from marl_explore.robot.clock import Clock
from marl_explore.robot.driving import ZERO, Velocity
from marl_explore.robot.geometry import Frame, GridCell
from marl_explore.robot.knowledge import Knowledge
from marl_explore.robot.mailbox import KEPT_TICKS, Mailbox
from marl_explore.robot.mapper import sight
from marl_explore.robot.messages import Done, Envelope, Intent, Pose, Scan, Share
from marl_explore.robot.observation import Observation, complete, observe, sides_of
from marl_explore.robot.sensors import Sensors
from marl_explore.robot.settings import RobotSettings

Policy = Callable[[Observation], int]
CONTENTION_CELLS = 8.0
"""Largest squared distance of two robots whose moves can have the same target (cells)."""


class Output(NamedTuple):
    """A robot's commands and messages now."""

    velocity: Velocity
    messages: tuple[Envelope, ...]


class RobotCore:
    """A robot that explores, tick by tick: sense, decide, agree, then drive or exchange maps.

    Pass events to ``receive`` and call ``advance`` often; it has no threads and reads no clock.

    Args:
        robot: its number in the team.
        config: the arena, its robots and ranges.
        policy: ``Observation`` in, action out, such as ``ExportedPolicy``.
        clock: the team's shared clock.
        fpr: normalisation of the frontier table.
        settings: timeouts, drive and sensor model.

    Raises:
        ValueError: when the communication range is less than 2 sqrt(2) cells: robots that could
            collide would not hear each other.
    """

    def __init__(
        self,
        robot: int,
        config: ArenaConfig,
        policy: Policy,
        clock: Clock,
        fpr: Normalization | None = "relative",
        settings: RobotSettings | None = None,
    ) -> None:
        if not 0 <= robot < config.num_agents:
            raise ValueError(f"robot={robot!r} is not allowed: 0 to {config.num_agents - 1}")
        config.require_as_in_paper("the settings are for a robot")
        if config.reach_cells(robot, robot) ** 2 < CONTENTION_CELLS:
            raise ValueError(
                f"communication_range={config.communication_range!r} is not allowed: robots agree "
                f"on moves within 2 sqrt(2) cells, {8**0.5 * config.cell_size:.4g} m"
            )
        self.robot, self.config, self.policy, self.clock = robot, config, policy, clock
        self.fpr = fpr
        self.settings = settings or RobotSettings()
        self.frame = Frame.of(config)
        self.knowledge = Knowledge(robot, config.num_agents, self.frame)
        self.sensors = Sensors(robot, self.settings.max_pose_age, self.settings.max_scan_age)
        self.mail = Mailbox(robot)
        self.tick = -1
        self.observation: Observation | None = None
        """The observation of the last tick with sensing."""
        self.action = STAY
        """The action of the last tick with a decision."""
        self._phase: Callable[[float], bool] = self._begin
        self._since = 0.0
        self._used: Scan | None = None
        self._reach: set[int] = set()
        self._silent: set[int] = set()
        self._partners: dict[int, set[int]] = {}
        self._ways: dict[int, Way] = {}
        self._intents: dict[int, Intent] = {}
        self._legs: list[GridCell] = []
        self._passed: list[GridCell] = []

    @property
    def is_sensing(self) -> bool:
        """Whether the robot waits for a scan."""
        return self._phase == self._sense

    @property
    def is_complete(self) -> bool:
        """Whether its map has no reachable frontier."""
        return self.observation is not None and complete(self.observation)

    def receive(self, event: Scan | Pose | Envelope, now: float) -> None:
        """Take a measurement or another robot's message, in any order, also late.

        Raises:
            ValueError: for a message that cannot come from this team, a stamp in the future or
                numbers that are not finite; the event is dropped.
        """
        if isinstance(event, Scan):
            self.sensors.add_scan(event, now)
        elif isinstance(event, Pose):
            self.sensors.add_pose(event, now)
        else:
            shape = self.config.height, self.config.width
            event.check(self.config.num_agents, shape, self.tick)
            self._silent.discard(event.sender)
            if isinstance(event.message, Done):
                self.clock.report(event.message.robot, event.message.tick, now)
            else:
                self.mail.receive(event)

    def advance(self, now: float) -> Output:
        """Advance as far as the received events allow.

        Args:
            now: the time (seconds), from the same clock as the stamps.
        """
        self._since = min(self._since, now)  # clocks can be set back
        while self._phase(now):
            pass
        for tick, partners in self._partners.items():
            self.mail.pass_on(tick, partners)
        return Output(self._velocity(now), self.mail.collect())

    # ------------------------------------------------------------ the phases of a tick; each
    # returns whether to try the next one immediately

    def _begin(self, now: float) -> bool:
        tick = self.clock.tick(now)
        if tick <= self.tick:
            return False
        self.tick, self._since, self._phase = tick, now, self._sense
        self.mail.forget(tick)
        self._partners = {t: p for t, p in self._partners.items() if t > tick - KEPT_TICKS}
        return True

    def _sense(self, now: float) -> bool:
        if self._begin(now):  # the others are ahead
            return True
        scan = self.sensors.scan
        if scan is None or scan.stamp < self._since or scan is self._used:
            return False
        poses = self.sensors.at(scan.stamp)
        if self.robot not in poses:
            return False
        own = poses.pop(self.robot)
        cells = {other: self.frame.cell(pose.x, pose.y) for other, pose in poses.items()}
        cells[self.robot] = cell = self.frame.cell(own.x, own.y)
        if not self.frame.inside(cell):
            return False
        self._used = scan
        radius, beams = self.config.fov_radius, self.settings.beams
        seen = sight(scan, own, poses.values(), self.frame, radius, beams)
        self.knowledge.sense(cell, seen)
        self._merge()
        refused = self._was_refused(cell)
        self.observation = observe(self.knowledge, cells, self.config, self.fpr, self.tick, refused)
        self._decide(self.observation, now)
        return True

    def _was_refused(self, cell: GridCell) -> bool:
        """Whether the last decision was a move that did not lead to its target."""
        if self.observation is None or self.action >= STAY:
            return False
        start = self.observation.position
        return cell != target(Intent(self.robot, self.tick, start, self.action))

    def _merge(self) -> None:
        for tick, partners in self._partners.items():
            self.knowledge.merge(self.mail.take_shared(tick, partners))

    def _decide(self, observation: Observation, now: float) -> None:
        if self.settings.stop_when_complete and complete(observation):
            mask = observation.action_mask.copy()
            mask[:NUM_DIRECTIONS] = False
            observation = observation._replace(action_mask=mask)
        self.action = int(self.policy(observation))
        if not 0 <= self.action < NUM_ACTIONS:
            raise ValueError(f"the policy's action {self.action!r} is not one of 0 to 9")
        sides = sides_of(observation, self.config, self.action)
        allowed = self.action if observation.action_mask[self.action] else STAY
        intent = Intent(self.robot, self.tick, observation.position, allowed, *sides)
        self._reach = {int(j) for j in observation.net.nonzero()[0]} - {self.robot}
        self._intents = {self.robot: intent}
        self.mail.send(intent, self._reach)
        self._since, self._phase = now, self._agree

    def _agree(self, now: float) -> bool:
        heard = self.mail.intents(self.tick, self._reach)
        missing = self._reach - heard.keys()
        if missing - self._silent and self._is_patient(now):
            return False
        if self._begin(now):  # these intents are outdated
            if not self.clock.announces:  # otherwise this robot may have been the absent one
                self._silent = missing
            return True
        self._silent = missing
        own = self._intents[self.robot]
        still = {
            robot: Intent(robot, self.tick, cell, STAY)
            for robot, cell in self.sensors.last_cells(self.frame).items()
        }
        self._intents = {**still, **heard, self.robot: own}
        self._ways = agree(self._intents)
        self._legs, self._passed = list(self._ways[self.robot].cells), [own.cell]
        self._since, self._phase = now, self._wait_turn
        if own.action == COMMUNICATE:
            talking = {robot for robot, other in heard.items() if other.action == COMMUNICATE}
            self._partners[self.tick] = talking
            self.mail.send(Share(self.robot, self.tick, self.knowledge.map), talking)
            self._phase = self._exchange
        return True

    def _is_patient(self, now: float) -> bool:
        """Whether to keep waiting for messages of this tick."""
        waited = now - self._since
        return waited <= self.settings.message_patience and self.clock.tick(now) <= self.tick

    def _exchange(self, now: float) -> bool:
        partners = self._partners[self.tick]
        missing = partners - self.mail.shared(self.tick, partners).keys()
        if missing and self._is_patient(now):
            return False
        self.mail.pass_on(self.tick, partners)
        return self._finish(now)

    def _wait_turn(self, now: float) -> bool:
        if all(self._has_arrived(other) for other in self._ways[self.robot].after):
            self._since, self._phase = now, self._drive
            return True
        if now - self._since > self.settings.lock_expiry or self._is_overdue(now):
            return self._finish(now)
        return False

    def _has_arrived(self, other: int) -> bool:
        """Whether a robot is so near the middle of its target that its other cells are free."""
        x, y = self.frame.centre(self._ways[other].cells[-1])
        poses = {pose.robot: pose for pose in self.sensors.others()}
        pose = poses[other]
        return max(abs(pose.x - x), abs(pose.y - y)) < self.frame.cell_size / 4

    def _drive(self, now: float) -> bool:
        pose = self.sensors.pose
        while self._legs and pose and self._arrived(pose):
            self._passed.append(self._legs.pop(0))
        if not self._legs:
            return self._finish(now)
        expired = now - self._since > self.settings.move_expiry
        if expired and self._legs[-1] != self._passed[0]:  # back the way it came
            self._legs = self._passed[::-1]
        self._is_overdue(now)
        return False

    def _arrived(self, pose: Pose) -> bool:
        return self.settings.drive.arrived(pose, self.frame.centre(self._legs[0]))

    def _is_overdue(self, now: float) -> bool:
        """Whether the next tick has begun; if so, tell the others where this move ends."""
        tick = self.clock.tick(now)
        if tick <= self.tick:
            return False
        self.tick = tick
        goal = self._legs[-1] if self._legs else self._intents[self.robot].cell
        self.mail.send(Intent(self.robot, tick, goal, STAY), self._reach)
        return True

    def _finish(self, now: float) -> bool:
        self._phase = self._begin
        if self.clock.announces:
            self.clock.report(self.robot, self.tick, now)
            self.mail.send(Done(self.robot, self.tick), range(self.config.num_agents))
        return True

    def _velocity(self, now: float) -> Velocity:
        pose = self.sensors.pose
        if self._phase != self._drive or pose is None or not self.sensors.fresh(now):
            return ZERO
        goal = self.frame.centre(self._legs[0])
        return self.settings.drive.velocity(pose, goal, self.sensors.others())
