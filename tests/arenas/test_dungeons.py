"""Dungeons as the field draws them: rooms, corridors of one coarse cell, three grey values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from marl_explore import ArenaConfig, ExplorationEnv, load_map
from marl_explore.arenas import fit
from marl_explore.arenas.components import largest_component
from marl_explore.arenas.dungeons import FREE, START, WALL, draw_dungeon, write_dungeons
from marl_explore.cli import maps
from tests.helpers.drawing import cells

READING = "resolution=0.0625&free=195-255&occupied=0-127&start_value=203"


@pytest.mark.parametrize("size", [(30, 40), (8, 11), (5, 5)])
def test_dungeons_are_connected_and_walled_in(size):
    shares = []
    for seed in range(30):
        drawn = draw_dungeon(seed, *size)
        assert drawn.shape == size
        assert (drawn == START).sum() == 1
        free = torch.from_numpy(drawn != WALL)
        assert largest_component(free[None])[0].equal(free)
        for edge in (drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]):
            assert (edge == WALL).all()
        shares.append((drawn == FREE).mean())
    assert len(set(shares)) > 1 or size == (5, 5)
    if size == (30, 40):
        assert 0.15 < np.mean(shares) < 0.3


def test_corridors_are_one_coarse_cell_wide():
    """Free cells between two walls, which no cell of a room of 3 x 3 is."""
    for seed in range(10):
        free = draw_dungeon(seed) != WALL
        inner = free[1:-1, 1:-1]
        beside_rows = ~free[:-2, 1:-1] & ~free[2:, 1:-1]
        beside_columns = ~free[1:-1, :-2] & ~free[1:-1, 2:]
        assert (inner & (beside_rows | beside_columns)).sum() > 5


def test_the_same_seed_is_the_same_dungeon():
    assert np.array_equal(draw_dungeon(3), draw_dungeon(3))
    assert not np.array_equal(draw_dungeon(3), draw_dungeon(4))


def test_images_have_the_format_of_the_field(tmp_path):
    paths = write_dungeons(tmp_path / "new" / "drawn", 2, seed=7)
    assert [path.name for path in paths] == ["dungeon_7.png", "dungeon_8.png"]
    image = Image.open(paths[0])
    assert image.size == (640, 480)
    grey = np.asarray(image.convert("L"))
    assert np.unique(grey).tolist() == [127, 195, 203]
    coarse = grey.reshape(30, 16, 40, 16)
    assert (coarse == coarse[:, :1, :, :1]).all()
    drawn = draw_dungeon(7)
    assert np.array_equal(coarse[:, 0, :, 0], np.array([127, 195, 203])[drawn])


def test_robots_can_pass_each_other_in_corridors_read_at_half_a_coarse_cell(tmp_path):
    (path,) = write_dungeons(tmp_path, 1, seed=2)
    reading = {"resolution": 0.0625, "free": "195-255", "start_value": 203}
    wall = draw_dungeon(2) == WALL
    assert np.array_equal(load_map(path, **reading).numpy(), wall.repeat(2, 0).repeat(2, 1))
    name = f"{tmp_path}?{READING}"
    env = ExplorationEnv(fit(ArenaConfig(), name), 3, arenas=name)
    for places in env.reset()["agents", "position"]:
        starts = np.argwhere((draw_dungeon(2) == START).repeat(2, 0).repeat(2, 1)).tolist()
        assert cells(places) == set(map(tuple, starts))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"number": 0}, "number=0 is not allowed"),
        ({"rows": 4}, "rows=4 is not allowed: it must be an integer of at least 5"),
        ({"columns": 2}, "columns=2 is not allowed"),
        ({"pixels": 0}, "pixels=0 is not allowed"),
        ({"seed": -1}, "seed=-1 is not allowed"),
    ],
)
def test_what_cannot_be_drawn_is_refused(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        write_dungeons(tmp_path / "new", **{"number": 1} | options)
    assert not (tmp_path / "new").exists()


def test_the_command_draws_and_says_how_to_read(tmp_path, capsys):
    words = ["draw", str(tmp_path), "--number", "2", "--rows", "6", "--columns", "8"]
    maps.run(maps.parse([*words, "--pixels", "8"]))
    said = capsys.readouterr().out
    name = said.split('"')[1]
    assert name == f"{tmp_path}?resolution=0.125&free=195-255&start_value=203"
    env = ExplorationEnv(fit(ArenaConfig(), name), 2, arenas=name)
    assert env.reset()["obstacles"].shape == (2, 12, 16)
