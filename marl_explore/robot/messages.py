"""Sensor data of a robot, and the messages between robots with their encoding."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import NUM_ACTIONS, UNKNOWN
from marl_explore.robot.geometry import GridCell

MOST_TICKS_APART = 10_000
"""Between a message and its receiver; a robot that joins late takes over the team's tick."""


def _require_finite(measured: Pose | Scan, *names: str) -> None:
    for name in names:
        value = getattr(measured, name)
        if not math.isfinite(value):
            raise ValueError(f"{name}={value!r} is not allowed: it must be a finite number")


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
        """Raise an error for numbers that are not finite.

        Raises:
            ValueError: naming the field and its value.
        """
        _require_finite(self, "stamp", "x", "y", "yaw")

    def ahead(self, distance: float) -> Pose:
        """The pose moved forward by a distance (metres)."""
        x, y = self.x + distance * math.cos(self.yaw), self.y + distance * math.sin(self.yaw)
        return replace(self, x=x, y=y)


@dataclass(frozen=True)
class Scan:
    """One turn of a robot's lidar, as ROS's LaserScan has it."""

    stamp: float
    """Time of measurement (seconds)."""
    ranges: NDArray[np.floating]
    """Distances [R] (metres); 0, inf and NaN are no return, unless the lidar is off."""
    angle_min: float = 0.0
    """Angle of the first beam in the robot's frame, 0 ahead (radians)."""
    angle_increment: float = 2 * np.pi / 360
    """Angle between beams, counter-clockwise (radians)."""
    range_min: float = 0.12
    """Shorter ranges are ignored (metres)."""
    range_max: float = 3.5
    """Longer ranges mean no return (metres)."""

    @property
    def is_on(self) -> bool:
        """Whether the lidar is on and not covered: some range is above ``range_min``."""
        return bool((np.asarray(self.ranges) > self.range_min).any())

    def check(self) -> None:
        """Raise an error for numbers that are not finite, and for a lidar that is off.

        Raises:
            ValueError: naming the field and its value.
        """
        _require_finite(self, "stamp", "angle_min", "angle_increment", "range_min", "range_max")
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

    _FORMAT = struct.Struct("<BBIhhBB")

    def encode(self) -> bytes:
        """Twelve bytes."""
        sides = self.upright | self.sideways << 1
        return self._FORMAT.pack(1, self.robot, self.tick, *self.cell, self.action, sides)

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
    map: NDArray[np.int8]
    """int8 [H, W]."""

    _FORMAT = struct.Struct("<BBIHH")

    def encode(self) -> bytes:
        """Ten bytes, and two bits per cell."""
        height, width = self.map.shape
        codes = (self.map - UNKNOWN).astype(np.uint8)
        bits = np.packbits(np.stack((codes & 1, codes >> 1)).astype(bool))
        return self._FORMAT.pack(2, self.robot, self.tick, height, width) + bits.tobytes()

    @classmethod
    def decode(cls, data: bytes) -> Share:
        """The share that was encoded.

        Raises:
            ValueError: for a wrong length, before allocating memory, or other cell values.
        """
        _, robot, tick, height, width = cls._FORMAT.unpack_from(data)
        length = cls._FORMAT.size + math.ceil(height * width / 4)
        if len(data) != length:
            raise ValueError(
                f"a map of {height} x {width} cells has {length} bytes, not {len(data)}"
            )
        packed = np.frombuffer(data, np.uint8, offset=cls._FORMAT.size)
        low, high = np.unpackbits(packed, count=2 * height * width).reshape(2, height, width)
        if (low & high).any():
            raise ValueError("cells are unknown, free or occupied: 0, 1 or 2, not 3")
        return cls(robot, tick, (low + 2 * high).astype(np.int8) + np.int8(UNKNOWN))


@dataclass(frozen=True)
class Done:
    """A robot has finished a tick; sent to all robots, as part of the shared clock."""

    robot: int
    tick: int

    _FORMAT = struct.Struct("<BBI")

    def encode(self) -> bytes:
        """Six bytes."""
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


@dataclass(frozen=True)
class Envelope:
    """A message with its sender and receivers."""

    sender: int
    """The sending robot; for a forwarded share not the owner of the map."""
    to: tuple[int, ...]
    """The receiving robots."""
    message: Message

    def check(self, robots: int, shape: tuple[int, int], tick: int) -> None:
        """Raise an error for a message that cannot come from the team.

        Args:
            robots: size of the team, N.
            shape: of its maps, [H, W].
            tick: of the receiver.

        Raises:
            ValueError: naming what does not fit.
        """
        message = self.message
        for number in (self.sender, message.robot):
            if number >= robots:
                raise ValueError(f"a message of robot {number} is not allowed: 0 to {robots - 1}")
        if not isinstance(message, Share) and message.robot != self.sender:
            raise ValueError(
                f"{type(message).__name__} of robot {message.robot} is not allowed: robot "
                f"{self.sender} sent it, and only maps are passed on"
            )
        if isinstance(message, Intent) and message.action >= NUM_ACTIONS:
            raise ValueError(f"action={message.action} is not allowed: 0 to {NUM_ACTIONS - 1}")
        if abs(message.tick - tick) > MOST_TICKS_APART:
            raise ValueError(
                f"tick={message.tick} is not allowed: at most {MOST_TICKS_APART} from that of the "
                f"receiver, {tick}"
            )
        if isinstance(message, Share) and message.map.shape != shape:
            raise ValueError(
                f"a map of shape {message.map.shape} is not allowed: the arena's is {shape}"
            )
