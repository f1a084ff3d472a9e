"""Sensor data of a robot, and the messages between robots with their encoding."""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.checks import (
    is_integer,
    require,
    require_finite,
    require_not_negative,
)
from marl_explore.config.constants import NUM_ACTIONS
from marl_explore.config.fields import check_type
from marl_explore.robot.evidence import Evidence
from marl_explore.robot.geometry import MOST_YAW, GridCell, Mount
from marl_explore.robot.packing import pack, unpack

MOST_TICKS = 2**53
"""Largest tick of a message; no clock of a robot gets there."""
MOST_AHEAD = 2**42
"""How far a message may be ahead of its receiver (ticks): a robot that joins a wrong tick of
another one stays far below ``MOST_TICKS``, and its own messages are taken."""
_FARTHEST = 1e6
"""Largest coordinate of a pose: arenas are far smaller, and numbers stay exact (metres)."""


_MOST_ANGLE = 4 * math.pi
"""Largest angle of a scan's first beam, on either side of 0 (radians)."""


@dataclass(frozen=True)
class Pose:
    """Where a robot is, in the arena's frame."""

    stamp: float
    """Time of measurement (seconds)."""
    robot: int
    x: float
    """East (metres)."""
    y: float
    """North (metres)."""
    yaw: float
    """Heading, 0 to the east, counter-clockwise (radians)."""

    def check(self) -> None:
        """Raise an error for numbers that are none or not finite, and for places in no arena.

        Raises:
            ValueError: naming the field and its value.
        """
        require_finite("stamp", self.stamp, "seconds")
        for name in ("x", "y"):
            value = getattr(self, name)
            require_finite(name, value, "metres")
            allowed = f"a robot is at most {_FARTHEST:g} m from the arena's middle"
            require(abs(value) <= _FARTHEST, name, value, allowed)
        require_finite("yaw", self.yaw, "radians", MOST_YAW)

    def of_sensor(self, mount: Mount) -> Pose:
        """The pose of a sensor on the robot."""
        ahead, left = math.cos(self.yaw), math.sin(self.yaw)
        return replace(
            self,
            x=self.x + mount.x * ahead - mount.y * left,
            y=self.y + mount.x * left + mount.y * ahead,
            yaw=self.yaw + mount.yaw,
        )


@dataclass(frozen=True)
class Scan:
    """One turn of a robot's lidar, as ROS's LaserScan has it."""

    stamp: float
    """Time of measurement (seconds)."""
    ranges: NDArray[np.floating]
    """Distances [R] (metres); inf is no return, -inf is too near to measure, and NaN says nothing
    (REP 117)."""
    angle_min: float = 0.0
    """Angle of the first beam in the lidar's frame, 0 ahead (radians)."""
    angle_increment: float = 2 * np.pi / 360
    """Angle between beams, counter-clockwise (radians)."""
    range_min: float = 0.12
    """Shorter ranges are ignored (metres)."""
    range_max: float = 3.5
    """Longer ranges mean no return (metres)."""
    mount: Mount | None = None
    """Where the lidar is on the robot, if the scan says so; None: as the settings have it."""

    @property
    def is_on(self) -> bool:
        """Whether the lidar is on and not covered: some range is above ``range_min``."""
        return bool((np.asarray(self.ranges) > self.range_min).any())

    def check(self) -> None:
        """Raise an error for numbers that cannot be a lidar's, and for a lidar that is off.

        Raises:
            ValueError: naming the field and its value.
        """
        require_finite("stamp", self.stamp, "seconds")
        ranges = np.asarray(self.ranges)
        if ranges.ndim != 1 or ranges.dtype.kind not in "fiu":
            what = f"{ranges.dtype} of shape {ranges.shape}"
            raise ValueError(f"ranges={what} is not allowed: they must be real numbers [R]")
        require_finite("angle_min", self.angle_min, "radians", _MOST_ANGLE)
        require_finite("angle_increment", self.angle_increment, "radians", 2 * math.pi)
        allowed = "beams need an angle between them"
        require(self.angle_increment != 0, "angle_increment", self.angle_increment, allowed)
        require_not_negative("range_min", self.range_min, "metres")
        require_finite("range_max", self.range_max, "metres")
        allowed = f"it must be more than range_min={self.range_min!r}"
        require(self.range_max > self.range_min, "range_max", self.range_max, allowed)
        if self.mount is not None:
            require(isinstance(self.mount, Mount), "mount", self.mount, "it must be a Mount")
            try:
                self.mount.check()
            except ValueError as error:
                raise ValueError(f"mount={self.mount} is not allowed: {error}") from None
        if not self.is_on:
            raise ValueError(
                f"a scan in which no range is above range_min={self.range_min} is not allowed: "
                "the lidar is off or covered"
            )


@dataclass(frozen=True)
class Intent:
    """A robot's next action, sent before it acts."""

    robot: int
    tick: int
    cell: GridCell
    """Cell where it starts."""
    action: int
    upright: bool = False
    """Whether its diagonal can pass through the cell north or south of it."""
    sideways: bool = False
    """Whether its diagonal can pass through the cell east or west of it."""

    _FORMAT = struct.Struct("<BBQhhBB")

    def encode(self) -> bytes:
        """Sixteen bytes."""
        sides = self.upright | self.sideways << 1
        return self._FORMAT.pack(1, self.robot, self.tick, *self.cell, self.action, sides)

    def check(self, shape: tuple[int, int]) -> None:
        """Raise an error for an action that there is not, or a cell outside maps [H, W].

        Raises:
            ValueError: naming it.
        """
        fits = is_integer(self.action) and 0 <= self.action < NUM_ACTIONS
        require(fits, "action", self.action, f"0 to {NUM_ACTIONS - 1}")
        pair = isinstance(self.cell, tuple) and len(self.cell) == 2
        require(pair and all(map(is_integer, self.cell)), "cell", self.cell, "(row, column)")
        inside = all(0 <= place < size for place, size in zip(self.cell, shape, strict=True))
        require(inside, "cell", self.cell, f"the arena has {shape} cells")
        for name in ("upright", "sideways"):
            check_type(name, getattr(self, name), bool)

    @classmethod
    def decode(cls, data: bytes) -> Intent:
        """The intent that was encoded."""
        _, robot, tick, row, column, action, sides = cls._FORMAT.unpack(data)
        return cls(robot, tick, (row, column), action, bool(sides & 1), bool(sides & 2))


@dataclass(frozen=True)
class Share:
    """The map of a communicating robot; members of its network forward it."""

    robot: int
    """Whose map it is."""
    tick: int
    evidence: Evidence

    _FORMAT = struct.Struct("<BBQHH")

    @property
    def map(self) -> NDArray[np.int8]:
        """Unknown, free and occupied cells, int8 [H, W]."""
        return self.evidence.map

    def check(self, shape: tuple[int, int]) -> None:
        """Raise an error for what cannot be the evidence for a map [H, W].

        Raises:
            ValueError: saying why.
        """
        evidence = self.evidence
        require(isinstance(evidence, Evidence), "evidence", evidence, "it must be Evidence")
        evidence.check()
        if evidence.looks.shape != shape:
            raise ValueError(
                f"a map of shape {evidence.looks.shape} is not allowed: the arena's is {shape}"
            )

    def encode(self) -> bytes:
        """Fourteen bytes, then the evidence, packed."""
        height, width = self.evidence.looks.shape
        head = self._FORMAT.pack(2, self.robot, self.tick, height, width)
        return head + pack(self.evidence, self.tick)

    @classmethod
    def decode(cls, data: bytes) -> Share:
        """The share that was encoded.

        Raises:
            ValueError: when it is not the evidence for a map of the stated size.
        """
        _, robot, tick, height, width = cls._FORMAT.unpack_from(data)
        evidence = unpack(data[cls._FORMAT.size :], height, width, tick)
        return cls(robot, tick, evidence)


@dataclass(frozen=True)
class Done:
    """A robot has finished a tick; sent to all robots, as part of the shared clock."""

    robot: int
    tick: int

    _FORMAT = struct.Struct("<BBQ")

    def encode(self) -> bytes:
        """Ten bytes."""
        return self._FORMAT.pack(3, self.robot, self.tick)

    @classmethod
    def decode(cls, data: bytes) -> Done:
        """The message that was encoded."""
        return cls(*cls._FORMAT.unpack(data)[1:])


Message = Intent | Share | Done
_KINDS: dict[int, type[Intent] | type[Share] | type[Done]] = {1: Intent, 2: Share, 3: Done}


def decode(data: bytes) -> Message:
    """The message that was encoded.

    Raises:
        ValueError: when the data are not a message.
    """
    kind = _KINDS.get(data[0]) if data else None
    if kind is None:
        raise ValueError(f"these {len(data)} bytes are not a message: {data[:8]!r}")
    try:
        return kind.decode(data)
    except (struct.error, ValueError) as error:
        raise ValueError(f"broken message {kind.__name__}: {error}") from error


_CRC_BYTES = 4


@dataclass(frozen=True)
class Envelope:
    """A message with its sender and receivers."""

    sender: int
    """The sending robot; for a forwarded share not the owner of the map."""
    to: tuple[int, ...]
    """The receiving robots."""
    message: Message

    def encode(self) -> bytes:
        """The sender, the message, and a CRC-32 of both: five bytes more than the message."""
        data = bytes([self.sender]) + self.message.encode()
        return data + zlib.crc32(data).to_bytes(_CRC_BYTES, "little")

    @classmethod
    def decode(cls, data: bytes, receiver: int) -> Envelope:
        """The message that was encoded.

        Args:
            data: as from ``encode``.
            receiver: who got it.

        Raises:
            ValueError: when the data are not a message, or were damaged on the way.
        """
        told, crc = data[:-_CRC_BYTES], data[-_CRC_BYTES:]
        if len(told) < 1 or zlib.crc32(told) != int.from_bytes(crc, "little"):
            raise ValueError(f"these {len(data)} bytes are not a message, or damaged: the CRC-32")
        return cls(told[0], (receiver,), decode(told[1:]))

    def check(self, receiver: int, robots: int, shape: tuple[int, int], tick: int = -1) -> None:
        """Raise an error for a message that cannot come from the team, or is for another robot.

        Args:
            receiver: who got it.
            robots: size of the team, N.
            shape: of its maps, [H, W].
            tick: the receiver's.

        Raises:
            ValueError: naming what does not fit.
        """
        message = self.message
        if not isinstance(message, Message):
            raise ValueError(f"message={message!r} is not allowed: an Intent, a Share or a Done")
        for number in (self.sender, message.robot):
            require_robot(number, robots, "a message")
        if self.sender == receiver:
            raise ValueError(f"a message of robot {receiver} to itself is not allowed")
        if not isinstance(self.to, tuple) or receiver not in self.to:
            raise ValueError(
                f"a message to robots {self.to} is not allowed: this is robot {receiver}"
            )
        if not isinstance(message, Share) and message.robot != self.sender:
            raise ValueError(
                f"{type(message).__name__} of robot {message.robot} is not allowed: robot "
                f"{self.sender} sent it, and only maps are passed on"
            )
        latest = min(tick + MOST_AHEAD, MOST_TICKS)
        fits = is_integer(message.tick) and 0 <= message.tick <= latest
        require(fits, "tick", message.tick, f"0 to {latest}")
        if not isinstance(message, Done):
            message.check(shape)


def require_robot(number: int, robots: int, what: str) -> None:
    """Raise an error for the number of a robot that is not in the team.

    Raises:
        ValueError: naming it.
    """
    if not (is_integer(number) and 0 <= number < robots):
        raise ValueError(f"{what} of robot {number!r} is not allowed: 0 to {robots - 1}")
