"""The leaderboard: cells that are kept and checked, rows against hand-made numbers, the files."""

from __future__ import annotations

import ast
import csv
import gc
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from marl_explore.arenas import suite
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.evaluation import leaderboard, metrics, plots, stats
from marl_explore.evaluation.episodes import record
from marl_explore.evaluation.leaderboard import Cell, Entry, cells, fingerprint, parse_entries, rank
from marl_explore.evaluation.leaderboard.table import COLUMNS, format_markdown, format_text
from marl_explore.evaluation.registry import find_policy
from marl_explore.planners import PLANNERS, RandomWalk, counting_bound

PAPER = suite("paper-12")
CELL = Cell("nearest-timer", PAPER, num_arenas=3, steps=25, seed=1)


def test_words_name_rows():
    assert parse_entries(["random", "runs/a", "mine=runs/b,runs/c"]) == [
        Entry("random", ("random",)),
        Entry("runs/a", ("runs/a",)),
        Entry("mine", ("runs/b", "runs/c")),
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "a"], "policies='a' is given twice"),
        (["a=x", "b=x", "a=y"], "policies='a' is given twice"),
        (["=x"], "policies='=x' is not allowed"),
        (["a=x,"], "policies='a=x,' is not allowed"),
    ],
)
def test_words_that_name_no_rows_are_refused(words, message):
    with pytest.raises(ValueError, match=message):
        parse_entries(words)


def test_a_cell_keeps_what_was_measured():
    result = cells.measure(CELL)
    assert result == json.loads(json.dumps(result))
    policy = find_policy("nearest-timer", PAPER.config)
    episodes = record(policy, None, num_arenas=3, steps=25, seed=1, arenas="paper-12")
    scores = metrics.per_episode(episodes)
    assert result["scores"] == {name: values.tolist() for name, values in scores.items()}
    useful = metrics.useful_share(episodes)
    assert result["shares"]["useful_share"]["part"] == useful.part.tolist()
    assert result["shares"]["useful_share"]["whole"] == useful.whole.tolist()
    assert result["coverage"][0] == metrics.coverage(episodes)["largest"].mean(0).tolist()
    counts = np.repeat(np.arange(len(result["enlargements"])), result["enlargements"])
    assert counts.tolist() == sorted(metrics.enlargements(episodes).tolist())
    assert result["cells_sent"][-1] == scores["cells_sent"].mean()
    assert result["settings"]["fingerprint"] == PAPER.digest
    assert result["run"]["versions"]["torch"]
    assert result["planner"] is True


def test_a_policy_says_what_it_sees_and_whether_it_is_a_reference(monkeypatch):
    class Seer(RandomWalk):
        sees = "everything"
        reference = True

    monkeypatch.setitem(PLANNERS, "seer", lambda config: Seer())
    told = [cells.measure(replace(CELL, policy=name)) for name in ("seer", "random")]
    assert [result["reference"] for result in told] == [True, False]
    assert told[0]["sees"] == "everything"


def test_cells_are_measured_once(tmp_path, monkeypatch):
    other = replace(CELL, policy="random")
    first = leaderboard.make_cells(tmp_path, [CELL], progress=False)
    measured = []
    measure = cells.measure
    monkeypatch.setattr(cells, "measure", lambda cell: measured.append(cell) or measure(cell))
    both = leaderboard.make_cells(tmp_path, [CELL, other, CELL], progress=False)
    assert measured == [other]
    assert both[CELL] == first[CELL]


def test_an_interrupted_run_keeps_what_it_finished(tmp_path, monkeypatch):
    plan = [replace(CELL, policy=name) for name in ("nearest", "random", "nearest-timer")]
    whole = leaderboard.make_cells(tmp_path / "whole", plan, progress=False)
    measure = cells.measure

    def interrupted(cell):
        if cell.policy == "random":
            raise KeyboardInterrupt
        return measure(cell)

    with monkeypatch.context() as patch:
        patch.setattr(cells, "measure", interrupted)
        with pytest.raises(KeyboardInterrupt):
            leaderboard.make_cells(tmp_path / "parts", plan, progress=False)
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["nearest--paper-12-v1.json"]
    resumed = leaderboard.make_cells(tmp_path / "parts", plan, progress=False)
    assert [r["scores"] for r in resumed.values()] == [r["scores"] for r in whole.values()]


def test_a_cell_of_other_settings_is_refused_before_anything_is_measured(tmp_path):
    leaderboard.make_cells(tmp_path, [CELL], progress=False)
    new = replace(CELL, policy="random")
    with pytest.raises(ValueError, match=r"num_arenas was 3 and now is 4; seed was 1 and now is 2"):
        leaderboard.make_cells(tmp_path, [new, replace(CELL, num_arenas=4, seed=2)], progress=False)
    assert not (tmp_path / new.file_name).exists()


def test_a_cell_of_other_code_is_measured_anew(tmp_path, monkeypatch):
    old = leaderboard.make_cells(tmp_path, [CELL], progress=False)[CELL]
    monkeypatch.setattr(cells, "source_digest", lambda kind: "other")
    monkeypatch.setitem(PLANNERS, CELL.policy, lambda config: RandomWalk())
    new = leaderboard.make_cells(tmp_path, [CELL], progress=False)[CELL]
    assert new["settings"]["code"] == "other"
    assert new["scores"] != old["scores"]
    written = json.loads((tmp_path / CELL.file_name).read_text())
    assert written.pop("sha256")
    assert written == new


def test_the_code_of_a_cell_is_what_it_does_and_not_what_it_says(tmp_path):
    module = tmp_path / "rules.py"

    def digest(source):
        module.write_text(source)
        return fingerprint.digest([tmp_path])

    first = digest('"""Rules."""\n\ndef cost(x):\n    """A cost."""\n    return 2 * x  # twice\n')
    assert digest('def cost(x):\n    """Its price."""\n\n    return (2 * x)\n') == first
    assert digest("def cost(x):\n    return 3 * x\n") != first
    (tmp_path / "kernel.c").write_text("int cost(int x) { return 2 * x; }\n")
    assert digest("def cost(x):\n    return 2 * x\n") != first
    planners, trained = (
        fingerprint.source_digest("planner"),
        fingerprint.source_digest("trained"),
    )
    assert planners != trained
    assert cells.measure(CELL)["settings"]["code"] == planners


def test_no_setting_of_training_is_behind_the_numbers():
    for kind in fingerprint.PARTS:
        found = [path.relative_to(fingerprint.PACKAGE) for path in fingerprint.sources(kind)]
        assert all((fingerprint.PACKAGE / path).exists() for path in found)
        assert not any(path.parts[0] == "training" for path in found)
        assert Path("config", "arena.py") in found


def imported(module):
    """The package's modules that a module imports."""
    names = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("marl_explore"):
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    paths = [fingerprint.PACKAGE.joinpath(*name.split(".")[1:]) for name in names]
    files = [file for path in paths for file in (path.with_suffix(".py"), path / "__init__.py")]
    return {file for file in files if file.is_file() and file.parent != fingerprint.PACKAGE}


@pytest.mark.parametrize(
    ("kind", "acting"),
    [
        ("planner", "planners/__init__.py"),
        ("trained", "policies/policy.py"),
        ("outside", "evaluation/outside.py"),
    ],
)
def test_the_fingerprint_covers_every_module_that_numbers_depend_on(kind, acting):
    todo = [fingerprint.PACKAGE / path for path in (acting, "evaluation/episodes.py")]
    reached = set()
    while todo:
        module = todo.pop()
        if module not in reached:
            reached.add(module)
            todo += imported(module)
    covered = fingerprint.sources(kind)
    missing = {
        str(module.relative_to(fingerprint.PACKAGE))
        for module in reached
        if not any(path == module or path in module.parents for path in covered)
    }
    # arenas have a fingerprint of their own, and of robots only the form of observations counts;
    # the others check settings, estimate memory and draw
    others = {"config/fields.py", "utils/memory.py", "utils/palette.py"}
    assert {name for name in missing if not name.startswith(("arenas/", "robot/"))} <= others


def test_the_bound_is_a_reference_without_episodes(tmp_path):
    bound = replace(CELL, policy=leaderboard.BOUND)
    results = leaderboard.make_cells(tmp_path, [CELL, bound], progress=False)
    env = ExplorationEnv(PAPER.config, 3, seed=1, stream="test", arenas="paper-12")
    expected = counting_bound(PAPER.config, env.reset()).tolist()
    assert results[bound]["scores"] == {"steps_to_100": expected}
    rows = rank({cell.policy: [result] for cell, result in results.items()})
    assert [(row.name, row.reference) for row in rows] == [
        ("nearest-timer", False),
        ("bound", True),
    ]
    shown = dict(zip(COLUMNS, (cell(rows[1]) for cell in COLUMNS.values()), strict=True))
    assert shown["steps to 100 %"].startswith(f"{np.mean(expected):.1f} [")
    assert shown["complete"] == shown["steps to 95 %"] == "-"
    page = leaderboard.write_report(tmp_path / "a.html", [rows]).read_text()
    assert '<th scope="row">bound</th>' in page
    alone = leaderboard.write_report(tmp_path / "b.html", [rank({"bound": [results[bound]]})])
    assert "<figure>" not in alone.read_text()


@pytest.mark.parametrize("content", ["", "[]", "{}"])
def test_a_file_that_is_no_cell_is_refused(tmp_path, content):
    (tmp_path / CELL.file_name).write_text(content)
    with pytest.raises(ValueError, match="is not a leaderboard cell, or is damaged: delete"):
        leaderboard.make_cells(tmp_path, [CELL], progress=False)


def test_a_cell_that_was_changed_is_refused(tmp_path):
    leaderboard.make_cells(tmp_path, [CELL], progress=False)
    path = tmp_path / CELL.file_name
    content = json.loads(path.read_text())
    content["scores"]["steps_to_100"][0] += 1
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=f"{path} .* do not match its SHA-256"):
        leaderboard.make_cells(tmp_path, [CELL], progress=False)


@pytest.mark.parametrize("word", ["a=random,nearest", "a=best,random", "a=bound,best"])
def test_planners_are_no_training_seeds(word):
    with pytest.raises(ValueError, match="is not trained, so it cannot be one of several"):
        leaderboard.parse_entries([word])


def test_an_evaluation_leaves_nothing_behind():
    policy = PLANNERS["nearest-timer"](CELL.suite.config)

    def evaluate():
        record(policy, CELL.suite.config, num_arenas=1, steps=2, arenas=CELL.suite.arenas)

    for _ in range(10):
        evaluate()
    gc.collect()
    before = len(gc.get_objects())
    for _ in range(20):
        evaluate()
    gc.collect()
    assert len(gc.get_objects()) - before < 20


def test_an_unknown_policy_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="no policy 'nobody'"):
        leaderboard.make_cells(tmp_path / "new", [CELL, replace(CELL, policy="nobody")])
    assert list(tmp_path.iterdir()) == []


def test_policies_with_alike_names_have_files_of_their_own():
    names = ["runs/a", "runs_a", "runs a", "../runs/a"]
    files = {replace(CELL, policy=name).file_name for name in names}
    assert len(files) == 4
    assert all("/" not in name for name in files)


def a_result(steps, planner=True, reference=False, sees="own map", useful=(1, 4)):
    """The result of a policy that took so many of 9 steps on each arena."""
    arenas = len(steps)
    scores = {
        name: [0.5] * arenas
        for name in ("complete", "coverage_at_20", "overlap", "final_largest_coverage")
    }
    return {
        "settings": {"suite": "tiny-v1", "num_arenas": arenas, "steps": 9},
        "planner": planner,
        "reference": reference,
        "sees": sees,
        "scores": scores | {"steps_to_100": steps, "steps_to_95": [s - 1 for s in steps]},
        "shares": {
            name: {"part": [part] * arenas, "whole": [whole] * arenas}
            for name, (part, whole) in {
                "communication_share": (4, 9),
                "communication_share_before_completion": (2, 8),
                "useful_share": useful,
            }.items()
        },
        "coverage": [[0.1, 0.6], [0.0, 0.5], [0.2, 0.7]],
        "cells_sent": [0.0, 7.0],
        "enlargements": [3, 0, 1],
        "max_discovery": 5,
    }


SEEDS = [a_result([1.0, 2, 4, 9], False), a_result([3.0, 2, 6, 9], False, useful=(0, 0))]
BOARD = {
    "slow": [a_result([9.0, 9, 9, 10], sees="a|b")],
    "<mine>": SEEDS,
    "oracle": [a_result([1.0, 1, 1, 1], reference=True)],
    "good": [a_result([3.0, 3, 5, 8])],
}


def test_rows_are_ranked_by_steps_and_references_stand_last():
    assert [row.name for row in rank(BOARD)] == ["<mine>", "good", "slow", "oracle"]


def test_a_row_of_several_seeds():
    row = rank(BOARD)[0]
    steps = np.array([[1, 2, 4, 9], [3, 2, 6, 9]])
    assert row.measures["steps_to_100"] == 36 / 8
    assert row.measures["steps_to_95"] == 28 / 8
    assert row.measures["steps_to_100_p90"] == 9
    assert row.measures["steps_to_100_iqm"] == (2 + 3 + 4 + 6) / 4
    mean = stats.interval(steps, np.mean)
    assert row.measures["steps_to_100_low"] == mean.low
    assert row.measures["steps_to_100_high"] == mean.high
    assert row.measures["useful_share"] == 1 / 4  # the other seed never communicated
    # against "good", the fastest planner: 3, 3, 5, 8
    assert row.measures["difference"] == 36 / 8 - 19 / 4
    difference = stats.paired_difference(steps, [3, 3, 5, 8])
    assert row.measures["difference_low"] == difference.low
    assert row.measures["improvement"] == ((1 + 0.5) + 2 + 1 + 0) / 8


def test_the_best_planner_is_compared_with_nothing_and_no_reference_is_it():
    rows = {row.name: row.measures for row in rank(BOARD)}
    assert math.isnan(rows["good"]["difference"])
    assert rows["oracle"]["difference"] == 1 - 19 / 4
    alone = rank({"<mine>": SEEDS})[0].measures
    assert math.isnan(alone["difference"])
    assert math.isnan(alone["improvement"])


def test_tables_show_the_numbers(tmp_path):
    rows = rank(BOARD)
    lines = format_text([rows]).splitlines()
    assert lines[0] == "tiny-v1: 4 arenas, 9 steps"
    assert lines[2].split()[:2] == ["policy", "sees"]
    assert [line.split()[0] for line in lines[4:7]] == ["<mine>", "good", "slow"]
    assert set(lines[7]) == {"-", " "}  # below the line: references
    assert lines[8].split()[0] == "oracle"
    good = dict(zip(COLUMNS, (cell(rows[1]) for cell in COLUMNS.values()), strict=True))
    low, high = (rows[1].measures[f"steps_to_100_{end}"] for end in ("low", "high"))
    assert good["steps to 100 %"] == f"4.8 [{low:.1f}, {high:.1f}]"
    assert good["to best planner"] == "-"
    assert good["communicate"] == "0.250"
    assert good["at 50"] == "-"  # the episodes are shorter
    assert r"| a\|b |" in format_markdown([rows])

    leaderboard.write_tables(tmp_path, [rows], {"command": "test"})
    saved = json.loads((tmp_path / "table.json").read_text())
    assert saved["run"] == {"command": "test"}
    assert [r["policy"] for r in saved["rows"]] == [row.name for row in rows]
    assert saved["rows"][0]["difference"] == 36 / 8 - 19 / 4
    assert saved["rows"][1]["difference"] is None
    with (tmp_path / "table.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert float(table[0]["steps_to_100"]) == 4.5
    assert (table[0]["seeds"], table[0]["suite"]) == ("2", "tiny-v1")
    assert table[1]["difference"] == ""
    assert (tmp_path / "table.txt").read_text() == format_text([rows])


def test_the_report_needs_nothing_else_and_escapes_names(tmp_path, monkeypatch):
    drawn = {}
    for name in ("coverage", "communication", "enlargement", "tradeoff"):
        figure = getattr(plots, f"{name}_figure")

        def spy(data, *rest, name=name, figure=figure):
            drawn[name] = data
            return figure(data, *rest)

        monkeypatch.setattr(plots, f"{name}_figure", spy)
    page = leaderboard.write_report(tmp_path / "a.html", [rank(BOARD)], "by <me>").read_text()
    assert page.count("data:image/svg+xml;base64,") == 4
    assert "http" not in page
    assert "&lt;mine&gt;" in page
    assert "<mine>" not in page
    assert "by &lt;me&gt;" in page
    assert page.count("<tbody>") == 2

    assert drawn["coverage"]["good"].value.tolist() == [0.1, 0.6]
    assert drawn["enlargement"]["<mine>"].tolist() == [0, 0, 0, 2, 0, 0, 0, 2]
    useful = drawn["communication"]["<mine>"]["useful_share"]
    assert useful[:4].tolist() == [0.25] * 4
    assert useful[4:].isnan().all()
    assert [curve.tolist() for curve in drawn["tradeoff"]["good"]] == [[0, 7], [0.1, 0.6]]


def test_the_share_of_finishable_arenas_is_shown_where_robots_failed(tmp_path):
    for name, fails in (("faulty-32", True), ("lidar-32", False)):
        cell = Cell("random", suite(name), num_arenas=4, steps=100, seed=0)
        results = leaderboard.make_cells(tmp_path, [cell], progress=False)
        rows = rank({"random": [results[cell]]})
        assert ("| finishable |" in format_markdown([rows])) is fails
        assert (" finishable " in format_text([rows])) is fails
