"""Explorer nodes as processes, and the simulated SLAM and Nav2 that they meet, as a node."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from functools import partial
from xml.etree import ElementTree

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock as SystemClock
from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from visualization_msgs.msg import MarkerArray

from marl_explore.ros2 import convert
from marl_explore.ros2.node import LATEST
from tests.helpers.slam import Rover

MOST_SECONDS = 150  # of waiting for something that has to come
NOT_ON_ROBOTS = ("torch", "tensordict", "torchrl", "scipy", "matplotlib", "tyro")


def without_torch(folder):
    """A path for Python on which torch and the like cannot be imported."""
    folder.mkdir(exist_ok=True)
    for name in NOT_ON_ROBOTS:
        (folder / f"{name}.py").write_text(f"raise ImportError('{name} is not on robots')\n")
    return str(folder)


class Explorers:
    """Processes of ``explorer_node``; they end with the ``with`` statement.

    Args:
        environment: of the processes.
        folder: for what they print, and for a path without torch.
    """

    def __init__(self, environment, folder):
        blocked = without_torch(folder / "without")
        self.environment = dict(environment)
        self.environment["PYTHONPATH"] = f"{blocked}:{environment.get('PYTHONPATH', '')}"
        self.folder, self.processes = folder, {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self.processes.values():
            process.send_signal(signal.SIGINT)
        try:
            self.codes = {name: process.wait(30) for name, process in self.processes.items()}
        finally:
            for process in self.processes.values():
                process.kill()

    def start(self, name, words, program=None):
        """Start one of a namespace (or of none), with words after ``--ros-args``."""
        program = program or [sys.executable, "-m", "marl_explore.ros2.explorer_node"]
        with (self.folder / f"{name or 'alone'}.log").open("a") as log:
            self.processes[name] = subprocess.Popen(
                [*program, "--ros-args", "-r", f"__ns:=/{name}", *words],
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def launch(self, workspace, file, given=()):
        """Start what a launch file lists, as it is installed."""
        for node in ElementTree.parse(workspace.share / "launch" / file).iter("node"):
            words = [word for text in given for word in ("-p", text)]
            for remap in node.iter("remap"):
                words += ["-r", f"{remap.get('from')}:={remap.get('to')}"]
            for param in node.iter("param"):
                if param.get("from"):
                    config = workspace.share / "config" / file.replace(".launch.xml", ".yaml")
                    assert param.get("from") == "$(var config)"
                    words = ["--params-file", str(config), *words]
            program = workspace.install / "lib" / node.get("pkg") / node.get("exec")
            self.start(node.get("namespace"), words, [str(program)])

    def said(self):
        return "\n".join(f"{p.name}: {p.read_text()[-2000:]}" for p in self.folder.glob("*.log"))


class Slam(Node):
    """Robots of a simulated world, with the topics of slam_toolbox and Nav2.

    Args:
        world: ``helpers.slam.World``.
        frames: of the robots' maps in the world, by namespace.
        volatile: namespaces whose maps are not latched, and whose poses are PoseStamped.
        speed: seconds of the world per second.
        together: whether nobody drives until every explorer has said something.
        has_clock: whether it publishes ``/clock``; otherwise stamps are of a clock of its own.
        rover: options of every ``Rover``.
        waits: seconds of the world by which explorers may be behind before it stands still: on a
            busy machine its time must not run away from them.
    """

    STEP = 0.25

    def __init__(
        self,
        world,
        frames,
        volatile=(),
        speed=8.0,
        together=True,
        has_clock=True,
        rover=None,
        waits=math.inf,
    ):
        super().__init__("slam_sim")
        self.world, self.time, self.has_clock = world, 1000.0, has_clock
        self.rovers, self._maps, self._poses = {}, {}, {}
        self.states, self.statuses, self.markers, self.volatile = {}, {}, {}, volatile
        for number, (name, frame) in enumerate(frames.items()):
            self.rovers[name] = Rover(world, world.starts[str(number + 1)], frame, **(rover or {}))
            top = f"/{name}/" if name else "/"
            latched = LATEST if name not in volatile else QoSProfile(depth=1)
            kind = PoseStamped if name in volatile else PoseWithCovarianceStamped
            self._maps[name] = self.create_publisher(OccupancyGrid, f"{top}map", latched)
            self._poses[name] = self.create_publisher(kind, f"{top}pose", 10)
            self._hear(PoseStamped, f"{top}goal_pose", partial(self._goal, name), 1)
            self._hear(DiagnosticArray, f"{top}explorer/status", partial(self._status, name), 1)
            self._hear(MarkerArray, f"{top}explorer/markers", partial(self._marker, name), LATEST)
        self.together, self.waits = together, waits
        self._heard = dict.fromkeys(frames, self.time)
        self.events = []  # (whether it is time, what happens then): between two steps of the world
        self._clock_topic = self.create_publisher(Clock, "/clock", 1)
        steady = SystemClock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(self.STEP / speed, self._step, clock=steady)
        self._steps, self.maps_sent = 0, 0

    def _hear(self, kind, topic, take, qos):
        self.create_subscription(kind, topic, take, qos)

    def _goal(self, name, message):
        self.rovers[name].send(convert.to_place(message))

    def _status(self, name, message):
        (status,) = message.status
        stamp = message.header.stamp
        self._heard[name] = stamp.sec + stamp.nanosec * 1e-9
        values = {entry.key: entry.value for entry in status.values}
        self.statuses[name] = status, values
        states = self.states.setdefault(name, [])
        if states[-1:] != [values["state"]]:
            states.append(values["state"])

    def _marker(self, name, message):
        self.markers[name] = {marker.ns: marker for marker in message.markers}

    def state(self, name):
        return self.states.get(name, [None])[-1]

    def _step(self):
        if self.time - min(self._heard.values()) <= self.waits:
            self._advance()
        if self.has_clock:  # also of a world that stands still: a node that has just come needs it
            stamp = convert.fill(Clock().clock, convert.time_fields(self.time))
            self._clock_topic.publish(Clock(clock=stamp))

    def _advance(self):
        for event in [event for event in self.events if event[0]()]:
            self.events.remove(event)
            event[1]()
        self.time += self.STEP
        self._steps += 1
        for name, rover in self.rovers.items():
            bodies = [other.at for mate, other in self.rovers.items() if mate != name]
            if not self.together or len(self.states) == len(self.rovers):
                rover.drive(self.STEP, self.time, bodies)
            if self._steps % 2 == 0:
                rover.scan(bodies)
                self._send_pose(name, rover.place)
            if self._steps % 8 == 4:
                self._send_map(name, rover.map())

    def _send_pose(self, name, place):
        fields = convert.place_fields(place, self.time, "map")
        if name in self.volatile:
            self._poses[name].publish(convert.fill(PoseStamped(), fields))
        else:
            fields["pose"] = {"pose": fields["pose"]}
            self._poses[name].publish(convert.fill(PoseWithCovarianceStamped(), fields))

    def _send_map(self, name, grid):
        self._maps[name].publish(map_message(grid, self.time))
        self.maps_sent += 1

    def until(self, happened, explorers, most=MOST_SECONDS):
        """Wait for something; what is awaited comes or the test fails."""
        end = time.monotonic() + most
        while not happened():
            rclpy.spin_once(self, timeout_sec=0.05)
            dead = [name for name, p in explorers.processes.items() if p.poll() is not None]
            assert not dead, f"{dead} ended:\n{explorers.said()}"
            assert time.monotonic() < end, f"{self.states} {self.statuses}\n{explorers.said()}"

    def explored(self):
        """Share of the world's floor that the robots have seen together."""
        rows, columns = (~self.world.wall).nonzero()
        side = self.world.resolution
        x, y = (columns + 0.5) * side, (rows + 0.5) * side
        seen = [rover.score[rover._cells(x, y)] < 0 for rover in self.rovers.values()]
        return np.any(seen, 0).mean()


def map_message(grid, stamp=0.0, frame_id="map"):
    """The OccupancyGrid of an ``OccupancyMap``."""
    height, width = grid.percent.shape
    x, y, yaw = grid.origin
    turned = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    fields = {
        "header": convert.header_fields(stamp, frame_id),
        "info": {
            "resolution": grid.resolution,
            "width": width,
            "height": height,
            "origin": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turned},
        },
        "data": np.ascontiguousarray(grid.percent).ravel(),
    }
    return convert.fill(OccupancyGrid(), fields)
