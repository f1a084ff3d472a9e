"""A colcon workspace with the package built in it, and a domain of DDS on loopback."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
DOMAINS = 100


def own_domain():
    """A domain of DDS that no other run of these tests on this machine has."""
    for number in range(DOMAINS):
        domain = 1 + (os.getpid() + number) % DOMAINS
        path = Path(tempfile.gettempdir()) / f"marl_explore_domain_{domain}.lock"
        lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
        else:
            return domain  # the lock lasts as long as this process
    raise RuntimeError(f"all {DOMAINS} domains of DDS are in use")


os.environ |= {
    # other teams on this machine are not heard
    "ROS_DOMAIN_ID": str(own_domain()),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
}


class Workspace:
    """A copy of the package and its tests, and what colcon makes of it.

    Args:
        folder: an empty folder.
    """

    def __init__(self, folder):
        self.folder = folder
        built = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info", ".*")
        for name in ("marl_explore", "tests"):
            shutil.copytree(ROOT / name, folder / "src" / name, ignore=built)
        self.package = folder / "src" / "marl_explore" / "ros2"
        self.install = folder / "install" / "marl_explore_ros2"
        self.share = self.install / "share" / "marl_explore_ros2"

    def run(self, *command, **options):
        """Run a program of this environment in the workspace; its output."""
        done = subprocess.run(
            [str(Path(sys.executable).with_name(command[0])), *map(str, command[1:])],
            cwd=self.folder,
            env=self.environment(),
            capture_output=True,
            text=True,
            **options,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def environment(self):
        """As after sourcing the workspace's set-up."""
        (packages,) = (*self.install.glob("lib/python3*/site-packages"), "")[:1]
        own = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
        return {**os.environ, **own, "PYTHONPATH": str(packages)}


@pytest.fixture(scope="session")
def workspace(tmp_path_factory):
    made = Workspace(tmp_path_factory.mktemp("workspace"))
    made.run("colcon", "build", "--paths", made.package)
    return made
