"""The recipes as a user runs them: small runs end to end, help, and wrong input."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from marl_explore import ArenaConfig
from marl_explore.arenas import load_map
from marl_explore.arenas.suites import SUITES
from marl_explore.planners import PLANNERS, Planner
from marl_explore.policies.io import load_policy
from marl_explore.robot import ExportedPolicy
from recipes import foreign_maps, pettingzoo_torchrl
from recipes import tune_planners as tune
from tests.helpers import oracle
from tests.helpers.programs import here, process

ROOT = Path(__file__).parents[1]
TINY = (
    "--height 6 --width 6 --num-agents 2 --hidden 16 16 --episodes 8 --episode-steps 20 "
    "--num-envs 4 --rollout-steps 20 --num-minibatches 1"
).split()


def recipe(name, *arguments, cwd=None):
    return here(f"recipes/{name}", *arguments, cwd=cwd)


def test_train_then_evaluate(tmp_path):
    trained = process("recipes/train.py", "fast", *TINY, "--seed", "3", "--out", tmp_path / "run")
    assert trained.returncode == 0, trained.stderr
    run = tmp_path / "run"
    config = json.loads((run / "config.json").read_text())
    assert config["seed"] == 3
    assert config["arena"]["height"] == 6
    record = json.loads((run / "run.json").read_text())
    (start,) = record["starts"]
    assert start["versions"]["torchrl"].startswith("0.14")
    assert "train.py fast" in start["command"]
    assert record["execution"]["collector"] == "process"
    assert record["frames"] == 160
    assert record["finished"]
    rewards = list(csv.reader((run / "scalars" / "reward.csv").read_text().splitlines()))
    assert [int(frames) for frames, _ in rewards] == [80, 160]
    assert load_policy(run).config.arena.num_agents == 2

    arena = "--num-arenas 5 --steps 20".split()  # the arena is the policy's own
    out = tmp_path / "table"
    evaluated = process("recipes/evaluate.py", run, "nearest", "random", *arena, "--out", out)
    assert evaluated.returncode == 0, evaluated.stderr
    results = json.loads((out / "results.json").read_text())
    assert list(results["results"]) == [str(run), "nearest", "random"]
    scores = results["scores"]["random"]["steps_to_100"]
    assert len(scores) == 5
    assert results["results"]["random"]["steps_to_100"] == pytest.approx(sum(scores) / 5)
    assert (out / "table.txt").read_text().strip() in evaluated.stdout
    assert len((out / "results.csv").read_text().splitlines()) == 4


def test_a_run_is_exported_for_numpy(tmp_path):
    trained = recipe("train.py", "fast", *TINY, "--out", tmp_path / "run")
    assert trained.returncode == 0, trained.stderr
    out = tmp_path / "exported"
    done = recipe("export.py", tmp_path / "run", "--kinds", "npz", "--out", out)
    assert done.returncode == 0, done.stderr
    assert ExportedPolicy(out / "policy.npz", 1).arena.height == 6
    assert "export.py" in json.loads((out / "export.json").read_text())["command"]


def test_train_and_evaluate_on_a_suite(tmp_path):
    tiny = (
        "--arenas corridor-24 --num-agents 2 --hidden 8 --episodes 2 --episode-steps 4 "
        "--num-envs 2 --rollout-steps 4 --num-minibatches 1"
    ).split()
    trained = recipe("train.py", "fast", *tiny, "--out", tmp_path / "run")
    assert trained.returncode == 0, trained.stderr
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["arenas"] == "corridor-24-v1"  # later versions do not change what this run was
    assert config["arena"]["height"] == config["arena"]["width"] == 24

    few = "--num-arenas 2 --steps 3 --out".split()
    for name, arenas in {"own": [], "named": ["--arenas", "open-24"]}.items():
        done = recipe("evaluate.py", tmp_path / "run", *arenas, *few, tmp_path / name)
        assert done.returncode == 0, done.stderr
    settings = {
        name: json.loads((tmp_path / name / "results.json").read_text())["run"]["settings"]
        for name in ("own", "named")
    }
    assert settings["own"]["arenas"] == "corridor-24-v1"  # those the policy was trained on
    assert settings["named"]["arenas"] == "open-24-v1"
    assert settings["named"]["arena"]["obstacle_density"] == 0.1
    assert settings["named"]["arena"]["num_agents"] == 2  # the policy's


def test_a_sweep_is_gone_on_with_by_the_same_command_as_a_run(tmp_path):
    folder = tmp_path / "sweep"
    swept = recipe("train.py", "fast", *TINY, "--seeds", "0,4", "--out", folder)
    assert swept.returncode == 0, swept.stderr
    assert "seed 4: done" in swept.stdout
    assert "episode_return" in swept.stdout
    (folder / "seed-4" / "policy.safetensors").unlink()
    record = folder / "seed-4" / "run.json"
    record.write_text(record.read_text().replace('"finished": true', '"finished": false'))
    resumed = recipe("train.py", "resume", folder)
    assert resumed.returncode == 0, resumed.stderr
    assert resumed.stdout.startswith("seed 4: done")
    assert load_policy(folder / "seed-4").config.arena.num_agents == 2


def test_demo_makes_table_figure_and_animation(tmp_path):
    folder = tmp_path / "demo"
    folder.mkdir()
    (folder / "demo.txt").write_text("of an earlier demonstration")
    (folder / "old.png").write_text("of an earlier demonstration")
    done = recipe("demo.py", "--out", folder, "--episodes", "32", "--num-arenas", "4")
    assert done.returncode == 0, done.stderr
    assert not (folder / "old.png").exists()
    assert (folder / "table.txt").read_text().strip() in done.stdout
    assert (folder / "coverage.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "episode.gif").read_bytes().startswith(b"GIF8")
    page = (folder / "replay.html").read_text()
    assert '"name":"learned"' in page
    assert '"name":"best"' in page
    assert str(Path("demo", "replay.html")) in done.stdout
    results = json.loads((folder / "results.json").read_text())["results"]
    assert list(results) == [
        "learned",
        "best",
        "random",
        "nearest",
        "nearest-timer",
        "utility-cost",
    ]


def test_runs_are_held_against_the_paper_and_bundled(tmp_path):
    run = tmp_path / "run"
    assert recipe("train.py", "fast", *TINY, "--out", run).returncode == 0
    names = [f"{network}-{case}={run}" for network in ("mlp", "cnn") for case in ("case1", "case2")]
    copy = tmp_path / "other" / run.name
    shutil.copytree(run, copy)
    names[0] += f",{copy}"
    done = recipe("paper.py", *names, "--num-arenas", "3", "--out", "paper", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    claims = (tmp_path / "paper" / "claims.md").read_text()
    assert claims in done.stdout
    rows = claims.splitlines()[2:]
    assert len(rows) == 9
    cells = {row.split("|")[1].strip(): [x.strip() for x in row.split("|")[2:-1]] for row in rows}
    assert {row[-2] for row in cells.values()} <= {"yes", "no"}
    assert all(0 <= float(row[-1]) <= 1 for row in cells.values())
    assert all("[" in cell for row in cells.values() for cell in row[:4])
    ahead = cells["case 1 communicates more than case 2"]
    assert ahead[4:] == ["no", "0.000"]  # the four are one policy
    for figure in ("coverage", "communication", "enlargements"):
        assert (tmp_path / "paper" / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
    results = json.loads((tmp_path / "paper" / "results.json").read_text())["results"]
    assert list(results) == ["mlp-case1", "mlp-case2", "cnn-case1", "cnn-case2"]
    assert list(results["mlp-case1"]) == [str(run), str(copy)]  # though both are called "run"
    names[0] += f",{run}"
    done = recipe("paper.py", *names, "--num-arenas", "3", "--out", "twice", cwd=tmp_path)
    assert done.returncode == 1
    assert "each may appear only once" in done.stderr
    assert not (tmp_path / "twice").exists()
    done = recipe("bundle.py", f"small={run}", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "small.safetensors").is_file()


def test_a_sweep_does_not_go_on_from_previous_checkpoints(tmp_path):
    (tmp_path / "sweep.json").write_text('{"seeds": [0], "jobs": 1, "starts": []}')
    refused = recipe("train.py", "resume", tmp_path, "--from-previous", "True")
    assert refused.returncode == 1
    assert "from_previous=True is not allowed for the sweep" in refused.stderr
    assert json.loads((tmp_path / "sweep.json").read_text())["starts"] == []


def test_variants_are_held_against_a_baseline(tmp_path):
    swept = recipe("train.py", "fast", *TINY, "--seeds", "0-1", "--out", "sweep", cwd=tmp_path)
    assert swept.returncode == 0, swept.stderr
    deaf = ["--communication-range", "0", "--out", "deaf"]
    assert recipe("train.py", "fast", *TINY, *deaf, cwd=tmp_path).returncode == 0
    entries = "base=sweep deaf=deaf random --num-arenas 2 --out compared".split()
    done = recipe("variants.py", *entries, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "compared"
    table = (folder / "variants.md").read_text()
    assert table in done.stdout
    base, other, walk = table.splitlines()[2:]
    assert base.startswith("| base | baseline: height=6, ")
    assert other.startswith("| deaf | communication_range=0.0 | 1 |")
    assert walk.startswith("| random | planner random | - |")
    assert (folder / "variants.png").read_bytes().startswith(b"\x89PNG")
    content = json.loads((folder / "results.json").read_text())
    assert "variants.py base=sweep" in content["command"]
    assert list(content["results"]) == ["base", "deaf", "random"]
    assert list(content["results"]["base"]["seeds"]) == [
        str(Path("sweep", f"seed-{seed}")) for seed in (0, 1)
    ]

    record = tmp_path / "sweep" / "seed-1" / "run.json"
    record.write_text(record.read_text().replace('"finished": true', '"finished": false'))
    refused = recipe("variants.py", "base=sweep", "--out", "again", cwd=tmp_path)
    assert refused.returncode == 1
    assert refused.stderr.startswith("error: seeds [1] of the sweep in sweep are not finished")
    assert not (tmp_path / "again").exists()


def test_replay_shows_every_policy_and_how_it_was_made(tmp_path):
    small = (
        "--height 6 --width 8 --num-agents 2 --arena-index 3 --steps 20 --out new/a.html".split()
    )
    done = recipe("replay.py", "nearest-timer", "random", *small, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(Path("new", "a.html"))
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.html"]
    page = (tmp_path / "new" / "a.html").read_text()
    assert '"name":"nearest-timer","height":6,"width":8' in page
    assert '"name":"random"' in page
    assert "--arena-index 3 --steps 20" in page


def test_leaderboard_goes_on_where_it_was(tmp_path):
    small = "--suites paper-12 corridor-24 --num-arenas 2 --steps 20 --out board".split()
    done = recipe("leaderboard.py", "nearest", *small[:2], *small[3:], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    board = tmp_path / "board"
    (old,) = (board / "cells").iterdir()
    kept = old.stat().st_mtime_ns

    done = recipe("leaderboard.py", "nearest", "two=best,best:argmax", *small, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert old.stat().st_mtime_ns == kept  # read, not measured again
    assert len(list((board / "cells").iterdir())) == 6
    assert (board / "table.txt").read_text() in done.stdout
    rows = json.loads((board / "table.json").read_text())["rows"]
    assert {(row["suite"], row["policy"], row["seeds"]) for row in rows} == {
        (suite, *entry)
        for suite in ("paper-12-v1", "corridor-24-v1")
        for entry in (("nearest", 1), ("two", 2))
    }
    page = (board / "report.html").read_text()
    assert "corridor-24-v1: 2 arenas, 20 steps" in page
    assert "two=best,best:argmax" in page

    refused = recipe("leaderboard.py", "nearest", *small, "--seed", "5", cwd=tmp_path)
    assert refused.returncode == 1
    assert "seed was 0 and now is 5" in refused.stderr
    assert "Traceback" not in refused.stderr


def test_a_leaderboard_of_map_files(tmp_path):
    (tmp_path / "maps").mkdir()
    for name in "ab":
        (tmp_path / "maps" / f"{name}.txt").write_text("........\n..##....\n........\n")
    words = ("nearest-timer", "random", "--suites", "maps", "--steps", "40", "--out", "board")
    for _ in range(2):  # the second time every cell is there
        done = recipe("leaderboard.py", *words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    cells = sorted(path.name for path in (tmp_path / "board" / "cells").iterdir())
    assert [name.partition("--maps-")[0] for name in cells] == ["nearest-timer", "random"]
    told = json.loads((tmp_path / "board" / "cells" / cells[0]).read_text())
    assert told["settings"]["num_arenas"] == 2


def test_a_leaderboard_without_further_words_is_of_all_suites_for_any_robots(tmp_path):
    few = ("--num-arenas", "1", "--steps", "2")
    done = recipe("leaderboard.py", "random", *few, "--out", "board", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "board" / "table.json").read_text())["rows"]
    assert {row["suite"] for row in rows} == {e.id for e in SUITES if not e.brings_robots}


def test_leaderboard_does_not_write_into_a_folder_of_other_things(tmp_path):
    (tmp_path / "table.txt").write_text("mine")
    done = recipe("leaderboard.py", "nearest", "--out", tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("error: output folder")
    assert [p.name for p in tmp_path.iterdir()] == ["table.txt"]


def test_demo_does_not_replace_a_folder_it_did_not_make(tmp_path):
    (tmp_path / "precious.txt").write_text("mine")
    done = recipe("demo.py", "--out", tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("error: output folder")
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]


def test_minimal_happo_learns_within_100_lines():
    source = (ROOT / "recipes" / "minimal_happo.py").read_text()
    assert len(source.splitlines()) <= 100
    assert "marl_explore.training.trainer" not in source
    done = subprocess.run(
        [sys.executable, "-c", "import minimal_happo; print('last', minimal_happo.main(40))"],
        capture_output=True,
        text=True,
        cwd=ROOT / "recipes",
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    lengths = [float(line.split()[-6]) for line in done.stdout.splitlines() if "update" in line]
    assert lengths[-1] < 0.8 * lengths[0]


def test_torchrl_learns_through_the_pettingzoo_wrapper():
    returns = pettingzoo_torchrl.main(updates=12)
    assert len(returns) == 12
    assert sum(returns[-4:]) / 4 > sum(returns[:4]) / 4 + 0.1


def test_map_files_become_a_buffer_with_features(tmp_path):
    (tmp_path / "cave.txt").write_text("....#...\n" * 7)
    (tmp_path / "hall.map").write_text(
        "type octile\nheight 2\nwidth 20\nmap\n" + f"{'.' * 20}\n" * 2
    )
    paths = [tmp_path / "cave.txt", tmp_path / "hall.map"]
    sample = foreign_maps.map_buffer([load_map(path) for path in paths], robots=3).sample()
    assert sample["grid"].shape == (2, 3, 7, 20)
    assert (sample["grid"] == -1).any()
    for team in sample:
        for robot in range(3):
            place = tuple(team["at"][robot].tolist())
            expected = oracle.feature_table(team["grid"][robot].tolist(), place, None)
            torch.testing.assert_close(team["fpr"][robot], torch.tensor(expected))
        far = torch.cdist(team["at"].double(), team["at"].double()) > foreign_maps.RANGE_CELLS
        assert torch.equal(team["net"] == 0, far)

    done = recipe("foreign_maps.py", "files", *paths)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line for line in lines if line.startswith(str(tmp_path))] == [*map(str, paths)]
    assert sum(line.split()[0].isdigit() for line in lines) == 8


@pytest.mark.parametrize(
    "name",
    [
        "train.py",
        "train_ray.py",
        "evaluate.py",
        "replay.py",
        "bundle.py",
        "mixed_teams.py",
        "demo.py",
        "leaderboard.py",
        "paper.py",
        "variants.py",
        "tune_planners.py",
        "minimal_happo.py",
        "pettingzoo_torchrl.py",
        "foreign_maps.py",
        "happo_vmas.py",
        "happo_pettingzoo.py",
        "benchmarl_exploration.py",
    ],
)
def test_help(name):
    done = recipe(name, "--help")
    assert done.returncode == 0
    assert "usage:" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train.py", "fastest"], "fastest"),
        (["train.py", "fast", "--gamma", "2"], "gamma=2.0"),
        (["train.py", "fast", "--num-agents", "500"], "num_agents=500"),
        (["train.py", "fast", "--obstacle-density", "0.9"], "obstacle_density=0.9"),
        (["train.py", "fast", "--arenas", "rooms"], "arenas='rooms' is not a suite"),
        (["train.py", "fast", "--arenas=rooms-32", "--height", "9"], "error: height=9"),
        (["evaluate.py", "random", "--arenas", "rooms-32", "--width", "9"], "error: width=9"),
        (["evaluate.py", "random", "--arenas", "maze-32", "--obstacle-density", "0.1"], "has 0.27"),
        (["leaderboard.py", "random", "--suites", "uniform"], "arenas='uniform' is not a suite"),
        (["train.py", "fast", "--reward", "fame"], "reward='fame' is unknown"),
        (["evaluate.py", "nobody"], "no policy 'nobody'"),
        (["evaluate.py"], "name at least one policy"),
        (["evaluate.py", "random", "--num-arenas", "0"], "num_arenas=0"),
        (["evaluate.py", "random", "--steps", "-1"], "steps=-1"),
        (["replay.py", "nobody"], "no policy 'nobody'"),
        (["replay.py"], "name at least one policy"),
        (["replay.py", "random", "--arena-index", "-1"], "arena_index=-1"),
        (["replay.py", "random", "--steps", "0"], "steps=0"),
        (["leaderboard.py", "nobody"], "no policy 'nobody'"),
        (["leaderboard.py", "random", "--suites", "rooms"], "arenas='rooms' is not a suite"),
        (["leaderboard.py", "random", "--num-arenas", "0"], "num_arenas=0"),
        (["benchmarl_exploration.py"], "needs benchmarl: docs/happo.md"),
        (["benchmarl_exploration.py", "--iterations", "0"], "iterations=0"),
        (["train.py", "fast", "--threads", "0"], "threads=0"),
        (["train.py", "fast", "--workers", "2"], "workers=2 is not allowed with collector='pr"),
        (["train.py", "fast", "--collector", "multisync", "--workers", "5"], "workers=5"),
        (["train.py", "fast", "--seeds", "4-"], "seeds='4-' is not allowed"),
        (["train.py", "fast", "--jobs", "0"], "jobs=0"),
        (["train.py", "resume", "nowhere"], "nowhere is not a run folder"),
        (["paper.py", "mlp=run"], "policies=['mlp'] is not allowed"),
        (["variants.py"], "name at least one training"),
        (["variants.py", "random"], "'random' is a planner: the baseline must be a trained"),
        (["variants.py", "a=best", "a=paper-cnn-case2"], "policies='a' is given twice"),
        (["variants.py", "a=nowhere"], "no policy 'nowhere'"),
        (["variants.py", "best", "--num-arenas", "0"], "num_arenas=0"),
        (["bundle.py", "run"], "policies='run' is not allowed: use NAME=RUN"),
        (["bundle.py", "name=nowhere"], "nowhere is not a run folder"),
        (["demo.py", "--num-arenas", "0"], "num_arenas=0"),
        (["demo.py", "--episodes", "1"], "episodes=1"),
    ],
)
def test_wrong_input_is_one_error_and_leaves_nothing(tmp_path, arguments, message):
    name, *rest = arguments
    done = recipe(name, *rest, cwd=tmp_path)
    assert done.returncode != 0
    flat = " ".join(done.stderr.replace("│", " ").split())
    assert message in flat
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_use_is_refused_before_training(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    done = recipe("train.py", "fast", *TINY, "--out", tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("error: output folder")
    assert [p.name for p in tmp_path.iterdir()] == ["config.json"]


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    (tmp_path / "policy.safetensors").write_bytes(b"\x00" * 100)
    done = recipe("evaluate.py", tmp_path)
    assert done.returncode == 1
    assert "is not a readable policy file" in done.stderr


def test_settings_of_a_planner_are_compared():
    few = ["--num-arenas", "2", "--steps", "5"]
    done = recipe("tune_planners.py", "hedac", "--rules", "timer 5", "gain 10", *few)
    assert done.returncode == 0, done.stderr
    settings = [line.strip().split("  ")[0] for line in done.stdout.splitlines()[2:]]
    assert settings == [
        f"{rule}, loss {loss}" for rule in ("timer 5", "gain 10") for loss in (0.02, 0.05, 0.2)
    ]
    refused = recipe("tune_planners.py", "nobody")
    assert refused.returncode == 1
    assert "planner='nobody' is not one of ['nearest'" in refused.stderr
    refused = recipe("tune_planners.py", "hedac", "--rules", "smoke")
    assert "rules='smoke' is not one of ['never'" in refused.stderr


def test_all_planners_with_settings_can_be_compared():
    config = ArenaConfig()
    # recipes/search_goal_utility.py searches the weights of goal-utility
    assert {*tune.families(config)} == {*PLANNERS} - {"random", "goal-utility"}
    for name in tune.families(config):
        found = tune.candidates(tune.Arguments(name), config)
        assert all(isinstance(planner, Planner) for planner in found.values())
        rules = 1 if name in tune.REFERENCES else len(tune.rules())
        assert len(found) % rules == 0


def test_algorithms_are_compared_on_a_team_of_unlike_robots(tmp_path):
    words = (
        "--team one-mapper --algorithms happo mappo --seeds 1 --episodes 2 --num-envs 12 "
        "--validation-arenas 6 --num-arenas 6 --out unlike"
    ).split()
    done = recipe("mixed_teams.py", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    place = tmp_path / "unlike" / "one-mapper"
    assert (place / "tables.md").read_text().strip() in done.stdout
    content = json.loads((place / "results.json").read_text())
    assert [*content["results"]] == ["happo", "mappo"]
    for found in content["results"].values():
        assert [*found["steps_to_100"]] == ["16 x 16", "32 x 32"]
        for steps in found["steps_to_100"].values():
            assert [len(each) for each in steps] == [6]
    assert content["results"]["happo"]["factor_max"][0] > 1
    assert content["results"]["mappo"]["factor_max"] == [1]
    happo, mappo = (load_policy(place / name / "seed-1").config for name in ("happo", "mappo"))
    assert happo.groups == ((0, 1, 2), (3,))
    assert mappo.network.reads_sensor
    assert mappo.shared
    assert not happo.network.reads_sensor
    first = {path: path.stat().st_mtime_ns for path in place.rglob("policy.safetensors")}
    assert len(first) == 2
    again = recipe("mixed_teams.py", *words, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert {path: path.stat().st_mtime_ns for path in first} == first
    assert json.loads((place / "results.json").read_text())["results"] == content["results"]
