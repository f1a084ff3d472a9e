"""What both nodes share: how messages are kept for those that come late, and how a node ends."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from marl_explore.ros2.convert import to_seconds


def _kept(depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


LETTERS = _kept(16)
"""The last letters of every sender also reach a robot that comes late: it learns the tick."""
LATEST = _kept(1)
"""Of maps, the last one."""


def time_of(node: Node) -> float:
    """The node's time (seconds), simulated if ``use_sim_time``; 0 before it is known."""
    return to_seconds(node.get_clock().now().to_msg())


def declare(node: Node) -> Callable[[str, Any], Any]:
    """How a node declares a parameter."""
    return lambda name, default: node.declare_parameter(name, default).value


def run(make: Callable[[], Node], args: list[str] | None, stop: Callable[[Any], None]) -> None:
    """Spin a node until SIGINT or SIGTERM.

    Args:
        make: the node.
        args: command line.
        stop: called with the node when it has to end, while it can still publish.

    Raises:
        SystemExit: with what is wrong, when the node refuses its parameters.
    """
    told: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        # an exception from here could be lost in a callback of the middleware
        signal.signal(number, lambda number, frame: told.append(number))
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        try:
            node = make()
        except ValueError as error:
            raise SystemExit(f"error: {error}") from None
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not told:
            executor.spin_once(timeout_sec=0.1)
        stop(node)
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
