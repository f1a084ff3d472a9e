"""Shared by all nodes: QoS for robots that join late, read-only parameters, and shutdown."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any, Generic

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from marl_explore.ros2 import convert
from marl_explore.ros2.parameters import Given, flat, replaced


def _kept(depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


LETTERS = _kept(16)
"""The last messages of every sender also reach a robot that joins late, so it learns the tick."""
LATEST = _kept(1)
"""The last map is kept."""


_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides.")


def time_of(node: Node) -> float:
    """The node's time (seconds), simulated if ``use_sim_time``; 0 before it is known."""
    return convert.to_seconds(node.get_clock().now().to_msg())


def diagnostics(fields: convert.Fields, stamp: float) -> DiagnosticArray:
    """A status as diagnostic_msgs/DiagnosticArray.

    Args:
        fields: of a DiagnosticStatus; ``values`` are (key, value).
        stamp: time of the status (seconds).
    """
    values = [KeyValue(key=key, value=value) for key, value in fields["values"]]
    status = convert.fill(DiagnosticStatus(), {**fields, "values": values})
    return convert.fill(
        DiagnosticArray(status=[status]), {"header": convert.header_fields(stamp, "")}
    )


class ParameterNode(Node, Generic[Given]):
    """A node whose parameters are the fields of a dataclass; while it runs they are read-only.

    Args:
        name: of the node.
        default: the default values.

    Raises:
        ValueError: for an unknown parameter, or a value that is not allowed.
    """

    def __init__(self, name: str, default: Given) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        given = {
            name: parameter.value
            for name, parameter in self.get_parameters_by_prefix("").items()
            if not name.startswith(_OF_ROS)
        }
        self.given = replaced(default, given)
        for name, value in flat(default).items():
            if name not in given:
                self.declare_parameter(name, value)
            kind = self.describe_parameter(name).type
            self.set_descriptor(name, ParameterDescriptor(type=kind, read_only=True))


def run(make: Callable[[], Node], args: list[str] | None, stop: Callable[[Any], None]) -> None:
    """Spin a node until SIGINT or SIGTERM, or an error.

    Args:
        make: the node.
        args: command line.
        stop: called with the node when it ends, also after an error, while it can still publish.

    Raises:
        SystemExit: with the error, when the node rejects its parameters.
    """
    told: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        # an exception raised here could be lost in a callback of the middleware
        signal.signal(number, lambda number, frame: told.append(number))
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        try:
            node = make()
        except ValueError as error:
            raise SystemExit(f"error: {error}") from None
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        try:
            while not told:
                executor.spin_once(timeout_sec=0.1)
        finally:
            stop(node)
            node.destroy_node()
    finally:
        rclpy.try_shutdown()
