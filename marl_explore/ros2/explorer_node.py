"""Exploration for a robot with SLAM and Nav2: ``ros2 run marl_explore_ros2 explorer_node``.

With ``--check`` it only says which topics are missing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock, ClockType
from rclpy.utilities import remove_ros_args
from visualization_msgs.msg import Marker, MarkerArray

from marl_explore.robot.explorer import Output, Place, Status
from marl_explore.robot.explorer.grids import SIDE
from marl_explore.ros2 import convert, displays
from marl_explore.ros2.explorer_parameters import ExplorerParameters
from marl_explore.ros2.listening import Listener
from marl_explore.ros2.names import own_name, team_root
from marl_explore.ros2.node import LATEST, ParameterNode, diagnostics, run, time_of
from marl_explore.ros2.pose_sources import (
    POSES,
    PoseSource,
    TopicPoses,
    TransformPoses,
    listen_to_tf,
)
from marl_explore.ros2.status_log import Sightings

Kinds = dict[str, type]
Take = Callable[[Any, Any], None]
MAPS: Kinds = {"nav_msgs/msg/OccupancyGrid": OccupancyGrid}
GOALS: Kinds = {"geometry_msgs/msg/PoseStamped": PoseStamped}
CHECK_SECONDS = 10.0
"""How long ``--check`` waits for what is missing."""


class ExplorerNode(ParameterNode[ExplorerParameters]):
    """Passes maps and poses to ``ExplorerCore``, and publishes its goals and what it says.

    Args:
        check: whether to say what is missing, and end.
    """

    def __init__(self, check: bool = False) -> None:
        super().__init__("explorer_node", ExplorerParameters())
        given, namespace = self.given, self.get_namespace()
        self.name = own_name(namespace, given.team)
        self.core = given.make_core(self.name)
        self.poses = self._make_source()
        self.listeners = [self._listen(given.map_topic, MAPS, self._take_map)]
        root = team_root(namespace, self.name)
        self._mates = [f"{root}{mate}" for mate in self.core.team.mates]
        for mate in self.core.team.mates:
            for topic, kinds, take in (
                (given.map_topic, MAPS, self._take_map),
                (given.mate_pose_topic, POSES, self._take_pose),
                (given.goal_topic, GOALS, self._take_goal),
            ):
                self.listeners.append(self._listen(f"{root}{mate}/{topic}", kinds, take, mate))
        self._shown: tuple[Any, ...] | None = None
        self._states, self._dropped = Sightings(), 0
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        if check:
            self._until = time.monotonic() + CHECK_SECONDS
            self.create_timer(0.5, self._check, clock=steady)
            return
        self._goals = self.create_publisher(PoseStamped, given.goal_topic, LATEST)
        self._places = self.create_publisher(PoseStamped, "explorer/pose", 1)
        self._markers = self.create_publisher(MarkerArray, "explorer/markers", LATEST)
        self._statuses = self.create_publisher(DiagnosticArray, "explorer/status", LATEST)
        self.create_timer(1.0, self._update, clock=steady)
        self.create_timer(1 / given.rate, self._advance)

    def _make_source(self) -> PoseSource:
        given = self.given
        if given.pose_source == "tf":
            buffer, missing = listen_to_tf(self, "pose_source='tf'")
            return TransformPoses(buffer, given.frame, given.base_frame, missing)
        return TopicPoses(self, given.pose_topic, given.frame)

    def _listen(self, topic: str, kinds: Kinds, take: Take, mate: str | None = None) -> Listener:
        return Listener(self, topic, kinds, partial(self._guard, topic, partial(take, mate)))

    # ------------------------------------------------------------ what it hears

    def _guard(self, what: str, take: Callable[..., None], *message: Any) -> None:
        """Take a message, or drop it with an error."""
        try:
            take(*message)
        except ValueError as error:
            self._dropped += 1
            self.get_logger().error(f"dropped from {what}: {error}", throttle_duration_sec=5.0)

    def _take_map(self, mate: str | None, message: Any) -> None:
        convert.require_frame(message, self.given.frame_of(mate))
        self.core.take_map(convert.to_occupancy_map(message), mate)

    def _take_pose(self, mate: str, message: Any) -> None:
        convert.require_frame(message, self.given.frame_of(mate))
        self.core.take_place(convert.to_place(message), mate)

    def _take_goal(self, mate: str, message: Any) -> None:
        convert.require_frame(message, self.given.frame_of(mate))
        self.core.take_goal(convert.to_place(message), mate)

    def _take_own_place(self) -> None:
        place = self.poses.place()
        if place is not None:
            self.core.take_place(place)

    # ------------------------------------------------------------ what it does

    def _update(self) -> None:
        """Look for publishers, also while simulated time stands still."""
        self._follow_publishers()
        if not time_of(self):
            self._send_status(Status("waiting", "waiting for simulated time on /clock"), 0.0)

    def _follow_publishers(self) -> None:
        self.poses.update()
        for listener in self.listeners:
            listener.update()

    def _advance(self) -> None:
        now = time_of(self)
        if not now:  # simulated time has not begun
            return
        self._guard(self.poses.name, self._take_own_place)
        output = self.core.advance(now)
        if output.goal is not None:
            self._goals.publish(self._pose(output.goal, now))
        if self.core.place is not None:
            self._places.publish(self._pose(self.core.place, now))
        self._send_status(output.status, now)
        self._send_markers(output, now)

    def _pose(self, place: Place, now: float) -> Any:
        return convert.fill(PoseStamped(), convert.place_fields(place, now, self.given.frame))

    def _send_status(self, status: Status, now: float) -> None:
        if self._states.is_new(status.state, time.monotonic()):
            self.get_logger().info(f"{status.state}: {status.sentence}")
        fields = displays.status_fields(status, self.name, self._dropped)
        self._statuses.publish(diagnostics(fields, now))

    def _send_markers(self, output: Output, now: float) -> None:
        shown = output.frontiers, output.skipped, output.plan
        if shown == self._shown:
            return
        self._shown = shown
        side, frame = SIDE * self.given.settings.radius, self.given.frame
        self._markers.publish(
            MarkerArray(
                markers=[
                    convert.fill(Marker(points=[Point(x=x, y=y) for x, y in points]), fields)
                    for fields, points in displays.markers(output, side, now, frame)
                ]
            )
        )

    # ------------------------------------------------------------ what is missing

    def _check(self) -> None:
        """Say what is there once all is, or after a while; the process ends with 0 or 1."""
        self._follow_publishers()
        goal = self.resolve_topic_name(self.given.goal_topic)
        heard_by = self.get_subscriptions_info_by_topic(goal)  # explorers of teammates listen, too
        hears = any(info.node_namespace not in self._mates for info in heard_by)
        found = [(goal, None if hears else "no subscriber: is Nav2 running?")]
        found += [(self.poses.name, self.poses.problem())]
        if self.get_parameter("use_sim_time").value:
            ticks = self.count_publishers("/clock")
            found += [("/clock", None if ticks else "no publisher, and use_sim_time is true")]
        found += [(listener.topic, listener.problem()) for listener in self.listeners]
        missing = any(problem for _, problem in found)
        if missing and time.monotonic() < self._until:
            return
        for name, problem in sorted(found, key=lambda entry: entry[0]):
            print(f"{name}: {problem or 'ok'}", flush=True)
        raise SystemExit(int(missing))


def main(args: list[str] | None = None) -> None:
    """Run the node until it is stopped."""
    words = sys.argv if args is None else args
    parser = argparse.ArgumentParser(prog="explorer_node", description="Exploration with Nav2.")
    parser.add_argument("--check", action="store_true", help="only say which topics are missing")
    given = parser.parse_args(remove_ros_args(words)[1:])
    run(lambda: ExplorerNode(given.check), words, lambda node: None)


if __name__ == "__main__":
    main()
