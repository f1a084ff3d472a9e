"""Robots in the simulated lab: they do what the grid says, and touch nothing."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from vmas.simulator.environment import Environment

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.lab import LabRunner, Noise
from marl_explore.lab.scenario import LabScenario
from marl_explore.policies.io import save_policy
from tests.helpers.boards import ACTIONS, arena
from tests.helpers.goal_policies import goal_policy
from tests.helpers.robot_world import scan_of, scripted
from tests.policies.test_policies import a_policy

ROOT = Path(__file__).parents[3]


class Wanderer:
    """Takes random allowed actions."""

    def __init__(self, seed):
        self.chance = np.random.default_rng(seed)

    def __call__(self, observation):
        return int(self.chance.choice(observation.action_mask.nonzero()[0]))


def arenas(number, config=None):
    start = ExplorationEnv(config or ArenaConfig(), number, stream="test").reset()
    return start["obstacles"], start["agents", "position"]


def lab_of(board, scripts, **options):
    obstacles, cells = arena(board)
    config = ArenaConfig(*obstacles.shape, 0.0, num_agents=len(cells))
    names = [[ACTIONS.index(name) for name in script.split()] for script in scripts]
    layout = obstacles.unsqueeze(0), cells.unsqueeze(0)
    return LabRunner(lambda _, robot: scripted(names[robot]), layout, config=config, **options)


def test_robots_drive_where_they_are_sent_and_merge_their_maps():
    lab = lab_of("......\n.0..1.\n......\n......", ["S NE talk", "SW stay talk"])
    record = lab.run(4)
    assert record.cells[0, :, 0].tolist() == [[1, 1], [2, 1], [1, 2], [1, 2], [1, 2]]
    assert record.cells[0, :, 1].tolist() == [[1, 4], [2, 3], [2, 3], [2, 3], [2, 3]]
    assert record.actions[0, :3].tolist() == [[4, 5], [1, 8], [9, 9]]
    union = (record.maps[0, 2] >= 0).any(0).sum()
    assert (record.maps[0, 3] >= 0).sum((-1, -2)).tolist() == [union, union]
    assert 2 * 20 < record.sent_bytes["share"] < 2 * 100


def test_the_lidar_measures_what_beams_through_the_grid_do():
    obstacles, cells = arena("..#...\n.0..1.\n...#..\n#.....")
    config = ArenaConfig(4, 6, 0.0, num_agents=2)
    headings = torch.tensor([[0.4, -2.0]])
    layout = {"obstacles": obstacles.unsqueeze(0), "positions": cells.unsqueeze(0)}
    env = Environment(LabScenario(), 1, "cpu", seed=0, config=config, headings=headings, **layout)
    lab = lab_of("..#...\n.0..1.\n...#..\n#.....", ["stay", "stay"])
    lab.world._vmas = env
    lab._tell_poses()
    for robot, core in enumerate(lab.teams[0]):
        others = core.sensors.others()
        expected = scan_of(obstacles.numpy(), core.frame, core.sensors.pose, others).ranges
        measured = env.agents[robot].sensors[0].measure()[0].numpy()
        same = np.abs(measured - np.minimum(expected, 3.5)) < 1e-3
        assert same.mean() > 0.98  # rays along a corner may go either way


def test_a_wandering_team_agrees_with_the_grid():
    lab = LabRunner(lambda row, robot: Wanderer([row, robot]), arenas(3))
    record = lab.run(15)
    summary = record.summary()
    assert summary["agreement"] >= 0.98
    assert summary["robot contacts"] == summary["obstacle contacts"] == 0
    assert summary["wrong cells"] == 0
    assert summary["known cells"] > 3 * 4 * 20
    best, merged = record.coverage().values()
    assert best.shape == merged.shape == (3, 16)
    assert (best <= merged).all()
    assert (best.diff() >= 0).all()


def test_noise_is_measured_and_survived():
    noise = Noise(range_share=0.02, position=0.01, heading=math.radians(1))
    lab = LabRunner(lambda row, robot: Wanderer([row, robot]), arenas(2), noise, seed=1)
    summary = lab.run(8).summary()
    assert summary["robot contacts"] == summary["obstacle contacts"] == 0
    assert summary["wrong cells"] <= 0.01 * summary["known cells"]
    pose = lab.teams[0][0].sensors.pose
    assert not np.allclose((pose.x, pose.y), lab.world.poses()[0, 0, :2], atol=1e-5)


def test_layouts_may_have_different_numbers_of_obstacles():
    layouts = [arena(board) for board in ("0.#\n..#\n...", "0..\n...\n..#")]
    obstacles, cells = (torch.stack(parts) for parts in zip(*layouts, strict=True))
    config = ArenaConfig(3, 3, 0.0, num_agents=1)
    lab = LabRunner(lambda *_: scripted([3]), (obstacles, cells), config=config)
    record = lab.run(1)
    assert record.cells[:, 1, 0].tolist() == [[1, 1], [1, 1]]
    assert record.wrong_cells() == 0
    assert (record.maps[1, 1, 0] == 1).sum() == 1


def test_a_robot_that_drives_into_another_is_counted():
    lab = lab_of("0.1", ["stay", "stay"])
    lab.world._vmas.agents[0].set_pos(torch.tensor([0.4, 0.0]), batch_index=0)
    lab.world.count_contacts()
    lab.world.count_contacts()  # still the same contact
    assert lab.world.contacts == {"robots": 1, "obstacles": 0}


def colour_of(picture, config, x, y):
    """Of the point (x, y) in metres."""
    pixels_per_metre = picture.shape[0] / (config.height * config.cell_size)
    row = picture.shape[0] / 2 - y * pixels_per_metre
    return picture[int(row), int(picture.shape[1] / 2 + x * pixels_per_metre)].tolist()


def test_a_picture_shows_boxes_and_robots_without_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    world = lab_of("#...\n.0..\n...1", ["stay", "stay"]).world
    picture = world.render()
    assert picture.shape == (450, 600, 3)
    colours = {
        name: colour_of(picture, world.config, x, y)
        for name, (x, y) in {
            "box": (-0.75, 0.5),
            "robot 0": (-0.25, 0.0),
            "robot 1": (0.75, -0.5),
            "floor": (0.25, 0.0),
            "rim": (0.97, 0.72),
        }.items()
    }
    assert colours["floor"] == colours["rim"] == [255, 255, 255]
    assert max(colours["box"]) - min(colours["box"]) <= 2
    assert colours["box"][0] < 128
    for robot in ("robot 0", "robot 1"):
        red, green, blue = colours[robot]
        assert blue > max(red, green)
    world.drive(torch.tensor([[[0.2, 0.0], [0.0, 0.0]]]))
    assert (world.render() != picture).any()


def test_a_team_that_chooses_among_goals_explores_as_on_the_grid():
    """The actor was trained for another team."""
    config = ArenaConfig(height=9, width=9, num_agents=3, occlusion=True)
    lab = LabRunner(goal_policy(strength=0.1), arenas(2, config), config=config)
    summary = lab.run(25).summary()
    assert summary["merged map at the end"] > 0.95
    assert summary["agreement"] >= 0.98
    assert summary["robot contacts"] == summary["obstacle contacts"] == 0


def test_a_policy_for_another_field_of_view_is_refused():
    with pytest.raises(ValueError, match="trained for fov_radius=2"):
        LabRunner(a_policy(sensing_range=2.0), arenas(1), config=ArenaConfig())


def test_a_policy_for_any_sensor_has_that_of_the_lab():
    runner = LabRunner(goal_policy(sensing_range=2.0), arenas(1), config=ArenaConfig())
    assert runner.run(2).actions.shape == (1, 2, 4)


def test_layouts_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"\(12, 12\) cells and 4 robots"):
        LabRunner(lambda *_: scripted([]), arenas(1, ArenaConfig(height=6)))


def test_the_recipe_draws_the_papers_figure(tmp_path):
    path = save_policy(a_policy(), tmp_path / "team.safetensors")
    command = [sys.executable, ROOT / "recipes" / "lab.py", path, "--layouts", "2", "--steps", "3"]
    command += ["--picture", "True"]
    done = subprocess.run(
        [*command, "--out", tmp_path / "lab"], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "lab" / "lab.png").is_file()
    assert (tmp_path / "lab" / "explored.png").is_file()
    assert (tmp_path / "lab" / "arena.png").is_file()
    content = json.loads((tmp_path / "lab" / "lab.json").read_text())
    assert content["summary"]["wrong cells"] == 0
    assert len(content["mean coverage"]["merged"]) == 4


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["range_share", "position", "heading"])
def test_noise_that_is_none_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}={value} is not allowed: .*(at least 0|not NaN)"):
        Noise(**{name: value})
