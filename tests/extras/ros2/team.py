"""Processes as a launch file has them, and a node that watches them from outside."""

from __future__ import annotations

import signal
import subprocess
import time
from collections import defaultdict
from functools import partial
from xml.etree import ElementTree

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import UInt8MultiArray, UInt32

from marl_explore.config.constants import UNKNOWN
from marl_explore.robot.messages import Done, Share
from marl_explore.ros2 import convert
from marl_explore.ros2.node import LATEST, LETTERS
from tests.extras.ros2.explorers import without_torch

MOST_SECONDS = 240  # of waiting for something that has to come


class Team:
    """The processes of a launch file; they end with the ``with`` statement.

    Args:
        workspace: where the package is built.
        arguments: of the launch file.
        given: more parameters by program.
        words: more words by namespace.
        folder: for what they print.
    """

    def __init__(self, workspace, arguments, given, folder, words=None, names=None):
        self.workspace, self.folder, self.given, self.words = workspace, folder, given, words or {}
        self.arguments = {"config": str(workspace.share / "config"), **arguments}
        nodes = ElementTree.parse(workspace.share / "launch" / "lab.launch.xml").iter("node")
        self.nodes = {node.get("namespace", "lab"): node for node in nodes}
        self.names = names or list(self.nodes)
        self.processes = {}

    def __enter__(self):
        for name in self.names:
            self.start(name)
        return self

    def __exit__(self, *_):
        for process in self.processes.values():
            process.send_signal(signal.SIGINT)
        try:
            codes = {name: process.wait(30) for name, process in self.processes.items()}
        finally:
            for process in self.processes.values():
                process.kill()
        self.codes = codes

    def start(self, name):
        node = self.nodes[name]
        words = ["-r", f"__ns:=/{node.get('namespace', '')}"]
        for param in node.iter("param"):
            if param.get("from"):
                words += ["--params-file", self._text(param.get("from"))]
            else:
                words += ["-p", f"{param.get('name')}:={self._text(param.get('value'))}"]
        for parameter, value in self.given.get(node.get("exec"), {}).items():
            words += ["-p", f"{parameter}:={value}"]
        program = self.workspace.install / "lib" / "marl_explore_ros2" / node.get("exec")
        environment = self.workspace.environment()
        if node.get("exec") == "robot_node":
            blocked = without_torch(self.folder / "without")
            environment["PYTHONPATH"] = f"{blocked}:{environment['PYTHONPATH']}"
        with (self.folder / f"{name}.log").open("a") as log:
            self.processes[name] = subprocess.Popen(
                [program, *self.words.get(name, []), "--ros-args", *words],
                env=environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def kill(self, name):
        self.processes[name].kill()
        self.processes.pop(name).wait()

    def said(self):
        return "\n".join(f"{p.name}: {p.read_text()[-2000:]}" for p in self.folder.glob("*.log"))

    def _text(self, text):
        for name, value in self.arguments.items():
            text = text.replace(f"$(var {name})", value)
        assert "$(" not in text, text
        return text


class Watcher(Node):
    """Hears the robots' letters and maps, and what the lab says of the truth."""

    def __init__(self, team, robots=4):
        super().__init__("watcher")
        self.team = team
        self.ticks = dict.fromkeys(range(robots), -1)
        """Of the last ``Done`` of each robot."""
        self.heard = dict.fromkeys(range(robots), -1)
        """Latest tick of all that each robot said."""
        self.shares, self.maps, self.poses = [], {}, defaultdict(list)
        self.has_news = False
        """Whether a shared map knew what its receiver did not."""
        self.truth = self.contacts = None
        self.broken = 0
        """Letters that are none."""
        for robot in range(robots):
            name = f"/robot_{robot}"
            self._hear(UInt8MultiArray, f"{name}/inbox", partial(self._letter, robot), LETTERS)
            self._hear(OccupancyGrid, f"{name}/map", partial(self._map, robot), LATEST)
            self._hear(
                PoseStamped, f"{name}/pose", partial(self._pose, robot), qos_profile_sensor_data
            )
        self._hear(OccupancyGrid, "/lab_sim/map", self._truth, LATEST)
        self._hear(UInt32, "/lab_sim/contacts", self._contacts, LATEST)

    def _hear(self, kind, topic, take, qos):
        self.create_subscription(kind, topic, take, qos)

    def _letter(self, receiver, message):
        try:
            envelope = convert.to_letter(message, receiver)
        except ValueError:
            self.broken += 1
            return
        sender = envelope.sender
        self.heard[sender] = max(self.heard[sender], envelope.message.tick)
        if isinstance(envelope.message, Done):
            self.ticks[sender] = envelope.message.tick
        elif isinstance(envelope.message, Share):
            self.shares.append(envelope)
            self.has_news |= receiver in self.maps and not self.merged(envelope)

    def _map(self, robot, message):
        self.maps[robot] = convert.to_grid(message)

    def _pose(self, robot, message):
        self.poses[robot].append(convert.to_pose(message, robot))

    def _truth(self, message):
        self.truth = convert.to_grid(message)

    def _contacts(self, message):
        self.contacts = message.data

    def until(self, happened):
        """Wait for something; what is awaited comes or the test fails."""
        end = time.monotonic() + MOST_SECONDS
        while not happened():
            rclpy.spin_once(self, timeout_sec=0.1)
            dead = [n for n, process in self.team.processes.items() if process.poll() is not None]
            assert not dead, f"{dead} ended:\n{self.team.said()}"
            assert time.monotonic() < end, f"ticks {self.ticks}\n{self.team.said()}"

    def merged(self, envelope):
        """Whether all that a shared map knows is known to who received it."""
        (receiver,) = envelope.to
        known = envelope.message.map != UNKNOWN
        return receiver in self.maps and (self.maps[receiver][known] != UNKNOWN).all()

    def wrong_cells(self):
        """Known cells of all maps that contradict the arena."""
        return sum(
            int(((grid != UNKNOWN) & (grid != self.truth)).sum()) for grid in self.maps.values()
        )
