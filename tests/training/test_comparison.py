"""Variants of a training: what they are called by, and what they come to over seeds."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest

from marl_explore import ArenaConfig
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.results import evaluate
from marl_explore.policies.io import load_policy, save_policy
from marl_explore.policies.networks import MLP
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.training import comparison
from marl_explore.training.config import TrainConfig

SMALL = ArenaConfig(height=5, width=5, num_agents=2)
BASE = TrainConfig(arena=SMALL, network=MLP(hidden=(8,)))
OPTIONS = {"num_arenas": 3, "steps": 300, "seed": 4}


@pytest.fixture
def trained(tmp_path):
    """Writes a policy of a configuration, with the weights it was born with."""

    def write(name, config=BASE, **changes):
        config = replace(config, **changes)
        built = PolicyConfig(config.arena, config.network, config.fpr, config.ablate)
        policy = Policy(built, built.make_actors())
        path = tmp_path / f"{name}.safetensors"
        return str(save_policy(policy, path, {"config": config.to_json()}))

    return write


def test_a_variant_is_what_differs_from_the_baseline(trained):
    far = replace(SMALL, communication_range=math.inf)
    found = comparison.find_variants(
        {
            "base": [trained("a"), trained("b", seed=1)],
            "same": [trained("c", seed=5)],
            "far": [trained("d", reward="team", arena=far)],
            "walk": ["random"],
        }
    )
    assert [dict(variant.settings) for variant in found] == [
        {"height": 5, "width": 5, "num_agents": 2, "hidden": (8,)},
        {},
        {"communication_range": math.inf, "reward": "team"},
        {},
    ]
    assert [variant.planner for variant in found] == [False, False, False, True]
    assert found[3].config.arena == SMALL


def test_every_bundled_policy_says_what_it_is():
    names = ("paper-mlp-case2", "paper-cnn-case2", "best")
    found = comparison.find_variants({name: [name] for name in names})
    reading = {"fpr": "proximity", "gamma": 0.9}  # beside the defaults
    assert [dict(variant.settings) for variant in found[:2]] == [reading, {"network": "cnn"}]
    assert found[2].settings["algorithm"] == "mappo"


def test_seeds_are_averaged_and_held_against_the_baseline(trained):
    entries = {
        "base": [trained("a"), trained("b", seed=1)],
        "silent": [trained("c", ablate=("communication",)), trained("d", seed=1)],
        "random": ["random"],
    }
    with pytest.raises(ValueError, match=r"seeds of 'silent' differ.*d\.safetensors has ablate="):
        comparison.find_variants(entries)
    entries["silent"][1] = trained("d", seed=1, ablate=("communication",))
    reported = []
    found = comparison.find_variants(entries)
    base, silent, walk = comparison.compare(found, **OPTIONS, report=reported.append)
    assert len(reported) == 5

    alone = [evaluate(load_policy(path), SMALL, **OPTIONS) for path in entries["base"]]
    assert list(base.seeds.values()) == alone
    steps = [measures["steps_to_100"] for measures in alone]
    assert base.means["steps_to_100"] == (sum(steps) / 2, min(steps), max(steps))
    assert base.differences == {}

    assert silent.means["communication_share"] == (0, 0, 0)
    assert math.isnan(silent.means["useful_share"].value)
    others = [measures["steps_to_100"] for measures in silent.seeds.values()]
    difference = silent.differences["steps_to_100"]
    assert difference.value == pytest.approx(sum(others) / 2 - sum(steps) / 2)
    assert difference.low == pytest.approx(min(others) - max(steps))
    assert difference.high == pytest.approx(max(others) - min(steps))

    assert walk.seeds["random"] == evaluate(find_policy("random", SMALL), SMALL, **OPTIONS)
    assert math.isnan(walk.differences["steps_to_100"].low)


def test_the_table_and_the_record_say_all_of_it(trained):
    entries = {"base": [trained("a")], "twin": [trained("b", seed=1)], "random": ["random"]}
    rows = comparison.compare(comparison.find_variants(entries), **OPTIONS, report=lambda _: None)
    header, _, *lines = comparison.format_markdown(rows).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [row[:3] for row in cells] == [
        ["base", "baseline: height=5, width=5, num_agents=2, hidden=(8,)", "1"],
        ["twin", "same as the baseline", "1"],
        ["random", "planner random", "-"],
    ]
    assert header.endswith("| at 150 - baseline | steps to 100 % - baseline |")
    assert cells[0][-2:] == ["-", "-"]
    assert cells[2][-1][0] in "+-"
    assert "[" not in "".join(lines)  # one seed has no interval
    content = json.loads(json.dumps(comparison.as_record(rows[1]), allow_nan=False))
    assert content["config"]["seed"] == 1
    assert content["means"]["complete"]["low"] is None
    assert comparison.as_record(rows[2])["config"] is None


@pytest.mark.parametrize(
    ("policies", "message"),
    [
        (["b", "b"], r"seeds \[0, 0\] of 'other' are not allowed: each may appear only once"),
        (["large"], "'other' cannot be compared with 'base': it has other arenas, height=6"),
        (["random", "b"], "a planner has no seeds"),
        (["nameless"], r"nameless\.safetensors has no configuration of this version: KeyError"),
        (["newer"], r"newer\.safetensors has no configuration of this version.*'colour'"),
    ],
)
def test_what_cannot_be_compared_is_refused(trained, tmp_path, policies, message):
    paths = {
        "b": trained("b"),
        "large": trained("large", arena=replace(SMALL, height=6)),
        "random": "random",
        "nameless": str(tmp_path / "nameless.safetensors"),
        "newer": str(tmp_path / "newer.safetensors"),
    }
    policy = load_policy(paths["b"])
    save_policy(policy, paths["nameless"])
    save_policy(policy, paths["newer"], {"config": BASE.to_json() | {"colour": "red"}})
    entries = {"base": [trained("a")], "other": [paths[name] for name in policies]}
    with pytest.raises(ValueError, match=message):
        comparison.find_variants(entries)


def test_a_planner_is_no_baseline():
    with pytest.raises(ValueError, match="'nearest' is a planner: the baseline must be a trained"):
        comparison.find_variants({"walk": ["nearest"]})
