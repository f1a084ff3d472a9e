"""From map files to pictures in one command."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from PIL import Image

from marl_explore import ArenaConfig, find_policy
from marl_explore.cli import explore
from tests.arenas.test_fitting import two_rooms


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "maps"
    folder.mkdir()
    (folder / "hall.txt").write_text("........\n.##..#..\n......#.\n")
    plan = np.where(two_rooms(door=14, side=80), 0, 255).astype(np.uint8)
    Image.fromarray(plan).save(folder / "plan.png")
    return folder


def explored(capsys, *words):
    explore.run(explore.parse([*map(str, words)]))
    return capsys.readouterr().out


def test_every_map_of_a_folder_is_explored_and_drawn(folder, tmp_path, capsys):
    out = tmp_path / "out"
    said = explored(capsys, folder, "--robots", 2, "--policy", "nearest-timer", "--out", out)
    assert "hall.txt: a pixel is a cell of 0.5 m" in said
    assert "plan.png: pixels of 0.05 m, cells of 0." in said
    assert "warning" not in said
    rows = list(csv.DictReader((out / "results.csv").read_text().splitlines()))
    assert [row["map"] for row in rows] == ["hall.txt", "plan.png"]
    assert [float(row["coverage"]) for row in rows] == [1, 1]
    assert rows[0]["cells"] == "3 x 8"
    for name in ("hall", "plan"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert '"name":"nearest-timer"' in (out / f"{name}.html").read_text()


def test_cells_that_close_doors_are_warned_of_with_cells_that_fit(folder, tmp_path, capsys):
    words = ("--cell-size", 1.3, "--policy", "nearest", "--robots", 1, "--out", tmp_path / "out")
    said = explored(capsys, folder / "plan.png", *words)
    assert "% of the area of plan.png is cut off from the rest; --cell-size 0." in said


def test_walls_that_vanish_are_warned_of(tmp_path, capsys):
    plan = np.where(two_rooms(door=0, side=80), 0, 255).astype(np.uint8)
    Image.fromarray(plan).save(tmp_path / "plan.png")
    words = ("--cell-size", 0.5, "--max-occupied", 0.3, "--policy", "nearest", "--robots", 1)
    said = explored(capsys, tmp_path / "plan.png", *words, "--out", tmp_path / "out")
    assert "lies behind walls that the reading opens" in said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere.png"], "maps='nowhere.png' is not allowed: it does not exist"),
        (["hall.txt", "--free", "1-2"], "hall.txt is not a plain image"),
        (["hall.txt", "--starts", "1;2"], "starts='1;2' is not allowed"),
        (["hall.txt", "--robots", "1", "--starts", "1,1"], "is an obstacle"),
        (["hall.txt", "--policy", "nobody"], "no policy 'nobody'"),
        (["hall.txt", "--policy", "paper-cnn-case1", "--robots", "3"], "num_agents=4"),
        (["hall.txt", "--robots", "90"], "num_agents=90"),
        (["plan.png", "--robot-radius", "9"], "fits nowhere"),
    ],
)
def test_what_cannot_be_explored_is_one_error_and_leaves_nothing(
    folder, tmp_path, monkeypatch, words, message
):
    monkeypatch.chdir(folder)
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=message):
        explore.run(explore.parse([*words, "--out", str(out)]))
    assert not out.exists()


@pytest.mark.parametrize(
    ("flag", "value", "message"),
    [
        ("--robots", "0", "robots=0"),
        ("--robot-radius", "-1", "robot_radius=-1.0"),
        ("--steps", "0", "steps=0"),
        ("--cell-size", "inf", "cell_size=inf"),
    ],
)
def test_settings_out_of_range_are_refused(flag, value, message):
    with pytest.raises(ValueError, match=f"^{message} is not allowed"):
        explore.parse(["hall.txt", flag, value])


def test_a_policy_that_does_not_fit_says_what_would():
    with pytest.raises(ValueError, match=r"sees 3 x 3 cells, .* from 0.5303 to below 0.8839 m"):
        find_policy("paper-mlp-case2", ArenaConfig(cell_size=0.25, sensing_range=5))
    find_policy("best", ArenaConfig(cell_size=0.25, sensing_range=5))
    for reach in (0.5304, 0.8838):
        find_policy("paper-mlp-case2", ArenaConfig(cell_size=0.25, sensing_range=reach))
