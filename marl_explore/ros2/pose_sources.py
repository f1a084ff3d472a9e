"""Where a robot is in its map: from a topic, or from tf, which is imported only if it is chosen."""

from __future__ import annotations

from typing import Any, Protocol

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.time import Time

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
        if self._latest is None:
            return None
        convert.require_frame(self._latest, self._frame)
        return convert.to_place(self._latest)

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


def listen_to_tf(node: Node, frame: str, base_frame: str) -> TransformPoses:
    """Poses from ``/tf`` and ``/tf_static``.

    Raises:
        ValueError: when tf2_ros is not installed.
    """
    try:
        from tf2_ros import Buffer, TransformException, TransformListener
    except ImportError as error:
        raise ValueError(f"pose_source='tf' is not allowed: {error}") from None
    buffer = Buffer()
    buffer.listener = TransformListener(buffer, node)  # it lives as long as the buffer
    return TransformPoses(buffer, frame, base_frame, TransformException)
