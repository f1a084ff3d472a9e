"""Options from files, and errors in one line."""

from __future__ import annotations

import json
import sys

import pytest

import marl_explore
from marl_explore.cli import bundle, evaluate, export, lab, leaderboard, paper, replay, resume

from marl_explore.cli import demo, explore, train, variants  # isort: skip
from marl_explore.cli.common import run_program
from marl_explore.config.run import RunConfig
from marl_explore.training.run_folder import prepare
from tests.helpers.configs import NETWORKS, tiny

FILES = {
    "bundle": (bundle, {"policies": ["a=b"], "out": "o"}),
    "demo": (demo, {"seed": 3}),
    "evaluate": (evaluate, {"policies": ["random"], "steps": 7, "height": 20}),
    "explore": (explore, {"maps": "plan.png", "cell_size": "5e-1"}),
    "export": (export, {"policy": "best", "kinds": "npz"}),
    "lab": (lab, {"policy": "best", "range_share": 0.5}),
    "leaderboard": (leaderboard, {"policies": ["random"], "suites": ["paper-12"], "num-arenas": 4}),
    "paper": (paper, {"policies": ["mlp-case1=a"], "seed": 4}),
    "replay": (replay, {"policies": "random", "arena_index": 3}),
    "resume": (resume, {"folder": "runs/a", "episodes": 7}),
    "variants": (variants, {"entries": ["a=b"], "seed": 5}),
}


@pytest.mark.parametrize("command", FILES)
def test_every_command_takes_its_options_from_a_file(tmp_path, command):
    module, options = FILES[command]
    path = tmp_path / "run.yaml"
    path.write_text(json.dumps(options))
    parsed = module.parse(["--config", str(path)])
    shown = repr(parsed)
    for name, value in options.items():
        for part in value if isinstance(value, list) else [value]:
            assert str(part).removesuffix("e-1") in shown, name


def test_a_file_may_have_settings_of_each_robot(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("sensing_range: [1.1, 2, 3.0, 3]\nmove_period: [1, 1, 2, 2]\n")
    arena = train.parse(["fast", "--config", str(path)]).train.arena
    assert arena.sensing_range == (1.1, 2, 3.0, 3)
    assert arena.move_period == (1, 1, 2, 2)
    path.write_text("sensing_range: 2.0\n")
    assert train.parse(["fast", "--config", str(path)]).train.arena.sensing_range == 2.0


def test_flags_replace_what_a_file_says(tmp_path):
    path = tmp_path / "run.yaml"
    path.write_text("actor_lr: 1e-3\nepisodes: 64\narena: {height: 9}\n")
    start = train.parse(["fast", "--config", str(path), "--height", "10"])
    assert (start.train.actor_lr, start.train.episodes, start.train.arena.height) == (1e-3, 64, 10)
    assert start.train.gamma == marl_explore.PRESETS["fast"].gamma


@pytest.mark.parametrize("network", NETWORKS)
def test_a_runs_own_config_is_accepted_back(tmp_path, network):
    config = tiny(
        network=NETWORKS[network],
        critic_input="state",
        ablate=("net",) if "net" in NETWORKS[network].features else (),
        gamma=0.5,
    )
    folder = prepare(config, tmp_path / "run", RunConfig())
    assert train.parse([f"--config={folder / 'config.json'}"]).train == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unknown: 1", "unknown option 'unknown'"),
        ("actor_lr: fast", "actor_lr='fast' is not allowed: it must be a number"),
        ("network: transformer", "network='transformer' is not allowed: it must be one of"),
        ("out: 5", "out=5 is not allowed: it must be a path"),
        ("seeds: [0, 1]", r"seeds=\[0, 1\] is not allowed: it must be text"),
        ("episodes: 2\nepisodes: 4", "the key 'episodes' stands there twice"),
        ("episodes: -1", "episodes=-1 is not allowed"),
        ("episodes: [1]", r"episodes=\[1\] is not allowed: it must be an integer"),
        ("seed: 1\narena: {seed: 2}", "has the option 'seed' twice"),
        ("- 1", "must be a mapping of options"),
        ("a: [", "cannot be read as YAML"),
        ("architecture: gnn\nhidden: [3]", "architecture='gnn'"),
    ],
)
def test_what_a_file_cannot_say_is_refused_by_its_name(tmp_path, text, message):
    path = tmp_path / "run.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as refused:
        train.parse(["fast", "--config", str(path)])
    assert str(path) in str(refused.value) or "architecture" in message


@pytest.mark.parametrize(
    ("module", "options", "message"),
    [
        (export, {"policy": "best", "kinds": ["zip"]}, r"kinds=\('zip',\) is not allowed"),
        (export, {"policy": [1]}, r"policy=\[1\] is not allowed: it must be text"),
        (evaluate, {"policies": None}, r"policies=\(None,\) is not allowed"),
        (evaluate, {"policies": [["random"]]}, r"policies=\(\['random'\],\) is not allowed"),
        (resume, {"folder": None}, "folder=None is not allowed: it must be a path"),
        (leaderboard, {"out": None}, "out=None is not allowed: it must be a path"),
        (explore, {"maps": 5}, "maps=5 is not allowed: it must be a path"),
        (leaderboard, {"threads": 10**9}, "threads=1000000000 is not allowed"),
    ],
)
def test_values_in_a_file_are_checked_like_those_of_flags(tmp_path, module, options, message):
    path = tmp_path / "run.yaml"
    path.write_text(json.dumps(options))
    with pytest.raises(ValueError, match=f"{path}: {message}"):
        module.parse(["--config", str(path)])


@pytest.mark.parametrize(
    ("module", "line", "message"),
    [
        (train, "fast --config", "--config is not allowed without a file"),
        (train, "fast --config a --config b", "a cannot be read|--config is not allowed twice"),
        (train, "fast --config nowhere.yaml", "nowhere.yaml cannot be read"),
        (train, "resume run --config a.yaml", "a.yaml cannot be read"),
        (train, "fast --seed -1", "^seed=-1 is not allowed"),
        (train, "fast --height 0", "^height=0 is not allowed"),
        (train, "fast --hidden 0", "^hidden=0 is not allowed"),
        (train, "fast --actor-lr inf", "^actor_lr=inf is not allowed"),
        (train, "fast --out=", "^'--out=' is not allowed"),
        (train, "fast --seeds 0-99999999999", "^seeds='0-99999999999' is not allowed"),
        (export, "best --kinds", r"^kinds=\(\) is not allowed"),
        (leaderboard, "random --suites", r"^suites=\(\) is not allowed"),
        (replay, f"random --arena-index {10**22}", "^arena_index=1000.* is not allowed"),
        (evaluate, "random --sensing-range nan", "^sensing_range=nan is not allowed"),
    ],
)
def test_a_wrong_line_is_refused_in_words_of_its_own(module, line, message):
    with pytest.raises(ValueError, match=message):
        module.parse(line.split())


def test_what_is_no_option_still_gets_the_parsers_message(capsys):
    with pytest.raises(SystemExit) as ended:
        train.parse(["fast", "--sed", "1"])
    assert ended.value.code == 2
    assert "--sed" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        train.parse(["fast", "--seed", "x"])
    assert "invalid literal" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a/../x=r"], "name='a/../x' is not allowed"),
        (["../x=r"], "name='../x' is not allowed"),
        (["=r"], "use NAME=RUN"),
        (["a=r", "a=s"], "give each name once"),
    ],
)
def test_names_of_bundled_policies_stay_in_their_folder(tmp_path, words, message):
    out = tmp_path / "o"
    with pytest.raises(ValueError, match=message):
        bundle.run(bundle.parse([*words, "--out", str(out)]))
    assert not list(tmp_path.iterdir())


def test_missing_packages_and_memory_end_in_one_line():
    for error, said in (
        (ModuleNotFoundError("pip install it"), "error: pip install it"),
        (MemoryError(), "error: MemoryError"),
    ):

        def fail(error=error):
            raise error

        with pytest.raises(SystemExit) as ended:
            run_program(fail, sys.exit)
        assert ended.value.code == said
