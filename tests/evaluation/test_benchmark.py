"""Benchmarks: what each of them fixes, the file that others send, and what is found in it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from marl_explore import ArenaConfig, record
from marl_explore.arenas.dungeons import write_dungeons
from marl_explore.cli import benchmark as command
from marl_explore.evaluation import benchmark as protocol
from marl_explore.evaluation import metrics
from marl_explore.evaluation.benchmark import BENCHMARKS, read_results
from marl_explore.evaluation.benchmark.protocol import Benchmark
from marl_explore.evaluation.registry import find_policy
from marl_explore.utils.json_files import digest
from tests.arenas.test_dungeons import READING
from tests.arenas.test_map_sets import drawn_set
from tests.evaluation.test_outside import DATA

STEPS = 60


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """Benchmarks of few steps."""
    for name, entry in BENCHMARKS.items():
        monkeypatch.setitem(BENCHMARKS, name, replace(entry, steps=STEPS))
    monkeypatch.syspath_prepend(DATA)


@pytest.fixture
def folder(tmp_path):
    write_dungeons(tmp_path / "maps", 3, rows=6, columns=8)
    return f"{tmp_path / 'maps'}?{READING}"


def ran(*words):
    command.run(command.parse([*map(str, words)]))


@pytest.fixture
def results(folder, tmp_path):
    """A results file of two policies on three maps."""
    policies = ("nearest-timer", "team=random", "bound")
    ran("run", "maps-4", *policies, "--maps", folder, "--out", tmp_path / "out")
    return tmp_path / "out" / "maps-4" / "results.json"


# ---------------------------------------------------------------- the protocol


def test_ten_benchmarks_five_of_a_known_set():
    assert [*BENCHMARKS] == [
        f"{prefix}-{rest}"
        for prefix in ("dungeons", "maps")
        for rest in ("4", "4-lidar", "4-lidar-lossy", "2", "8")
    ]
    assert [entry.num_maps for entry in BENCHMARKS.values()] == [None] * 3 + [40] * 2 + [None] * 5
    assert {Benchmark(name, None).steps for name in BENCHMARKS} == {1500}


def test_three_worlds():
    worlds = {
        name: BENCHMARKS[f"dungeons-{name}"].config(0.5) for name in ("4", "2", "8", "4-lidar")
    }
    assert worlds["4"] == ArenaConfig()
    assert worlds["2"] == ArenaConfig(num_agents=2)
    assert worlds["8"] == ArenaConfig(num_agents=8)
    lidar = worlds["4-lidar"]
    assert (lidar.fov_radius, lidar.line_of_sight, lidar.wall_loss_db) == (10, True, math.inf)
    assert lidar.communication_cells == 10
    lossy = BENCHMARKS["dungeons-4-lidar-lossy"].config(0.5)
    assert lossy == replace(lidar, message_loss=0.1)


def test_ranges_are_as_many_cells_in_cells_of_any_size():
    for name in ("maps-4", "maps-4-lidar"):
        fine = BENCHMARKS[name].config(0.25)
        assert fine.communication_cells == BENCHMARKS[name].config(0.5).communication_cells
        assert fine.sight == BENCHMARKS[name].config(0.5).sight
        assert fine.cell_size == 0.25


def test_a_known_set_brings_its_maps_and_cells(tmp_path):
    maps = drawn_set(tmp_path, 3, rows=6, columns=8)
    few = Benchmark("drawn-2", maps, robots=2, num_maps=2)
    prepared = few.prepare(str(tmp_path))
    assert [*prepared.maps] == ["dungeon_0.png", "dungeon_1.png"]
    assert prepared.maps.items() <= maps.digests.items()
    assert (prepared.suite.config.height, prepared.suite.config.width) == (12, 16)
    assert (prepared.suite.steps, prepared.suite.num_arenas) == (1500, 2)
    assert len(few.prepare(str(tmp_path), num_maps=1).maps) == 1
    with pytest.raises(ValueError, match=r"cell_size=0.25 is not allowed: drawn-2 has cells of"):
        few.prepare(str(tmp_path), 0.25)
    with pytest.raises(ValueError, match="num_maps=3 is not allowed"):
        few.prepare(str(tmp_path), num_maps=3)
    (tmp_path / "dungeon_2.png").unlink()
    with pytest.raises(ValueError, match=r"are missing: dungeon_2.png"):
        few.prepare(str(tmp_path))


# ---------------------------------------------------------------- the file


def test_a_run_writes_what_the_policies_did(results, folder):
    content = json.loads(results.read_text())
    assert content["benchmark"] == "maps-4"
    assert [entry["name"] for entry in content["maps"]] == [f"dungeon_{i}.png" for i in range(3)]
    assert [*content["entries"]] == ["nearest-timer", "team"]  # the bound is no policy
    (one,) = content["entries"]["nearest-timer"]
    config = BENCHMARKS["maps-4"].config(0.5)
    suite = BENCHMARKS["maps-4"].prepare(folder).suite
    policy = find_policy("nearest-timer", suite.config)
    episodes = record(policy, suite.config, 3, STEPS, arenas=folder, until_mapped=True)
    expected = {name: x.tolist() for name, x in metrics.per_episode(episodes).items()}
    assert one["scores"] == expected
    assert (one["planner"], one["reference"], one["checked"]) == (True, False, False)
    assert one["code"]
    assert content["settings"]["arena"]["sensing_range"] == config.sensing_range
    assert "Infinity" not in results.read_text()
    assert read_results(results) == {k: v for k, v in content.items() if k != "sha256"}


def test_the_table_has_the_measures_of_the_field(results):
    text = (results.parent / "table.txt").read_text()
    for title in protocol.COLUMNS:
        assert title in text
    lines = text.splitlines()
    assert lines[0].endswith(f": 3 arenas, {STEPS} steps")
    assert [line.split()[0] for line in lines[4:]] == [
        "nearest-timer",
        "team",
        lines[3].split()[0],
        "bound",
    ]
    markdown = (results.parent / "table.md").read_text()
    assert "- **success**: share of the maps" in markdown


def test_a_lidar_world_is_written_without_infinity(folder, tmp_path):
    ran("run", "maps-4-lidar", "random", "--maps", folder, "--out", tmp_path, "--num-maps", 1)
    path = tmp_path / "maps-4-lidar" / "results.json"
    json.loads(path.read_text(), parse_constant=pytest.fail)
    assert read_results(path)["settings"]["arena"]["wall_loss_db"] == "inf"


def changed(path, change, sign=True):
    """The file with another content."""
    content = json.loads(path.read_text())
    del content["sha256"]
    change(content)
    path.write_text(json.dumps({"sha256": digest(content) if sign else "0" * 64, **content}))


def score(name, values):
    def change(content):
        content["entries"]["team"][0]["scores"][name] = values

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(format="other/1"), "its format is 'other/1' and not"),
        (lambda c: c.update(benchmark="best"), "benchmark='best' is not allowed: use one of"),
        (lambda c: c["settings"].update(steps=70), "steps is 70 and not 60"),
        (lambda c: c["settings"].update(seed=1), "seed is 1 and not 0"),
        (lambda c: c["settings"]["arena"].update(num_agents=5), "num_agents is 5 and not 4"),
        (lambda c: c["settings"]["arena"].update(cell_size=0.25), "sensing_range is 1.1 and not"),
        (lambda c: c.update(entries={}), "it has no entries"),
        (lambda c: c.pop("maps"), r"incomplete or of another form \(KeyError: 'maps'"),
        (lambda c: c.update(maps=[]), "it has no maps"),
        (lambda c: c["maps"].append(c["maps"][0]), "it has no maps, or one twice"),
        (lambda c: c["maps"][0].update(sha256="x"), "a map has no SHA-256"),
        (lambda c: c["maps"].pop(), "entry 'team': steps_to_80 has 3 values for 2 maps"),
        (score("steps_to_100", [62, 60, 60]), r"steps_to_100 has values outside \[0, 61\]"),
        (score("steps_to_95", [0.5, 1, 1]), "steps are no integers"),
        (score("steps_to_100", [1, 1, 1]), "a larger coverage is reached before a smaller one"),
        (score("steps_to_100", [61, 61, "x"]), "of another form"),
        (score("complete", [0.5, 0, 0]), "complete contradicts steps_to_100"),
        (score("final_largest_coverage", [1.2, 1, 1]), r"outside \[0, 1\]"),
        (score("distance_m", [-1, 1, 1]), "distance_m has values outside"),
        (lambda c: c["entries"]["team"][0]["scores"].pop("steps_to_90"), "it has no steps_to_90"),
        (
            lambda c: c["entries"]["team"][0]["shares"]["useful_share"].update(part=[9, 9, 9**9]),
            "useful_share is no share of events on 3 maps",
        ),
    ],
)
def test_what_keeps_not_to_the_protocol_is_told(results, change, message):
    changed(results, change)
    with pytest.raises(ValueError, match=f"results.json is not a benchmark's results: .*{message}"):
        read_results(results)


def test_a_damaged_file_is_refused(results, capsys):
    ran("check", results)
    assert "maps-4 on 3 maps, nearest-timer, team: whole" in capsys.readouterr().out
    changed(results, score("overlap", [1, 1, 1]), sign=False)
    with pytest.raises(ValueError, match="its contents do not match its SHA-256"):
        ran("check", results)
    with pytest.raises(ValueError, match="cannot be read"):
        ran("check", results.parent / "other.json")


def test_maps_of_a_known_set_are_compared_with_those_known(tmp_path, monkeypatch):
    maps = drawn_set(tmp_path / "maps", 3, rows=6, columns=8)
    entry = Benchmark("drawn-4", maps, num_maps=2, steps=STEPS)
    monkeypatch.setitem(BENCHMARKS, "drawn-4", entry)
    words = ("run", "drawn-4", "random", "--maps", tmp_path / "maps", "--out", tmp_path / "out")
    ran(*words, "--num-maps", 1)
    path = tmp_path / "out" / "drawn-4" / "results.json"
    with pytest.raises(ValueError, match=r"its maps are not the 2 of drawn-4 in order \(1 missing"):
        read_results(path)
    ran(*words[:-1], tmp_path / "all")
    path = tmp_path / "all" / "drawn-4" / "results.json"
    read_results(path)
    changed(path, lambda c: c["maps"][1].update(sha256="0" * 64))
    with pytest.raises(ValueError, match=r"files of 1 maps, such as dungeon_1.png, are not those"):
        read_results(path)


# ---------------------------------------------------------------- once more


def test_a_rerun_finds_the_same_numbers(results, folder, tmp_path, capsys):
    capsys.readouterr()
    ran("rerun", results, "--maps", folder, "--out", tmp_path / "again")
    assert capsys.readouterr().out.splitlines() == [
        "nearest-timer: the same numbers",
        "random: the same numbers",
    ]
    ran("rerun", results, "--maps", folder, "--out", tmp_path / "again", "--only", "random")
    assert capsys.readouterr().out == "random: the same numbers\n"
    with pytest.raises(ValueError, match="only='best' is not allowed: the file has"):
        ran("rerun", results, "--maps", folder, "--only", "best")


def test_a_rerun_tells_what_differs(results, folder, tmp_path, capsys):
    content = json.loads(results.read_text())
    was = content["entries"]["nearest-timer"][0]["scores"]["distance_m"]

    def better(content):
        entry = content["entries"]["nearest-timer"][0]
        entry["scores"]["distance_m"] = [was[0], was[1] - 1, was[2]]
        entry["code"] = "other"

    changed(results, better)
    with pytest.raises(ValueError, match=r"other numbers than in .*results.json: nearest-timer$"):
        ran("rerun", results, "--maps", folder, "--out", tmp_path / "again")
    said = capsys.readouterr().out
    assert (
        f"nearest-timer: distance_m differs on 1 of 3 maps (on dungeon_1.png it was "
        f"{was[1] - 1:g} and is {was[1]:g}) (other code)"
    ) in said
    assert "random: the same numbers" in said


def test_other_maps_and_other_readings_are_refused(results, folder, tmp_path):
    place = folder.partition("?")[0]
    with pytest.raises(ValueError, match="the maps are read otherwise"):
        ran("rerun", results, "--maps", f"{place}?resolution=0.0625&free=195-255")
    write_dungeons(place, 3, seed=1, rows=6, columns=8)
    with pytest.raises(ValueError, match="the file: it has 3, and these are 4"):
        ran("rerun", results, "--maps", folder)
    write_dungeons(tmp_path / "bigger", 3, rows=7, columns=8)
    with pytest.raises(ValueError, match=r"map dungeon_0.png is not that of the file: its SHA"):
        ran("rerun", results, "--maps", f"{tmp_path / 'bigger'}?{READING}")


# ---------------------------------------------------------------- policies of others


def test_policies_of_others_take_part(folder, tmp_path, capsys):
    words = ("run", "maps-2", "explorers.agents:Greedy", "team=explorers.teams:Counting")
    ran(*words, "--maps", folder, "--out", tmp_path)
    path = tmp_path / "maps-2" / "results.json"
    content = read_results(path)
    (greedy,) = content["entries"]["explorers.agents:Greedy"]
    assert greedy["checked"] is True
    assert greedy["version"] == "1.2"
    assert greedy["sees"] == "its frontier table"
    capsys.readouterr()
    ran("rerun", path, "--maps", folder, "--out", tmp_path / "again")
    assert "not run, as it is code of others: explorers.agents:Greedy" in capsys.readouterr().out
    only = ("--only", "explorers.agents:Greedy", "explorers.teams:Counting")
    ran("rerun", path, "--maps", folder, "--out", tmp_path / "again", *only)
    assert capsys.readouterr().out.count("the same numbers") == 2


def test_policies_that_use_what_a_robot_cannot_know_are_refused_unmeasured(folder, tmp_path):
    for name in ("obstacles", "Telepath"):
        words = ("run", "maps-4", "random", f"explorers.cheats:{name}", "--maps", folder)
        with pytest.raises(ValueError, match=f"cheats:{name}' is not allowed: a"):
            ran(*words, "--out", tmp_path)
    assert not list(tmp_path.rglob("*.json"))


def test_a_run_resumes_and_keeps_other_folders(folder, tmp_path, capsys):
    words = ("run", "maps-4", "random", "--maps", folder, "--out", tmp_path / "out")
    ran(*words)
    cell = next((tmp_path / "out" / "maps-4" / "cells").iterdir())
    before = cell.stat().st_mtime_ns
    ran(*words)
    assert cell.stat().st_mtime_ns == before
    (tmp_path / "full" / "maps-4").mkdir(parents=True)
    (tmp_path / "full" / "maps-4" / "thesis.tex").write_text("x")
    with pytest.raises(ValueError, match="exists and is not empty"):
        ran(*words[:-1], tmp_path / "full")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "maps-4"], "maps='' is not allowed: name the folder"),
        (["run", "maps-3", "--maps", "x"], "benchmark='maps-3' is not allowed: use one of dung"),
        (["run", "dungeons-4", "--maps", "."], "100 of the 100 maps of 'dungeons' are missing"),
        (["run", "maps-4", "--maps", "nowhere"], "nowhere"),
        (["run", "maps-4", "--maps", "x", "--threads", "0"], "threads=0"),
        (["rerun", "x.json"], "maps='' is not allowed"),
    ],
)
def test_what_cannot_be_run_is_one_error(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, OSError), match=message):
        ran(*words)
    assert not list(tmp_path.iterdir())
