"""Where a robot is in its map: from a topic, or from tf, which is imported only if it is chosen."""

from __future__ import annotations

from typing import Any, Protocol

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.time import Time

from marl_explore.robot import Scan
from marl_explore.robot.explorer import Place
from marl_explore.ros2 import convert
from marl_explore.ros2.listening import Listener

POSES = {
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseWithCovarianceStamped,
    "geometry_msgs/msg/PoseStamped": PoseStamped,
}
"""Types of messages with a pose; slam_toolbox has the first."""


class PoseSource(Protocol):
    """Tells where the robot is."""

    name: str
    """For people."""

    def place(self) -> Place | None:
        """The latest place; None if none is known.

        Raises:
            ValueError: for a pose that cannot be used.
        """

    def update(self) -> None:
        """Look for publishers."""

    def problem(self) -> str | None:
        """What is missing, in a few words; None if nothing is."""


class TopicPoses:
    """Poses from a topic.

    Args:
        node: that subscribes.
        topic: of PoseStamped or PoseWithCovarianceStamped.
        frame: in which poses must be.
    """

    def __init__(self, node: Node, topic: str, frame: str) -> None:
        self._frame, self._latest = frame, None
        self._listener = Listener(node, topic, POSES, self._take)
        self.name, self.update = self._listener.topic, self._listener.update
        self.problem = self._listener.problem

    def place(self) -> Place | None:
        """The place of the latest message; see ``PoseSource``."""
        latest, self._latest = self._latest, None
        if latest is None:
            return None
        convert.require_frame(latest, self._frame)
        place = convert.to_place(latest)
        self._latest = latest  # one that cannot be used is told of once
        return place

    def _take(self, message: Any) -> None:
        self._latest = message


class TransformPoses:
    """Poses from tf.

    Args:
        buffer: ``tf2_ros.Buffer``, or anything with its ``lookup_transform``.
        frame: of the map.
        base_frame: of the robot.
        missing: what the buffer raises when there is no transform.
    """

    def __init__(self, buffer: Any, frame: str, base_frame: str, missing: type[Exception]) -> None:
        self.name = f"tf from {frame} to {base_frame}"
        self._buffer, self._frames, self._missing = buffer, (frame, base_frame), missing

    def place(self) -> Place | None:
        """The place of the latest transform; see ``PoseSource``."""
        try:
            found = self._buffer.lookup_transform(*self._frames, Time())
        except self._missing:
            return None
        moved, turned = found.transform.translation, found.transform.rotation
        return Place(float(moved.x), float(moved.y), convert.yaw_of(turned))

    def update(self) -> None:
        """Nothing to do: the buffer listens."""

    def problem(self) -> str | None:
        """What is missing, in a few words; None if nothing is."""
        return "no transform" if self.place() is None else None


class LidarTransforms:
    """Scans of a lidar that is where tf has it on the robot.

    Args:
        buffer: as for ``TransformPoses``.
        base_frame: of the robot.
        missing: as for ``TransformPoses``.
    """

    def __init__(self, buffer: Any, base_frame: str, missing: type[Exception]) -> None:
        self._buffer, self._base_frame, self._missing = buffer, base_frame, missing

    def scan(self, message: Any) -> Scan:
        """The scan of a sensor_msgs/LaserScan.

        Raises:
            ValueError: without a transform from the robot to the scan's frame, or with one of a
                lidar that is tilted.
        """
        frame = message.header.frame_id.lstrip("/")
        try:
            found = self._buffer.lookup_transform(self._base_frame, frame, Time())
        except self._missing:
            raise ValueError(f"there is no tf from {self._base_frame} to {frame!r}") from None
        return convert.to_mounted_scan(message, found.transform)


def listen_to_tf(node: Node, wanted: str) -> tuple[Any, type[Exception]]:
    """A buffer that hears ``/tf`` and ``/tf_static``, and what it raises without a transform.

    Args:
        node: that subscribes.
        wanted: the parameter that wants it, for the error.

    Raises:
        ValueError: when tf2_ros is not installed.
    """
    try:
        from tf2_ros import Buffer, TransformException, TransformListener
    except ImportError as error:
        raise ValueError(f"{wanted} is not allowed: {error}") from None
    buffer = Buffer()
    buffer.listener = TransformListener(buffer, node)  # it lives as long as the buffer
    return buffer, TransformException
