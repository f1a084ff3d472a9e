"""FPR and NET on an environment of somebody else: PettingZoo's Pursuit."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from recipes import foreign_maps as recipe
from tests.helpers import oracle

pytestmark = pytest.mark.filterwarnings(
    "ignore:PettingZoo in TorchRL is tested using:UserWarning",
    "ignore::DeprecationWarning",  # of pygame
)


@pytest.fixture(scope="module")
def env():
    torch.manual_seed(0)
    return recipe.pursuit_env(seed=3)


def test_its_specs_hold(env):
    check_env_specs(env)


def test_maps_are_what_the_pursuers_saw(env):
    rollout = env.rollout(12)
    team = rollout["next", "pursuers"]
    inner = env.base_env._env.unwrapped.env
    truth = torch.from_numpy(inner.map_matrix).T.abs().to(torch.int8)
    assert truth.any()
    visited = torch.cat((rollout["pursuers", "position"][:1], team["position"]))
    row, column = torch.meshgrid(torch.arange(16), torch.arange(16), indexing="ij")
    cells = torch.stack((row, column))
    near = (cells - visited[..., None, None]).abs().amax(-3) <= 3  # steps + 1, pursuers, H, W
    seen = near.cummax(0).values[1:]
    assert torch.equal(team["map"] != -1, seen)
    assert torch.equal(team["map"], torch.where(seen, truth, -1).to(torch.int8))


def test_features_are_those_of_the_maps(env):
    team = env.rollout(8)[-1]["next", "pursuers"]
    for robot in range(8):
        place = tuple(team["position"][robot].tolist())
        expected = oracle.feature_table(team["map"][robot].tolist(), place, None)
        torch.testing.assert_close(team["fpr"][robot], torch.tensor(expected))
    far = torch.cdist(team["position"].double(), team["position"].double()) > recipe.RANGE_CELLS
    assert torch.equal(team["net"] == 0, far)


def test_it_prints_a_table():
    command = [sys.executable, recipe.__file__, "pursuit", "--steps", "5"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    assert [row[0] for row in rows if row[0].isdigit()] == [*"01234567"]
