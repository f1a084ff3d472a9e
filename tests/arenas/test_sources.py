"""Map files as arenas by name: every map once, in order, padded, with starts as asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from marl_explore import ArenaConfig, ExplorationEnv, find_policy, make_env, record
from marl_explore.arenas import MapSource, default_config, default_steps, fit, in_order, is_source
from marl_explore.core.hashing import stream_seed
from tests.arenas.test_fitting import two_rooms
from tests.helpers.drawing import cells

SMALL = "0.#\n1..\n"
WIDE = ".....\n.0.1.\n"
TALL = "...\n.#.\n01.\n...\n"


@pytest.fixture
def folder(tmp_path):
    for name, drawing in {"b.txt": SMALL, "a.txt": WIDE, "c.txt": TALL, "note.md": "x"}.items():
        (tmp_path / name).write_text(drawing)
    return tmp_path


def test_a_folder_is_its_maps_in_the_order_of_their_names(folder):
    source = MapSource.parse(str(folder))
    assert [path.name for path in source.paths] == ["a.txt", "b.txt", "c.txt"]
    config = source.fit(ArenaConfig(num_agents=2))
    assert (config.height, config.width) == (4, 5)
    obstacles, positions = source.arenas(config, in_order=True)(
        7, torch.tensor([0, 1, 2, 4]), torch.zeros(4, dtype=torch.int64)
    )
    # padded to the right and below
    assert obstacles[1].int().tolist() == [[0, 0, 1, 1, 1], [0, 0, 0, 1, 1], [1] * 5, [1] * 5]
    assert torch.equal(obstacles[1], obstacles[3])
    for board, starts in zip(obstacles, positions, strict=True):
        assert not board[starts[:, 0], starts[:, 1]].any()


def test_evaluation_takes_every_map_once_and_training_samples(folder):
    config = fit(ArenaConfig(num_agents=2), str(folder))
    episodes = record(find_policy("nearest", config), config, 3, steps=30, arenas=str(folder))
    assert episodes.num_targets.tolist() == [10 + 5, 6 + 4, 12 + 4]  # with the walls of the padding
    env = ExplorationEnv(config, 200, arenas=str(folder))
    drawn = env.reset()["obstacles"].flatten(1).sum(-1)
    assert len(drawn.unique()) == 3


def test_names_bring_size_and_length(folder):
    assert default_config(f"{folder}?resolution=1.0").height == 8
    assert default_steps(str(folder)) == 1500
    assert make_env(arenas=f"{folder}/c.txt", num_envs=2).reset()["obstacles"].shape == (2, 4, 3)
    assert not is_source("uniform")
    assert not is_source("")
    generator = MapSource.parse(str(folder)).arenas(fit(ArenaConfig(num_agents=1), str(folder)))
    assert in_order(generator, generator.config).in_order


@pytest.mark.parametrize(
    ("starts", "first", "second"),
    [
        ("marked", [[1, 1], [1, 3]], [[0, 0], [1, 0]]),
        ("1,0;0,1", [[1, 0], [0, 1]], [[1, 0], [0, 1]]),
    ],
)
def test_robots_start_where_they_are_told(folder, starts, first, second):
    source = MapSource.parse(f"{folder}?starts={starts}")
    config = source.fit(ArenaConfig(num_agents=2))
    _, positions = source.arenas(config, in_order=True)(0, torch.arange(2), torch.zeros(2).long())
    assert positions.tolist() == [first, second]


def test_robots_start_at_pixels_of_a_value(tmp_path):
    pixels = np.full((8, 12), 195, np.uint8)
    pixels[:, 6:8] = 127
    pixels[2:4, 10:12] = 203
    Image.fromarray(pixels).save(tmp_path / "a.png")
    name = f"{tmp_path}?resolution=0.25&free=195&start_value=203"
    config = fit(ArenaConfig(num_agents=3), name)
    env = ExplorationEnv(config, 20, arenas=name)
    td = env.reset()
    assert td["obstacles"][0].int().tolist() == [[0, 0, 0, 1, 0, 0]] * 4
    places = set().union(*map(cells, td["agents", "position"]))
    assert (1, 5) in places
    assert places <= {(row, column) for row in range(3) for column in (4, 5)}


def test_an_image_that_a_yaml_names_is_one_map(tmp_path):
    Image.fromarray(np.full((4, 4), 254, np.uint8)).save(tmp_path / "floor.pgm")
    (tmp_path / "floor.yaml").write_text(
        "image: floor.pgm\nresolution: 0.5\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )
    assert [path.name for path in MapSource.parse(str(tmp_path)).paths] == ["floor.yaml"]


def test_the_same_arena_comes_out_for_any_batch(folder):
    source = MapSource.parse(str(folder))
    generate = source.arenas(source.fit(ArenaConfig(num_agents=2)))
    seed, numbers = stream_seed("train", 3), torch.arange(40)
    together = generate(seed, numbers, torch.zeros(40, dtype=torch.int64))
    alone = generate(seed, numbers[17:18], torch.zeros(1, dtype=torch.int64))
    assert torch.equal(together[0][17:18], alone[0])
    assert torch.equal(together[1][17:18], alone[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("?colour=red", "unknown option 'colour', use .*'resolution'.* or starts"),
        ("?resolution=big", "resolution must be a number"),
        ("?resolution=-1", "resolution=-1.0 is not allowed"),
        ("?starts=here", "starts='here' is not allowed: use one of .*clustered.*or pixels"),
        ("?starts=1,2,3", "starts='1,2,3' is not allowed"),
        ("?start_value=x", "start_value must be a number"),
        ("?free=300", "free='300' is not allowed"),
    ],
)
def test_options_that_cannot_be_are_refused(folder, options, message):
    with pytest.raises(ValueError, match=message):
        ExplorationEnv(arenas=f"{folder}{options}")


def test_sources_that_cannot_be_are_refused(folder, tmp_path_factory):
    empty = tmp_path_factory.mktemp("empty")
    with pytest.raises(ValueError, match="holds no map file: they end in one of"):
        MapSource.parse(str(empty))
    with pytest.raises(ValueError, match=r"height=12 and width=12 are not allowed: .* 4 x 5 cells"):
        ExplorationEnv(ArenaConfig(), arenas=str(folder))
    three, one = (fit(ArenaConfig(num_agents=n), str(folder)) for n in (3, 1))
    with pytest.raises(ValueError, match=r"a.txt marks 2 starts, expected num_agents=3"):
        ExplorationEnv(three, arenas=f"{folder}?starts=marked")
    with pytest.raises(ValueError, match="outside the arena|is an obstacle"):
        ExplorationEnv(one, arenas=f"{folder}?starts=3,4")


def test_what_a_reading_loses_is_told(tmp_path):
    plan = np.where(two_rooms(door=10, offset=3, side=140), 0, 255).astype(np.uint8)
    Image.fromarray(plan).save(tmp_path / "plan.png")
    source = MapSource.parse(str(tmp_path))
    assert source.losses(0.2) == {}
    assert source.losses(0.5)["plan.png"][0] == pytest.approx(0.5, abs=0.1)
    assert source.fit(ArenaConfig()).height == 14  # pixels of an image are 0.05 m
    (tmp_path / "plan.png").unlink()
    (tmp_path / "a.txt").write_text(SMALL)
    assert MapSource.parse(str(tmp_path)).losses(0.5) == {}
