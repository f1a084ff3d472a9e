"""Sets of the field that users have: small maps in each format, by the commands of the docs."""

from __future__ import annotations

import json
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from marl_explore import ArenaConfig, evaluate, find_policy, require_decentralised
from marl_explore.arenas.dungeons import START, WALL, draw_dungeon, write_dungeons
from marl_explore.cli import benchmark, check, explore, maps, replay
from marl_explore.cli import evaluate as evaluation
from marl_explore.evaluation.benchmark import BENCHMARKS, read_results

DOCS = Path(__file__).parents[2] / "docs" / "benchmark.md"
COMMANDS = re.findall(r"^marl-explore (.*)$", DOCS.read_text(), re.MULTILINE)


def told(words):
    """The commands of the docs that contain some words, split."""
    return [shlex.split(line, comments=True) for line in COMMANDS if words in line]


@pytest.fixture(autouse=True)
def _short(tmp_path, monkeypatch):
    for name, entry in BENCHMARKS.items():
        monkeypatch.setitem(BENCHMARKS, name, replace(entry, steps=30))
    monkeypatch.chdir(tmp_path)


def ran(words):
    """A command of the docs with a fast policy in place of its own."""
    (name, action, kind, *policies_and_flags) = words
    assert (name, action) == ("benchmark", "run")
    flags = policies_and_flags[[w.startswith("--") for w in policies_and_flags].index(True) :]
    benchmark.run(benchmark.parse([action, kind, "nearest-timer", *flags]))
    return read_results(Path("benchmark", kind, "results.json"))


def test_dungeons_with_25_pixels_a_coarse_cell():
    """500 x 500 pixels, walls 127, free 255, start 208: two cells are a coarse cell."""
    ((*words,),) = told("start_value=208")
    Path("dungeons25").mkdir()
    grey = np.array([127, 255, 208], np.uint8)
    for seed in range(2):
        coarse = draw_dungeon(seed, 20, 20)
        pixels = grey[coarse].repeat(25, 0).repeat(25, 1)
        assert pixels.shape == (500, 500)
        Image.fromarray(pixels).save(f"dungeons25/{seed}.png")
    content = ran(words)
    assert (content["settings"]["arena"]["height"], len(content["maps"])) == (40, 2)
    prepared = BENCHMARKS[content["benchmark"]].prepare(words[words.index("--maps") + 1])
    arenas = prepared.suite.arenas
    for seed, (obstacles, places) in enumerate(zip(arenas.maps, arenas.places, strict=True)):
        coarse = draw_dungeon(seed, 20, 20).repeat(2, 0).repeat(2, 1)
        assert np.array_equal(obstacles.numpy(), coarse == WALL)
        assert np.array_equal(places.numpy(), coarse == START)  # four cells for four robots


def test_a_start_of_a_color_has_the_grey_value_that_an_error_tells():
    ((*words,),) = told("start_value=208")
    write_dungeons("dungeons25", 1, rows=8, columns=8, pixels=25)
    with pytest.raises(ValueError, match="start_value=208, got none; .* values 127, 195, 203"):
        ran(words)


def test_floors_of_map_server():
    ((*words,),) = told("--maps floors")
    Path("floors").mkdir()
    floor = np.full((80, 120), 254, np.uint8)
    floor[:3] = floor[-3:] = floor[:, :3] = floor[:, -3:] = 0
    floor[:30, 60:63] = floor[50:, 60:63] = 0  # a door of 1 m
    floor[60:, 90:] = 205  # unknown
    Image.fromarray(floor).save("floors/floor.pgm")
    Path("floors/floor.yaml").write_text(
        "image: floor.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    content = ran(words)
    arena = content["settings"]["arena"]
    assert arena["cell_size"] == float(words[words.index("--cell-size") + 1]) == 0.25
    assert (arena["height"], arena["width"]) == (16, 24)
    assert arena["communication_range"] == pytest.approx(1.6)  # 6.4 cells as in the paper
    assert [entry["name"] for entry in content["maps"]] == ["floor.yaml"]
    again = ["rerun", "benchmark/maps-4/results.json", "--maps", "floors"]
    benchmark.run(benchmark.parse(again))


def test_maps_of_pogema():
    """The YAML of POGEMA, split as the docs say: start cells are its @ and !."""
    ((*words,),) = told("--maps pogema")
    drawings = {"wide": "!!@..\n!#$#.\n.....", "tall": "@@.\n@@#\n.#.\n..."}
    Path("maps.yaml").write_text(yaml.safe_dump(drawings, default_style="|"))
    (block,) = [
        b for b in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL) if "yaml" in b
    ]
    exec(compile(block, "benchmark.md", "exec"), {})
    content = ran(words)
    assert [entry["name"] for entry in content["maps"]] == ["tall.txt", "wide.txt"]
    prepared = BENCHMARKS[content["benchmark"]].prepare("pogema")
    tall, wide = prepared.suite.arenas.maps
    assert tall[:, :3].int().tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 0]]
    assert tall[:, 3:].all()  # padded to one size
    assert wide[:3].int().tolist() == [[0] * 5, [0, 1, 0, 1, 0], [0] * 5]
    marked = torch.tensor([[1, 1, 1, 0, 0], [1, 0, 0, 0, 0], [0] * 5, [0] * 5]).bool()
    assert prepared.suite.arenas.places[1].equal(marked)


def test_the_explorer_of_the_page_takes_part(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "explorer", raising=False)
    (block, *_) = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    Path("explorer.py").write_text(block)
    config = ArenaConfig()
    steps = {
        name: evaluate(find_policy(name, config), config, num_arenas=10)["steps_to_95"]
        for name in ("explorer:Explorer", "random")
    }
    assert steps["explorer:Explorer"] < steps["random"] / 2
    require_decentralised("explorer:Explorer", config, steps=20)
    write_dungeons("drawn", 1, rows=6, columns=8)
    words = ["explorer:Explorer", "--maps", told("maps-4 explorer")[0][-1]]
    benchmark.run(benchmark.parse(["run", "maps-4", *words]))
    assert "explorer:Explorer" in capsys.readouterr().out
    replay.run(replay.parse(["explorer:Explorer", "--steps", "5", "--out", "page.html"]))
    assert '"name":"explorer:Explorer"' in Path("page.html").read_text()
    (words,) = told("explore drawn")
    explore.run(explore.parse([*words[1:], "--steps", "9"]))
    assert Path("explored", "dungeon_0.html").exists()


def test_every_command_of_the_page_is_read():
    modules = {
        "benchmark": benchmark,
        "check": check,
        "evaluate": evaluation,
        "explore": explore,
        "maps": maps,
        "replay": replay,
    }
    for line in COMMANDS:
        name, *words = shlex.split(line, comments=True)
        modules[name].parse(words)


def test_the_page_has_a_table_for_every_benchmark_of_the_set():
    text = DOCS.read_text()
    for name in BENCHMARKS:
        if name.startswith("dungeons"):
            assert f"`{name}`" in text


def test_results_of_others_can_be_read_by_any_json_reader():
    write_dungeons("drawn", 1, rows=6, columns=8)
    words = told('--maps "drawn?')[0]
    ran(words)
    path = Path("benchmark", words[2], "results.json")
    json.loads(path.read_text(), parse_constant=pytest.fail)
