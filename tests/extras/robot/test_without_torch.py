"""Robots run where numpy is all there is: an environment that holds nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
CODE = """
import importlib.util, math, sys
for name in ("torch", "tensordict", "torchrl", "scipy"):
    assert importlib.util.find_spec(name) is None, name
import numpy as np
from marl_explore import ArenaConfig
import marl_explore.ros2.convert, marl_explore.ros2.parameters
from marl_explore.robot import BarrierClock, ExportedPolicy, Pose, RobotCore, Scan
policy = ExportedPolicy(sys.argv[1], robot=0)
core = RobotCore(0, ArenaConfig(num_agents=2), policy, BarrierClock(range(2)), fpr=policy.fpr)
core.advance(0.0)
core.receive(Pose(1.0, 0, 0.25, 0.25, 0.0), 1.0)
core.receive(Scan(1.0, np.full(360, np.inf)), 1.0)
core.advance(1.0)
assert core.knowledge.known == 9 and (core.knowledge.map != 1).all()
assert core.observation.action_mask[core.action]
print(core.observation.fpr[:, 0].sum(), core.action)
"""

EXPLORES = """
import importlib.util
for name in ("torch", "tensordict", "torchrl", "scipy"):
    assert importlib.util.find_spec(name) is None, name
import numpy as np
import marl_explore.ros2.displays, marl_explore.ros2.explorer_parameters
from marl_explore.robot.explorer import ExplorerCore, OccupancyMap, Place
percent = np.zeros((60, 60), np.int8)
percent[:, -1] = 100
core = ExplorerCore()
core.take_map(OccupancyMap(percent, 0.05, Place(0.0, 0.0)))
core.take_place(Place(1.0, 1.0))
output = core.advance(1.0)
print(output.status.state, output.goal.x < 2.8)
"""


@pytest.fixture(scope="module")
def bare_python(tmp_path_factory):
    """An interpreter with numpy and nothing else."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", "numpy"], check=True)
    return python


@pytest.mark.parametrize("network", ["mlp", "goals"])
def test_a_robot_decides_without_torch(bare_python, tmp_path, network):
    from marl_explore import ArenaConfig
    from marl_explore.policies.export import export_npz
    from marl_explore.policies.policy import Policy, PolicyConfig
    from tests.helpers.configs import NETWORKS

    spec = PolicyConfig(ArenaConfig(num_agents=2), NETWORKS[network], "proximity")
    path = export_npz(Policy(spec, spec.make_actors()), tmp_path / "policy.npz")
    done = subprocess.run(
        [bare_python, "-c", CODE, path],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    share, action = done.stdout.split()
    assert float(share) == 1
    assert 0 <= int(action) <= 9
    assert sys.version_info >= (3, 10)


def test_an_explorer_chooses_a_goal_without_torch(bare_python):
    done = subprocess.run(
        [bare_python, "-c", EXPLORES],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == ["exploring", "True"], done.stderr
