"""Recordings: what was written is read back, and a robot that lives through one knows the same."""

from __future__ import annotations

import random
import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.config.constants import COMMUNICATE
from marl_explore.robot import BarrierClock, Envelope, Pose, RobotCore, Scan
from marl_explore.robot.driving import Velocity
from marl_explore.robot.geometry import Mount
from marl_explore.robot.messages import Done
from marl_explore.ros2 import convert, recordings
from marl_explore.ros2.recordings import CHECKSUMS, Recorder, messages, replay_recording
from tests.helpers.robot_world import PATIENT, World

TEAM = [f"robot_{number}" for number in range(4)]
TICKS = 15


class Talker:
    """Communicates every third time if it may, and else takes a random allowed action."""

    def __init__(self, seed):
        self.chance, self.asked = np.random.default_rng(seed), 0

    def __call__(self, observation):
        self.asked += 1
        if self.asked % 3 == 0 and observation.action_mask[COMMUNICATE]:
            return COMMUNICATE
        return int(self.chance.choice(observation.action_mask.nonzero()[0]))


class Recorded:
    """A robot whose life is written down."""

    def __init__(self, core, recorder):
        self.core, self.recorder = core, recorder

    def __getattr__(self, name):
        return getattr(self.core, name)

    def receive(self, event, now):
        self.recorder.receive(self.core.robot, event, now)
        self.core.receive(event, now)

    def advance(self, now):
        output = self.core.advance(now)
        self.recorder.answer(self.core.robot, output.velocity, now)
        return output


@pytest.fixture(scope="module")
def team(tmp_path_factory):
    """A recording of a team, and its robots at the end."""
    path, config = tmp_path_factory.mktemp("recorded") / "life", ArenaConfig()
    start = ExplorationEnv(config, stream="test").reset()
    obstacles, cells = start["obstacles"][0].numpy(), start["agents", "position"][0].tolist()
    policies = [Talker(robot) for robot in range(4)]
    world = World(config, obstacles, cells, policies, settings=PATIENT)
    with Recorder(path, TEAM) as recorder:
        world.cores = [Recorded(core, recorder) for core in world.cores]
        world.run(TICKS)
    return path, [core.core for core in world.cores]


def reborn(robot, seed):
    clock = BarrierClock(range(4))
    return RobotCore(robot, ArenaConfig(), Talker(seed), clock, settings=PATIENT)


@pytest.mark.parametrize("robot", range(4))
def test_a_robot_that_lives_through_it_again_knows_the_same(team, robot):
    recording, cores = team
    again = reborn(robot, seed=robot)
    assert replay_recording(recording, again, TEAM) > 50 * TICKS
    then = cores[robot]
    assert np.array_equal(again.knowledge.map, then.knowledge.map)
    assert (again.tick, again.action) == (then.tick, then.action)
    assert np.array_equal(again.knowledge.unshared, then.knowledge.unshared)
    assert again.mail.sent_bytes == then.mail.sent_bytes
    assert then.knowledge.known > 30


def test_the_team_exchanged_maps(team):
    """Else the replays above would not show that letters are recorded."""
    assert sum(core.mail.sent["share"] for core in team[1]) > 0


def test_another_policy_acts_otherwise(team):
    recording, cores = team
    other = reborn(0, seed=99)
    replay_recording(recording, other, TEAM)
    assert other.mail.sent_bytes != cores[0].mail.sent_bytes


def test_what_was_written_is_read_back_in_its_order(tmp_path):
    scan = Scan(1.25, np.array([0.5, np.inf, 0.0]), range_max=2.0)
    with Recorder(tmp_path / "bag", ["a", "b"]) as recorder:
        recorder.receive(1, scan, 1.5)
        recorder.receive(1, Pose(1.5, 1, 0.25, -0.5, 1.0), 1.5)
        recorder.receive(1, Pose(1.5, 0, 9.0, 9.0, 1.0), 1.5)  # robot 0's is recorded by itself
        recorder.receive(0, Envelope(1, (0,), Done(1, 7)), 1.5)
        recorder.answer(1, Velocity(0.125, -1.0), 1.5)
    (t0, s0, first), (t1, _, second), (t2, _, third), (t3, s3, fourth) = messages(tmp_path / "bag")
    assert [t0, t1, t2, t3] == ["/b/scan", "/b/pose", "/a/inbox", "/b/cmd_vel"]
    assert s0 <= s3 == pytest.approx(1.5, abs=1e-8)
    back = convert.to_scan(first)
    assert np.array_equal(back.ranges, scan.ranges)
    assert (back.stamp, back.range_max) == (1.25, 2.0)
    pose = convert.to_pose(second, 1)
    assert (pose.x, pose.y, pose.yaw) == (0.25, -0.5, pytest.approx(1.0))
    assert convert.to_letter(third, 0) == Envelope(1, (0,), Done(1, 7))
    assert convert.to_velocity(fourth) == (0.125, -1.0)
    assert convert.to_seconds(fourth.header.stamp) == 1.5


def test_it_is_an_mcap_file_of_standard_messages(team):
    files = {file.suffix or file.name for file in team[0].iterdir()}
    assert files == {".yaml", ".mcap", CHECKSUMS}
    with Reader(team[0]) as reader:
        kinds = {connection.msgtype for connection in reader.connections}
    assert kinds == {
        "sensor_msgs/msg/LaserScan",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/TwistStamped",
        "std_msgs/msg/UInt8MultiArray",
    }


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a recording"):
        list(messages(tmp_path))
    with Recorder(tmp_path / "bag", TEAM) as recorder:
        recorder.receive(0, Pose(0.0, 0, 0.0, 0.0, 0.0), 0.0)
    with pytest.raises(ValueError, match="no /robot_0/cmd_vel"):
        replay_recording(tmp_path / "bag", reborn(0, seed=0), TEAM)


def test_poses_in_another_frame_are_dropped_as_by_the_node(tmp_path):
    with Recorder(tmp_path / "bag", TEAM, frame="odom") as recorder:
        recorder.receive(0, Pose(1.0, 0, 0.0, 0.0, 0.0), 1.0)
        recorder.answer(0, Velocity(0.0, 0.0), 1.0)
    for frame, known in (("arena", False), ("odom", True)):
        core = reborn(0, seed=0)
        assert replay_recording(tmp_path / "bag", core, TEAM, frame) == 1
        assert (core.sensors.pose is not None) is known


def test_topics_of_others_do_not_matter(tmp_path):
    """Such as a SLAM's pose beside the robots'."""
    kind, types = "std_msgs/msg/UInt8MultiArray", recordings._TYPES
    with Recorder(tmp_path / "bag", TEAM) as recorder:
        recorder.answer(0, Velocity(0.0, 0.0), 1.0)
        connection = recorder._writer.add_connection("/pose", kind, typestore=types)
        data = types.serialize_cdr(recordings._message(kind, {}), kind)
        recorder._writer.write(connection, 1, data)
    assert replay_recording(tmp_path / "bag", reborn(0, seed=0), TEAM) == 1


def test_topics_with_other_messages_are_named(tmp_path):
    topic, kind, types = "/robot_0/pose", "std_msgs/msg/UInt8MultiArray", recordings._TYPES
    with Writer(tmp_path / "other", version=9) as writer:
        connection = writer.add_connection(topic, kind, typestore=types)
        writer.write(connection, 1, types.serialize_cdr(recordings._message(kind, {}), kind))
    with pytest.raises(ValueError, match="other cannot be replayed: /robot_0/pose has std_msgs"):
        replay_recording(tmp_path / "other", reborn(0, seed=0), TEAM)


def test_recordings_that_cannot_be_read_are_named(team, tmp_path):
    path, _ = team
    whole = {file.name: file.read_bytes() for file in path.iterdir()}
    draw, refused, copy = random.Random(0), 0, tmp_path / "copy"
    copy.mkdir()
    for _ in range(60):
        for name, content in whole.items():
            (copy / name).write_bytes(content)
        name = draw.choice([*whole])
        damaged = bytearray(whole[name])
        if draw.random() < 0.3:
            del damaged[draw.randrange(len(damaged)) :]
        else:
            damaged[draw.randrange(len(damaged))] ^= 1 << draw.randrange(8)
        (copy / name).write_bytes(damaged)
        try:
            for _ in messages(copy):
                pass
        except ValueError as error:
            refused += str(copy) in str(error)
    assert refused == 60


def test_files_of_ros_that_lost_messages_are_named(team, tmp_path):
    """They have no checksums of ours, and zeros are read as nothing."""
    path, _ = team
    copy = tmp_path / "zeros"
    shutil.copytree(path, copy)
    (copy / CHECKSUMS).unlink()
    (file,) = copy.glob("*.mcap")
    assert sum(1 for _ in messages(copy)) > 100
    damaged = bytearray(file.read_bytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 400] = bytes(400)
    file.write_bytes(damaged)
    with pytest.raises(ValueError, match=f"{copy} cannot be read as a recording"):
        list(messages(copy))


def test_an_error_of_the_robot_names_the_recording(tmp_path):
    """A plain Twist has no stamp: the time of its record counts, and that may be wrong."""
    kind, types = "geometry_msgs/msg/Twist", recordings._TYPES
    with Writer(tmp_path / "late", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/robot_0/cmd_vel", kind, typestore=types)
        writer.write(
            connection, 14 * 10**18, types.serialize_cdr(recordings._message(kind, {}), kind)
        )
    with pytest.raises(ValueError, match="late cannot be replayed: now="):
        replay_recording(tmp_path / "late", reborn(0, seed=0), TEAM)


def test_a_robot_that_read_its_lidar_from_tf_is_replayed_with_its_mount(tmp_path):
    mounts = []
    core = reborn(0, seed=0)
    core.receive = lambda event, now: mounts.append(event.mount)
    with Recorder(tmp_path / "turned", TEAM) as recorder:
        recorder.receive(0, Scan(1.0, np.ones(8)), 1.0)
        recorder.answer(0, Velocity(0.0, 0.0), 1.1)
    turned = Mount(0.1, 0.0, 1.5)
    assert replay_recording(tmp_path / "turned", core, TEAM, mount=turned) == 1
    assert mounts == [turned]
