"""One robot without a transport: takes stamped events, returns velocities and messages."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import is_integer, require, require_time
from marl_explore.config.constants import (
    COMMUNICATE,
    NUM_ACTIONS,
    NUM_DIRECTIONS,
    STAY,
    Normalization,
)
from marl_explore.robot.agreement import Way, agree, target
from marl_explore.robot.clock import BarrierClock, Clock
from marl_explore.robot.driving import ZERO, Velocity
from marl_explore.robot.geometry import Disc, Frame, GridCell
from marl_explore.robot.goal_actor import give_way
from marl_explore.robot.goals import uses_kernels
from marl_explore.robot.guard import Guard
from marl_explore.robot.jumps import JumpGuard
from marl_explore.robot.knowledge import Knowledge
from marl_explore.robot.mailbox import KEPT_TICKS, Mailbox
from marl_explore.robot.mapper import sight
from marl_explore.robot.messages import (
    Done,
    Envelope,
    Intent,
    Pose,
    Scan,
    Share,
    require_robot,
)
from marl_explore.robot.observation import Observation, complete, in_reach, observe, sides_of
from marl_explore.robot.sensors import Sensors
from marl_explore.robot.settings import RobotSettings
from marl_explore.robot.status import Reason, Status, named, of_refusal, status_of
from marl_explore.robot.ways import step_aside
from marl_explore.robot.wheels import Wheels

Policy = Callable[[Observation], int]


@runtime_checkable
class Bound(Protocol):
    """A policy that is for one robot of one kind of team."""

    robot: int
    """Whose policy it is."""

    def check(self, robots: int, fov_size: int) -> None:
        """Raise a ``ValueError`` for another size of the team or of the field of view (cells)."""


_EVENTS = "it must be a Scan, a Pose or an Envelope"
CONTENTION_CELLS = 8.0
"""Largest squared distance of two robots whose moves can have the same target (cells)."""
_APART_CELLS = 2
"""Largest distance of an intent's cell from the pose of its robot: moves may end in the next cell,
and poses and messages are a little late."""


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
        fpr: normalisation of the frontier table; "policy": as the policy's ``fpr`` has it, or
            "relative" for one that has none.
        settings: timeouts, drive and sensor model.

    Raises:
        ValueError: when the communication range is less than 2 sqrt(2) cells: robots that could
            collide would not hear each other; and for the policy of another robot, or for another
            team or field of view.
    """

    def __init__(
        self,
        robot: int,
        config: ArenaConfig,
        policy: Policy,
        clock: Clock,
        fpr: Normalization | Literal["policy"] | None = "policy",
        settings: RobotSettings | None = None,
    ) -> None:
        fits = is_integer(robot) and 0 <= robot < config.num_agents
        require(fits, "robot", robot, f"0 to {config.num_agents - 1}")
        if isinstance(policy, Bound):
            policy.check(config.num_agents, config.fov_size)
            if policy.robot != robot:
                raise ValueError(
                    f"robot={robot!r} is not allowed: the policy is that of robot {policy.robot}"
                )
        if isinstance(clock, BarrierClock):
            clock.check(config.num_agents)
        config.require_as_in_paper("the settings are for a robot")
        if config.reach_cells(robot, robot) ** 2 < CONTENTION_CELLS:
            raise ValueError(
                f"communication_range={config.communication_range!r} is not allowed: robots agree "
                f"on moves within 2 sqrt(2) cells, {8**0.5 * config.cell_size:.4g} m"
            )
        self.robot, self.config, self.policy, self.clock = robot, config, policy, clock
        self.fpr: Normalization | None = (
            getattr(policy, "fpr", "relative") if fpr == "policy" else fpr
        )
        self.settings = settings or RobotSettings()
        self.frame = Frame.of(config)
        evidence, limits = self.settings.evidence, self.settings.merging
        self.knowledge = Knowledge(robot, config.num_agents, self.frame, evidence, limits)
        self.jumps = JumpGuard(self.settings.jumps, self.settings.drive)
        self.sensors = Sensors(robot, self.settings.max_pose_age, self.settings.max_scan_age)
        self.mail = Mailbox(robot)
        self.guard = Guard(self.settings.drive, self.settings.beams)
        self.wheels = Wheels(self.settings.move_patience)
        self.tick = -1
        self.observation: Observation | None = None
        """The observation of the last tick with sensing."""
        self.action = STAY
        """The action of the last tick with a decision."""
        self.is_complete = False
        """Whether its map had no reachable frontier in that tick; shut cells count as free."""
        self.refusal: str | None = None
        """Why its last decision was a move that it does not make, for people."""
        self.status = Status(Reason.NO_POSE, "no pose has arrived yet")
        """What the robot did at the last call of ``advance``, or why it stood still."""
        self._phase: Callable[[float], bool] = self._begin
        self._since = 0.0
        self._used: Scan | None = None
        self._reach: set[int] = set()
        self._silent: set[int] = set()
        self._partners: dict[int, set[int]] = {}
        self._told: dict[int, int] = {}
        """At which tick it last sent its map to each robot."""
        self._owed: set[int] = set()
        """Robots whose map came although this robot had not sent its own for long."""
        self._ways: dict[int, Way] = {}
        self._intents: dict[int, Intent] = {}
        self._legs: list[GridCell] = []
        self._passed: list[GridCell] = []
        self._driven: set[GridCell] = set()
        """Cells that it has driven through since it sensed last."""
        self._shut: dict[GridCell, float] = {}
        self._chance = np.random.default_rng(robot)
        self.refused_data: tuple[float, Status] | None = None
        """When its own scan or pose was last refused (seconds), and why."""

    @property
    def is_sensing(self) -> bool:
        """Whether the robot waits for a scan."""
        return self._phase == self._sense

    @property
    def is_between_ticks(self) -> bool:
        """Whether the robot waits for the next tick."""
        return self._phase == self._begin

    def receive(self, event: Scan | Pose | Envelope, now: float) -> None:
        """Take a measurement or another robot's message, in any order, also late.

        Raises:
            ValueError: for a message that cannot come from this team, a stamp in the future or
                numbers that are none; the event is dropped.
        """
        require_time("now", now)
        require(isinstance(event, Scan | Pose | Envelope), "event", event, _EVENTS)
        if isinstance(event, Scan):
            self._take(event, now)
        elif isinstance(event, Pose):
            require_robot(event.robot, self.config.num_agents, "a pose")
            self._take(event, now)
            if self.sensors.pose and event.robot == self.robot:
                self.jumps.add(self.sensors.pose)
        else:
            shape = self.config.height, self.config.width
            event.check(self.robot, self.config.num_agents, shape, self.tick)
            if isinstance(event.message, Intent):
                self._check_place(event.message, now)
            self._silent.discard(event.sender)
            if isinstance(event.message, Done):
                self.clock.report(event.message.robot, event.message.tick, now)
            else:
                self._note_debt(event)
                self.mail.receive(event)

    def _note_debt(self, letter: Envelope) -> None:
        """Remember who has sent its map and does not have this robot's: its own may be late."""
        share, told = letter.message, self._told.get(letter.sender)
        is_own = isinstance(share, Share) and share.robot == letter.sender
        if is_own and (told is None or told < share.tick - KEPT_TICKS):
            self._owed.add(letter.sender)

    def _take(self, event: Scan | Pose, now: float) -> None:
        try:
            if isinstance(event, Scan):
                self.sensors.add_scan(event, now)
            else:
                self.sensors.add_pose(event, now)
        except ValueError as error:
            if isinstance(event, Scan):
                self.refused_data = now, of_refusal("scan", error)
            elif event.robot == self.robot:
                self.refused_data = now, of_refusal("pose", error)
            raise

    def _check_place(self, intent: Intent, now: float) -> None:
        """Refuse an intent from a place far from where its robot is known to be."""
        pose = self.sensors.last(intent.robot)
        if pose is None or abs(now - pose.stamp) > self.settings.max_pose_age:
            return
        row, column = self.frame.cell(pose.x, pose.y)
        apart = max(abs(intent.cell[0] - row), abs(intent.cell[1] - column))
        if intent.tick >= self.tick and apart > _APART_CELLS:
            raise ValueError(
                f"cell={intent.cell} of robot {intent.robot} is not allowed: its pose is in cell "
                f"{(row, column)}"
            )

    def advance(self, now: float) -> Output:
        """Advance as far as the received events allow.

        Args:
            now: the time (seconds), from the same clock as the stamps.

        Raises:
            ValueError: for a time that is none, or a policy's answer that is no action.
        """
        require_time("now", now)
        self._since = min(self._since, now)  # clocks can be set back
        while self._phase(now):
            pass
        for tick, partners in self._partners.items():
            self.mail.pass_on(tick, partners)
        velocity = self._velocity(now)
        self.status = status_of(self, now)
        return Output(velocity, self.mail.collect())

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
        self._look(scan, own, poses.values())
        self._merge()
        refused = self._was_refused(cell)
        self._open(now)
        self._reach = in_reach(self.robot, cells, self.config)
        about = self.tick, refused, self._shut, self._silent
        self.observation = observe(self.knowledge, cells, self.config, self.fpr, *about)
        self.is_complete = complete(self.knowledge.map, cell)
        if self.is_complete or not self._shut:
            self.wheels.forget()
        self._decide(self.observation, now)
        return True

    def _open(self, now: float) -> None:
        """Count cells as free again that have been shut for long enough."""
        longest = now + self.settings.shut_seconds  # clocks can be set back
        self._shut = {place: min(t, longest) for place, t in self._shut.items() if t > now}

    def _look(self, scan: Scan, own: Pose, others: Iterable[Pose]) -> None:
        """Write what the robot sees into its map, unless its pose has jumped to a wrong place."""
        settings = self.settings
        reach = settings.drive.max_forward, settings.mate_patience, settings.mate_reach
        astray = self.sensors.astray(scan.stamp, *reach)
        radius = self.config.fov_radius
        seen = sight(scan, own, others, self.frame, radius, settings.beams, astray)
        cell = self.frame.cell(own.x, own.y)
        if self.jumps.admits(own, self.knowledge.fit(cell, seen), self.tick):
            self.knowledge.sense(cell, seen, self.tick, self._driven)
        else:
            self.knowledge.pass_time()  # and it may not have been where it seemed to drive
        self._driven.clear()

    def _was_refused(self, cell: GridCell) -> bool:
        """Whether the last decision was a move that did not lead to its target."""
        if self.observation is None or self.action >= STAY:
            return False
        start = self.observation.position
        return cell != target(Intent(self.robot, self.tick, start, self.action))

    def _merge(self) -> None:
        self.knowledge.merge(self.mail.take_new(), self.tick)

    def _decide(self, observation: Observation, now: float) -> None:
        self.action, allowed = self._choose(observation, now)
        sides = sides_of(observation, self.config, allowed)
        intent = Intent(self.robot, self.tick, observation.position, allowed, *sides)
        self._intents = {self.robot: intent}
        self.mail.send(intent, self._reach)
        self._since, self._phase = now, self._agree

    def _choose(self, observation: Observation, now: float) -> tuple[int, int]:
        """The policy's action, and the one that is made: STAY where it is not allowed."""
        parked = self.settings.stop_when_complete and self.is_complete
        mask = observation.action_mask.copy()
        if parked:
            mask[:NUM_DIRECTIONS] = False
        action = _action(self.policy(observation._replace(action_mask=mask)))
        if parked and action != COMMUNICATE:
            mask, held = observation.action_mask, self._held_cells(now)
            aside = step_aside(observation.map, observation.position, held)
            action = give_way(aside, mask, observation.refused, self._chance)
        return action, action if mask[action] else STAY

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
            pose.robot: Intent(pose.robot, self.tick, self.frame.cell(pose.x, pose.y), STAY)
            for pose in self._heard(now)
        }
        self._intents = {**still, **heard, self.robot: own}
        self._ways = agree(self._intents)
        self._legs, self._passed = list(self._ways[self.robot].cells), [own.cell]
        self.refusal = None if self._legs or self.action >= STAY else self._why_refused()
        self._since, self._phase = now, self._wait_turn
        receivers = self._owed & self._reach
        if own.action == COMMUNICATE:
            talking = {robot for robot, other in heard.items() if other.action == COMMUNICATE}
            self._partners[self.tick] = talking
            receivers |= talking | missing  # who was not heard in time may only be late
            self._phase = self._exchange
        self._owed.clear()
        self._told |= dict.fromkeys(receivers, self.tick)
        self.mail.send(Share(self.robot, self.tick, self.knowledge.evidence), receivers)
        return True

    def _why_refused(self) -> str:
        start = self._intents[self.robot].cell
        goal = target(Intent(self.robot, self.tick, start, self.action))
        rivals = {
            robot
            for robot, other in self._intents.items()
            if robot != self.robot and goal in (other.cell, target(other))
        }
        whose = f" because of {named(rivals)}" if rivals else ""
        return f"its move to cell {goal} was refused{whose}"

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
            self.wheels.start()
            return True
        if now - self._since > self.settings.lock_expiry or self._is_overdue(now):
            return self._finish(now)
        return False

    def _has_arrived(self, other: int) -> bool:
        """Whether a robot is so near the middle of its target that its other cells are free."""
        x, y = self.frame.centre(self._ways[other].cells[-1])
        pose = self.sensors.last(other)
        return pose is not None and max(abs(pose.x - x), abs(pose.y - y)) < self.frame.cell_size / 4

    def _drive(self, now: float) -> bool:
        pose = self.sensors.pose
        if pose and self.frame.inside(cell := self.frame.cell(pose.x, pose.y)):
            self._driven.add(cell)
        while self._legs and pose and self._arrived(pose):
            self._passed.append(self._legs.pop(0))
        if not self._legs:
            return self._finish(now)
        gives_up = pose is not None and self.wheels.give_up(pose, self._legs[0])
        if gives_up:
            self._shut[self._legs[0]] = now + self.settings.shut_seconds
        is_late = now - self._since > self.settings.move_expiry
        if (gives_up or is_late) and not self._return(now):
            return self._finish(now)
        self._is_overdue(now)
        return False

    def _return(self, now: float) -> bool:
        """Drive back the way it came, unless it is already doing so."""
        if self._legs[-1] == self._passed[0]:
            return False
        self._legs, self._since = self._passed[::-1], now
        self.wheels.start(is_return=True)
        return True

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
            self.wheels.rest()
            return ZERO
        self._watch_out()
        goal, others = self.frame.centre(self._legs[0]), self._heard(now)
        blocked = self.guard.is_blocked(pose, goal)
        velocity = self.settings.drive.velocity(pose, goal, others, blocked)
        self.wheels.command(velocity, blocked, self.settings.drive.ahead(pose, others))
        return velocity

    def _watch_out(self) -> None:
        """Look for obstacles in the latest scan."""
        scan = self.sensors.scan
        if scan is None or scan is self.guard.scan:
            return
        poses = self.sensors.at(scan.stamp)
        if self.robot in poses:
            own = poses.pop(self.robot)
            robots = [Disc(other.x, other.y, 0.0) for other in poses.values()]
            self.guard.look(scan, own, robots)

    def _heard(self, now: float) -> list[Pose]:
        """The latest poses of other robots, but of none that has been silent for too long."""
        settings = self.settings
        return self.sensors.heard(now, max(settings.mate_patience, settings.max_pose_age))

    def _held_cells(self, now: float) -> set[GridCell]:
        """Cells of other robots inside the arena."""
        cells = {self.frame.cell(pose.x, pose.y) for pose in self._heard(now)}
        return {cell for cell in cells if self.frame.inside(cell)}

    # ------------------------------------------------------------ what it tells people

    @property
    def counts(self) -> dict[str, int]:
        """What has gone wrong so far, and how its goals are found, for people."""
        return {
            "tick": self.tick,
            "known cells": self.knowledge.known,
            "merges refused": self.knowledge.refused.total(),
            "moves given up for obstacles": self.wheels.obstacles,
            "moves given up for wheels": self.wheels.stalls,
            "jumps of the pose": self.jumps.jumps,
            "numpy instead of the kernel": int(not uses_kernels()),
        }

    @property
    def obstructed(self) -> GridCell | None:
        """The cell on the way to which something stands now."""
        return self._legs[0] if self._legs and self.wheels.blocked else None

    @property
    def waited_for(self) -> set[int]:
        """Robots that it waits for now."""
        if self._phase == self._begin:
            return self.clock.waited_for - {self.robot}
        if self._phase == self._agree:
            return self._reach - self.mail.intents(self.tick, self._reach).keys() - self._silent
        if self._phase == self._exchange:
            partners = self._partners[self.tick]
            return partners - self.mail.shared(self.tick, partners).keys()
        if self._phase == self._wait_turn:
            return {robot for robot in self._ways[self.robot].after if not self._has_arrived(robot)}
        return set()


def _action(answer: object) -> int:
    """A policy's answer as the action that it is."""
    try:
        action = operator.index(answer)  # type: ignore[arg-type]
    except TypeError:
        action = -1
    if isinstance(answer, bool) or not 0 <= action < NUM_ACTIONS:
        raise ValueError(f"the policy's action {answer!r} is not one of 0 to 9")
    return action
