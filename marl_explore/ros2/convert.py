"""Conversion to and from standard ROS messages: pure functions on the messages' fields.

``*_fields`` return a message's fields as nested dictionaries, ``fill`` writes them into a message,
and ``to_*`` read any object with those fields, from rclpy or from a recording.
"""

from __future__ import annotations

import array
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.constants import FREE, OCCUPIED, UNKNOWN
from marl_explore.robot import Envelope, Pose, Scan
from marl_explore.robot.driving import Velocity
from marl_explore.robot.explorer import OccupancyMap, Place
from marl_explore.robot.geometry import Frame, Mount
from marl_explore.robot.status import Status

Fields = dict[str, Any]
OK, WARN = b"\x00", b"\x01"
"""Levels of diagnostic_msgs/DiagnosticStatus."""
PERCENT_OCCUPIED = 100
"""An obstacle in an OccupancyGrid, which holds probabilities in percent; unknown is -1."""
MOST_TILT = 0.1
"""Of what must be level: maps and lidars (radians)."""
LEAST_SQUARE, MOST_SQUARE = 1e-6, 1e6
"""Squares of the lengths of quaternions that were meant to have length 1."""


def fill(message: Any, fields: Mapping[str, Any]) -> Any:
    """The message with its fields set, with arrays in the types that rclpy expects."""
    for name, value in fields.items():
        if isinstance(value, Mapping):
            fill(getattr(message, name), value)
        elif isinstance(value, np.ndarray):
            setattr(message, name, array.array(value.dtype.char, value.tobytes()))
        else:
            setattr(message, name, value)
    return message


def time_fields(seconds: float) -> Fields:
    """builtin_interfaces/Time."""
    whole, rest = divmod(round(seconds * 1e9), 1_000_000_000)
    return {"sec": whole, "nanosec": rest}


def to_seconds(stamp: Any) -> float:
    """Seconds of a builtin_interfaces/Time."""
    return float(stamp.sec + stamp.nanosec * 1e-9)


def header_fields(seconds: float, frame_id: str) -> Fields:
    """std_msgs/Header."""
    return {"stamp": time_fields(seconds), "frame_id": frame_id}


def scan_fields(scan: Scan, frame_id: str) -> Fields:
    """sensor_msgs/LaserScan; ``frame_id`` names the lidar's frame."""
    ranges = np.asarray(scan.ranges, np.float32)
    return {
        "header": header_fields(scan.stamp, frame_id),
        "angle_min": float(scan.angle_min),
        "angle_max": float(scan.angle_min + scan.angle_increment * (len(ranges) - 1)),
        "angle_increment": float(scan.angle_increment),
        "range_min": float(scan.range_min),
        "range_max": float(scan.range_max),
        "ranges": ranges,
    }


def to_scan(message: Any, mount: Mount | None = None) -> Scan:
    """The scan of a sensor_msgs/LaserScan.

    Args:
        message: the LaserScan.
        mount: where the lidar is on the robot; None: as the robot's settings have it.
    """
    return Scan(
        stamp=to_seconds(message.header.stamp),
        ranges=np.array(message.ranges, np.float64),
        angle_min=float(message.angle_min),
        angle_increment=float(message.angle_increment),
        range_min=float(message.range_min),
        range_max=float(message.range_max),
        mount=mount,
    )


def to_mounted_scan(message: Any, transform: Any) -> Scan:
    """The scan of a LaserScan whose lidar is where a geometry_msgs/Transform has it on the robot.

    A lidar that is upside down turns the other way round.

    Raises:
        ValueError: for a lidar that is tilted, or an orientation that is none.
    """
    moved, turned = transform.translation, transform.rotation
    tilt = tilt_of(turned)
    if min(tilt, math.pi - tilt) > MOST_TILT:
        raise ValueError(
            f"a lidar that is tilted by {math.degrees(tilt):.0f} degrees is not allowed: it must "
            "be level, or upside down"
        )
    scan = to_scan(message, Mount(float(moved.x), float(moved.y), yaw_of(turned)))
    if tilt <= MOST_TILT:
        return scan
    return replace(scan, angle_min=-scan.angle_min, angle_increment=-scan.angle_increment)


def pose_fields(pose: Pose, frame_id: str) -> Fields:
    """geometry_msgs/PoseStamped; ``frame_id`` names the arena's frame."""
    place = Place(float(pose.x), float(pose.y), float(pose.yaw))
    return place_fields(place, pose.stamp, frame_id)


def place_fields(place: Place, stamp: float, frame_id: str) -> Fields:
    """geometry_msgs/PoseStamped of a place in a map."""
    turned = {"x": 0.0, "y": 0.0, "z": math.sin(place.yaw / 2), "w": math.cos(place.yaw / 2)}
    return {
        "header": header_fields(stamp, frame_id),
        "pose": {"position": {"x": place.x, "y": place.y, "z": 0.0}, "orientation": turned},
    }


def to_pose(message: Any, robot: int) -> Pose:
    """The pose of a geometry_msgs/PoseStamped; of its orientation only the yaw is used.

    Raises:
        ValueError: for an orientation that is none.
    """
    return Pose(to_seconds(message.header.stamp), robot, *to_place(message))


def to_place(message: Any) -> Place:
    """Where a geometry_msgs/PoseStamped or PoseWithCovarianceStamped says that something is.

    Raises:
        ValueError: for an orientation that is none.
    """
    pose = getattr(message.pose, "pose", message.pose)
    return Place(float(pose.position.x), float(pose.position.y), yaw_of(pose.orientation))


def yaw_of(turned: Any) -> float:
    """Heading of a geometry_msgs/Quaternion of any length (radians).

    Raises:
        ValueError: for numbers that are not finite, or are all near 0, as in an empty message.
    """
    x, y, z, w = _unit(turned)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def tilt_of(turned: Any) -> float:
    """Angle between what a geometry_msgs/Quaternion turns up and up, 0 to pi (radians).

    Raises:
        ValueError: as ``yaw_of``.
    """
    x, y, _, _ = _unit(turned)
    return 2 * math.asin(min(math.hypot(x, y), 1.0))


def _unit(turned: Any) -> list[float]:
    """A quaternion's x, y, z, w at length 1."""
    numbers = [float(getattr(turned, name)) for name in "xyzw"]
    square = sum(number * number for number in numbers)
    if not MOST_SQUARE > square > LEAST_SQUARE:  # also for NaN
        raise ValueError(
            f"orientation={tuple(numbers)!r} is not allowed: it must be a quaternion of length 1"
        )
    return [number / math.sqrt(square) for number in numbers]


def require_frame(message: Any, frame: str) -> None:
    """Raise an error unless a message with a header is in a frame.

    Raises:
        ValueError: naming both frames.
    """
    given, frame = message.header.frame_id.lstrip("/"), frame.lstrip("/")
    if given != frame:
        raise ValueError(f"frame_id={given!r} is not allowed: it must be {frame!r}")


def grid_fields(grid: NDArray[np.int8], frame: Frame, stamp: float, frame_id: str) -> Fields:
    """nav_msgs/OccupancyGrid: row 0 is in the south, and its corner is south-west of the origin.

    Args:
        grid: a map, int8 [H, W], row 0 north.
        frame: the arena's grid.
        stamp: time of the map (seconds).
        frame_id: name of the arena's frame.
    """
    percent = np.where(grid == OCCUPIED, np.int8(PERCENT_OCCUPIED), grid)
    corner = {
        "x": -frame.width * frame.cell_size / 2,
        "y": -frame.height * frame.cell_size / 2,
        "z": 0.0,
    }
    return {
        "header": header_fields(stamp, frame_id),
        "info": {
            "map_load_time": time_fields(stamp),
            "resolution": float(frame.cell_size),
            "width": frame.width,
            "height": frame.height,
            "origin": {"position": corner, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}},
        },
        "data": np.ascontiguousarray(percent[::-1]).ravel(),
    }


def to_grid(message: Any) -> NDArray[np.int8]:
    """The map of a nav_msgs/OccupancyGrid, int8 [H, W], row 0 north; 50 % is occupied."""
    percent = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
    codes = np.where(percent >= PERCENT_OCCUPIED // 2, np.int8(OCCUPIED), np.int8(FREE))
    return np.where(percent < 0, np.int8(UNKNOWN), codes)[::-1]


def to_occupancy_map(message: Any) -> OccupancyMap:
    """The map of a nav_msgs/OccupancyGrid, of any size, resolution and origin.

    Raises:
        ValueError: when there are more or fewer data than cells, or the origin's orientation is
            none or not level.
    """
    info, data = message.info, np.array(message.data)
    if data.size != info.height * info.width:
        raise ValueError(
            f"data of {data.size} cells are not allowed: the map has {info.height} x {info.width}"
        )
    percent = data.astype(np.int8)
    if (percent != data).any():
        raise ValueError("data beyond -128 to 127 are not allowed: they must be int8")
    corner, turned = info.origin.position, info.origin.orientation
    origin = Place(float(corner.x), float(corner.y), yaw_of(turned))
    if (tilt := tilt_of(turned)) > MOST_TILT:
        raise ValueError(
            f"a map that is tilted by {math.degrees(tilt):.0f} degrees is not allowed: it must lie "
            "level, seen from above"
        )
    return OccupancyMap(percent.reshape(info.height, info.width), float(info.resolution), origin)


def letter_fields(envelope: Envelope) -> Fields:
    """std_msgs/UInt8MultiArray: the bytes of a message with its sender and a checksum."""
    return {"data": np.frombuffer(envelope.encode(), np.uint8)}


def to_letter(message: Any, receiver: int) -> Envelope:
    """The message in a std_msgs/UInt8MultiArray, with its sender.

    Raises:
        ValueError: when the data are not such a message.
    """
    return Envelope.decode(bytes(message.data), receiver)


def status_fields(status: Status, name: str, details: Mapping[str, Any]) -> Fields:
    """diagnostic_msgs/DiagnosticStatus; ``values`` are (key, value).

    Args:
        status: of the robot.
        name: of the robot.
        details: by name.
    """
    return {
        "level": WARN if status.is_fault else OK,
        "name": f"{name}/robot",
        "message": status.text,
        "hardware_id": name,
        "values": [("kind", status.reason.value)]
        + [(key, str(value)) for key, value in details.items()],
    }


def velocity_fields(velocity: Velocity) -> Fields:
    """geometry_msgs/Twist."""
    return {
        "linear": {"x": float(velocity.forward), "y": 0.0, "z": 0.0},
        "angular": {"x": 0.0, "y": 0.0, "z": float(velocity.turn)},
    }


def stamped_velocity_fields(velocity: Velocity, stamp: float, frame_id: str) -> Fields:
    """geometry_msgs/TwistStamped; ``frame_id`` names the robot's frame."""
    return {"header": header_fields(stamp, frame_id), "twist": velocity_fields(velocity)}


def to_velocity(message: Any) -> Velocity:
    """The velocity of a geometry_msgs/Twist or TwistStamped."""
    twist = getattr(message, "twist", message)
    return Velocity(float(twist.linear.x), float(twist.angular.z))
