"""Recordings of robots as rosbag2 in MCAP, with the package rosbags (extra "ros"), without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from marl_explore.robot import Envelope, Pose, RobotCore, Scan
from marl_explore.robot.driving import Velocity
from marl_explore.robot.geometry import Mount
from marl_explore.ros2 import convert
from marl_explore.utils.files import file_digest

_TYPES = get_typestore(Stores.ROS2_JAZZY)
_KINDS = {
    "scan": "sensor_msgs/msg/LaserScan",
    "pose": "geometry_msgs/msg/PoseStamped",
    "inbox": "std_msgs/msg/UInt8MultiArray",
    "cmd_vel": "geometry_msgs/msg/TwistStamped",
}
CHECKSUMS = "SHA256SUMS"
"""File in the folder of a recording, as ``sha256sum`` writes it."""
_ALLOWED: dict[str, tuple[str, ...]] = {name: (kind,) for name, kind in _KINDS.items()}
_ALLOWED["cmd_vel"] += ("geometry_msgs/msg/Twist",)


class Recorder:
    """Writes what robots receive and the velocities that they send, on ``robot_node``'s topics.

    Use it in a ``with`` statement; the recording keeps the order of the calls.

    Args:
        path: new folder of the recording.
        team: namespaces of all robots, in the order of their numbers.
        frame: frame of poses.
    """

    def __init__(self, path: str | Path, team: Sequence[str], frame: str = "arena") -> None:
        self.team, self.frame = team, frame
        self._path = Path(path)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Any] = {}
        self._last = -1

    def __enter__(self) -> Recorder:
        self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._writer.close()
        lines = (f"{digest}  {name}\n" for name, digest in _digests(self._path).items())
        (self._path / CHECKSUMS).write_text("".join(lines))

    def receive(self, robot: int, event: Scan | Pose | Envelope, now: float) -> None:
        """Record that a robot receives an event; of poses, only its own are recorded.

        Args:
            robot: the receiver.
            event: as for ``RobotCore.receive``.
            now: time of arrival (seconds).
        """
        if isinstance(event, Scan):
            frame = f"{self.team[robot]}/base_scan"
            self._write(robot, "scan", convert.scan_fields(event, frame), now)
        elif isinstance(event, Envelope):
            self._write(robot, "inbox", convert.letter_fields(event), now)
        elif event.robot == robot:
            self._write(robot, "pose", convert.pose_fields(event, self.frame), now)

    def answer(self, robot: int, velocity: Velocity, now: float) -> None:
        """Record a robot's velocity (metres and radians per second) at a time (seconds)."""
        fields = convert.stamped_velocity_fields(velocity, now, "base_link")
        self._write(robot, "cmd_vel", fields, now)

    def _write(self, robot: int, topic: str, fields: Mapping[str, Any], now: float) -> None:
        name, kind = f"/{self.team[robot]}/{topic}", _KINDS[topic]
        if name not in self._connections:
            self._connections[name] = self._writer.add_connection(name, kind, typestore=_TYPES)
        # readers sort by time: simultaneous messages keep their order by a nanosecond
        self._last = max(self._last + 1, round(now * 1e9))
        data = _TYPES.serialize_cdr(_message(kind, fields), kind)
        self._writer.write(self._connections[name], self._last, data)


def messages(path: str | Path) -> Iterator[tuple[str, float, Any]]:
    """Topic, time (seconds) and message of everything in a recording, ordered by time.

    Raises:
        ValueError: naming it, when it is not a recording or cannot be read to its end.
    """
    if not (Path(path) / "metadata.yaml").is_file():
        raise ValueError(f"{path} is not a recording: it has no metadata.yaml")
    _check_sums(Path(path))
    number = 0
    with ExitStack() as stack:
        try:  # rosbags raises whatever its parsers of YAML, MCAP and CDR raise
            reader = stack.enter_context(AnyReader([Path(path)], default_typestore=_TYPES))
            found = reader.messages()
        except Exception as error:
            raise _unreadable(path, error) from error
        while True:
            try:
                connection, nanoseconds, data = next(found)
                message = reader.deserialize(data, connection.msgtype)
            except StopIteration:
                break
            except Exception as error:
                raise _unreadable(path, error) from error
            number += 1
            yield connection.topic, nanoseconds * 1e-9, message
        if number != reader.message_count:
            lost = ValueError(f"it has {number} of {reader.message_count} messages")
            raise _unreadable(path, lost)


def _check_sums(folder: Path) -> None:
    """Compare the files of a recording of ``Recorder`` with their checksums."""
    if not (folder / CHECKSUMS).is_file():
        return  # MCAP files of ROS have checksums of their own
    lines = (folder / CHECKSUMS).read_text(errors="replace").splitlines()
    written = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    found = _digests(folder)
    if changed := sorted({name for name, _ in written.items() ^ found.items()}):
        raise _unreadable(folder, ValueError(f"{', '.join(changed)}: not as it was written"))


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of the files in a folder by name, but for the file of checksums."""
    files = sorted(file for file in folder.iterdir() if file.name != CHECKSUMS)
    return {file.name: file_digest(file) for file in files}


def _unreadable(path: str | Path, error: Exception) -> ValueError:
    return ValueError(f"{path} cannot be read as a recording: {type(error).__name__}: {error}")


def replay_recording(
    path: str | Path,
    core: RobotCore,
    team: Sequence[str],
    frame: str = "arena",
    mount: Mount | None = None,
) -> int:
    """Run a robot on a recording.

    It receives its scans, its messages and all poses again, and advances at every time at which it
    sent a velocity.

    Args:
        path: folder of the recording.
        core: a new robot, with the policy and seed of the recorded one.
        team: namespaces of all robots, in the order of their numbers.
        frame: of poses; those in others were dropped, as by ``robot_node``.
        mount: where the lidar was, of a robot that read it from tf; None: as the settings have it.

    Returns:
        How often it advanced.

    Raises:
        ValueError: when it cannot be read, a topic has messages of another type, or the robot sent
            no velocity.
    """
    own, advanced = team[core.robot], 0
    take: dict[str, Callable[[Any], Scan | Pose | Envelope]] = {
        f"/{name}/pose": partial(_pose, robot=robot, frame=frame) for robot, name in enumerate(team)
    }
    take |= {
        f"/{own}/scan": lambda message: replace(convert.to_scan(message), mount=mount),
        f"/{own}/inbox": partial(convert.to_letter, receiver=core.robot),
    }
    for topic, time, message in messages(path):
        if topic in take or topic == f"/{own}/cmd_vel":
            _check_kind(path, topic, message)
        if topic in take:
            with suppress(ValueError):  # the robot dropped it too
                core.receive(take[topic](message), time)
        elif topic == f"/{own}/cmd_vel":
            stamped = hasattr(message, "header")
            now = convert.to_seconds(message.header.stamp) if stamped else time
            try:
                core.advance(now)
            except ValueError as error:
                raise ValueError(f"{path} cannot be replayed: {error}") from error
            advanced += 1
    if not advanced:
        raise ValueError(f"{path} has no /{own}/cmd_vel, so it is unknown when the robot acted")
    return advanced


def _pose(message: Any, robot: int, frame: str) -> Pose:
    convert.require_frame(message, frame)
    return convert.to_pose(message, robot)


def _check_kind(path: str | Path, topic: str, message: Any) -> None:
    """Refuse messages of another type on a topic of the robots."""
    allowed = _ALLOWED[topic.rpartition("/")[-1]]
    if message.__msgtype__ not in allowed:
        raise ValueError(
            f"{path} cannot be replayed: {topic} has {message.__msgtype__}, not {allowed[0]}"
        )


def _message(kind: str, fields: Mapping[str, Any]) -> Any:
    """A message of rosbags; fields that are not given are zero."""
    values = {}
    detail: Any  # kind of a nested message, or element type of a sequence
    for name, (node, detail) in _TYPES.fielddefs[kind][1]:
        if node is Nodetype.NAME:
            values[name] = _message(detail, fields.get(name, {}))
        elif node is Nodetype.BASE:
            values[name] = fields.get(name, "" if detail[0] == "string" else 0)
        else:
            values[name] = fields.get(name, _empty(*detail[0]))
    return _TYPES.types[kind](**values)


def _empty(node: Nodetype, detail: Any) -> Any:
    """An empty sequence: an array for numbers, a list for messages."""
    return np.array([], detail[0]) if node is Nodetype.BASE else []
