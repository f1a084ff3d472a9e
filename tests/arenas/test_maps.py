"""Maps as arenas: resampled to cells, drawn by hash, with starts where robots can meet."""

from __future__ import annotations

import pickle

import pytest
import torch

from marl_explore import ArenaConfig, ExplorationEnv, make_env
from marl_explore.arenas import MapArenas, load_map
from marl_explore.core.hashing import stream_seed
from tests.helpers.drawing import cells, drawn

POCKET = """\
..#....
..#....
###.0.1
.......
"""
PLAIN = """\
.......
..###..
1.....0
.......
"""
CONFIG = ArenaConfig(height=4, width=7, num_agents=2)


def written(folder, **drawings):
    paths = [folder / f"{name}.txt" for name in drawings]
    for path, drawing in zip(paths, drawings.values(), strict=True):
        path.write_text(drawing)
    return paths


def bits(obstacles):
    return ["".join(".#"[cell] for cell in row) for row in obstacles.int().tolist()]


# --------------------------------------------------------------------- resampling


@pytest.mark.parametrize(
    ("drawing", "cell_size", "options", "expected"),
    [
        ("#...\n....\n....\n....", 2, {}, ["#.", ".."]),
        ("#...\n....\n....\n....", 2, {"max_occupied": 0.25}, ["..", ".."]),
        ("##..\n#...\n....\n....", 2, {"max_occupied": 0.5}, ["#.", ".."]),
        (".....#", 4, {"max_occupied": 0.3}, [".#"]),  # half of what the map shows of the cell
        (".#.\n...", 1.5, {}, ["##", ".."]),  # a pixel that reaches into two cells
        (".#.", 1.5, {"max_occupied": 0.4}, [".."]),  # a third of either
        (".#", 0.5, {}, ["..##", "..##"]),
        ("..#", 3, {"max_occupied": 0.33}, ["#"]),
        ("..#", 3, {"max_occupied": 0.34}, ["."]),
    ],
)
def test_cells_with_more_than_a_share_of_occupied_area_are_obstacles(
    tmp_path, drawing, cell_size, options, expected
):
    (path,) = written(tmp_path, a=drawing)
    assert bits(load_map(path, cell_size=cell_size, resolution=1.0, **options)) == expected


def test_rounding_makes_no_cells_and_no_obstacles(tmp_path):
    (path,) = written(tmp_path, a="...#..\n")  # 0.3 / 0.1 is a little less than 3
    assert bits(load_map(path, cell_size=0.3, resolution=0.1)) == [".#"]


# ---------------------------------------------------------------------- generator


def test_every_map_is_drawn_and_the_choice_is_a_hash(tmp_path):
    arenas = MapArenas.load(CONFIG, written(tmp_path, a=POCKET, b=PLAIN))
    obstacles, positions = drawn(arenas, 200, seed=5)
    which = (obstacles == arenas.maps[1]).flatten(1).all(1)
    assert ((obstacles == arenas.maps[0]).flatten(1).all(1) ^ which).all()
    assert 70 < which.sum() < 130
    alone = arenas(5, torch.tensor([57]), torch.tensor([0]))
    assert torch.equal(alone[0][0], obstacles[57])
    assert torch.equal(alone[1][0], positions[57])
    again = drawn(pickle.loads(pickle.dumps(arenas)), 200, seed=5)
    assert all(map(torch.equal, again, (obstacles, positions)))
    assert not torch.equal(drawn(arenas, 200, seed=5, episode=1)[0], obstacles)


@pytest.mark.parametrize("starts", ["scattered", "clustered"])
def test_robots_start_in_the_largest_part_of_a_map(tmp_path, starts):
    arenas = MapArenas.load(CONFIG, written(tmp_path, a=POCKET), starts=starts)
    _, positions = drawn(arenas, 300)
    reached = set().union(*map(cells, positions))
    assert reached == {
        (row, column) for row in range(4) for column in range(7) if row == 3 or column > 2
    }
    if starts == "clustered":
        assert (positions[:, 0] - positions[:, 1]).abs().amax() == 1


def test_marked_robots_start_at_their_digits(tmp_path):
    arenas = MapArenas.load(CONFIG, written(tmp_path, a=POCKET, b=PLAIN), starts="marked")
    obstacles, positions = drawn(arenas, 50)
    pocket = (obstacles == arenas.maps[0]).flatten(1).all(1)
    assert 0 < pocket.sum() < 50
    assert (positions[pocket] == torch.tensor([[2, 4], [2, 6]])).all()
    assert (positions[~pocket] == torch.tensor([[2, 6], [2, 0]])).all()


def test_marks_move_to_the_cell_that_holds_them(tmp_path):
    paths = written(tmp_path, a="....0.\n1.....\n")
    config = ArenaConfig(height=1, width=3, num_agents=2, cell_size=0.4)
    arenas = MapArenas.load(config, paths, starts="marked", resolution=0.2)
    assert arenas.marks.tolist() == [[[0, 2], [0, 0]]]
    few = ArenaConfig(height=2, width=6, num_agents=1)
    assert MapArenas.load(few, paths, starts="marked").marks.tolist() == [[[0, 4]]]


def test_every_reset_in_a_training_run_draws_the_map_of_its_episode(tmp_path):
    arenas = MapArenas.load(CONFIG, written(tmp_path, a=POCKET, b=PLAIN))
    env = make_env(arenas=arenas, num_envs=5, seed=2, max_steps=30, terminate_at_coverage=0.9)
    torch.manual_seed(0)
    episodes, td = torch.zeros(5).long(), env.reset()
    for _ in range(80):
        expected = arenas(stream_seed("train", 2), torch.arange(5), episodes)
        assert torch.equal(td["obstacles"], expected[0])
        fresh = td["step_count"].squeeze(-1) == 0
        assert torch.equal(td["agents", "position"][fresh], expected[1][fresh])
        step, td = env.step_and_maybe_reset(env.rand_action(td))
        episodes += step["next", "done"].squeeze(-1)
    assert len(episodes.unique()) > 1


# ---------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("config", "starts", "message"),
    [
        (ArenaConfig(), "scattered", r"a.txt has \(4, 7\) cells of 0.5 m, expected .*\(12, 12\)"),
        (ArenaConfig(4, 7, 0, 20), "scattered", r"num_agents=20 .* part of map 0 has 19 free"),
        (ArenaConfig(4, 7), "marked", "a.txt marks 2 starts, expected num_agents=4"),
        (CONFIG, "near", "starts='near' is unknown.*scattered"),
    ],
)
def test_maps_that_cannot_be_arenas_of_the_configuration_are_refused(
    tmp_path, config, starts, message
):
    with pytest.raises(ValueError, match=message):
        MapArenas.load(config, written(tmp_path, a=POCKET), starts=starts)


def test_a_map_of_another_size_among_them_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"b.txt has \(1, 7\) cells"):
        MapArenas.load(CONFIG, written(tmp_path, a=POCKET, b=".......\n"))


def test_no_maps_are_refused():
    with pytest.raises(ValueError, match="at least one file"):
        MapArenas.load(CONFIG, [])


@pytest.mark.parametrize(
    ("maps", "marks", "message"),
    [
        (torch.zeros(1, 4, 7), None, r"maps must be torch.bool .*\[K, 4, 7\], got torch.float32"),
        (torch.zeros(4, 7).bool(), None, r"maps must be .*\(4, 7\)"),
        (torch.zeros(1, 4, 7).bool(), None, r"needs marks, torch.int64 of shape \(1, 2, 2\)"),
        (torch.zeros(1, 4, 7).bool(), torch.zeros(1, 2, 2).long(), "more than one robot"),
        (torch.zeros(1, 4, 7).bool(), torch.tensor([[[0, 0], [4, 0]]]), "outside the arena"),
    ],
)
def test_given_maps_and_marks_are_checked(maps, marks, message):
    with pytest.raises(ValueError, match=message):
        MapArenas(CONFIG, "marked", maps=maps, marks=marks)


def test_an_environment_of_another_configuration_is_refused(tmp_path):
    arenas = MapArenas.load(CONFIG, written(tmp_path, a=PLAIN))
    with pytest.raises(ValueError, match=r"positions .*\(1, 3, 2\)"):
        ExplorationEnv(ArenaConfig(height=4, width=7, num_agents=3), arenas=arenas).reset()
