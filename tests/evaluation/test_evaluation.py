"""Evaluation: repeatable, on arenas apart from training's, and written in three forms."""

from __future__ import annotations

import csv
import itertools
import json

import pytest
import torch

from marl_explore import ArenaConfig, ExplorationEnv, arenas
from marl_explore.core.grid import COMMUNICATE, action_offsets
from marl_explore.core.mapping import target_cells
from marl_explore.evaluation.episodes import play, record, watch
from marl_explore.evaluation.registry import find_policy
from marl_explore.evaluation.results import evaluate, format_table, write_results

SMALL = ArenaConfig(height=7, width=7, num_agents=2)


def test_an_evaluation_repeats_and_leaves_the_random_state_alone():
    policy = find_policy("random", SMALL)
    torch.manual_seed(11)
    before = torch.get_rng_state()
    one = evaluate(policy, SMALL, num_arenas=10, steps=30)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(3)
    assert evaluate(policy, SMALL, num_arenas=10, steps=30) == one
    assert evaluate(policy, SMALL, num_arenas=10, steps=30, seed=1) != one


def test_policies_meet_the_same_arenas_and_not_those_of_training():
    test = [
        record(find_policy(name, SMALL), SMALL, num_arenas=10, steps=2)
        for name in ("random", "nearest")
    ]
    assert torch.equal(test[0].num_targets, test[1].num_targets)
    assert torch.equal(test[0].maps.known_cells[:, 0], test[1].maps.known_cells[:, 0])
    trained_on = ExplorationEnv(SMALL, num_envs=10).reset()["obstacles"]
    tested_on = ExplorationEnv(SMALL, num_envs=10, stream="test").reset()["obstacles"]
    assert not (trained_on == tested_on).flatten(1).all(-1).any()


def test_play_yields_the_reset_and_every_step_after_it():
    env = ExplorationEnv(SMALL, num_envs=3, terminate_at_coverage=1.0)
    steps = list(play(find_policy("nearest-timer", SMALL), env, steps=100, until_done=True))
    assert [int(s["step_count"].max()) for s in steps] == list(range(len(steps)))
    assert steps[-1]["done"].all()
    assert not steps[-2]["done"].all()


def test_observations_of_play_that_are_kept_hold_the_action_that_led_to_them():
    config = ArenaConfig(height=7, width=7, num_agents=3)
    steps = list(play(find_policy("nearest-timer", config), ExplorationEnv(config, 4), steps=30))
    assert ("agents", "action") not in steps[0].keys(True)
    for before, after in itertools.pairwise(steps):
        agents = after["agents"]
        way = action_offsets(torch.device("cpu"))[agents["action"]]
        way[agents["dangerous"]] = 0
        assert torch.equal(before["agents", "position"] + way, agents["position"])
        assert not (agents["merged"] & (agents["action"] != COMMUNICATE)).any()


def test_watch_shows_one_of_the_arenas_of_record_until_it_is_complete():
    policy = find_policy("nearest-timer", SMALL)
    arenas = ExplorationEnv(SMALL, num_envs=4, stream="test").reset()["obstacles"]
    before = torch.get_rng_state()
    steps = watch(policy, SMALL, arena_index=3)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(steps[0]["obstacles"][0], arenas[3])
    assert steps[-1]["terminated"].all()
    assert not steps[-2]["done"].any()
    again = watch(policy, SMALL, arena_index=3)
    assert torch.equal(again[-1]["agents", "map"], steps[-1]["agents", "map"])
    with pytest.raises(ValueError, match="arena_index=-1"):
        watch(policy, SMALL, arena_index=-1)


def test_a_suite_brings_its_arenas_robots_and_length():
    suite = arenas.suite("corridor-24")
    policy = find_policy("nearest", suite.config)
    episodes = record(policy, None, num_arenas=2, arenas="corridor-24")
    assert episodes.horizon == suite.steps == 500
    assert episodes.num_cells == 24 * 24
    env = ExplorationEnv(num_envs=2, arenas="corridor-24", stream="test")
    start = env.reset()
    target = target_cells(start["obstacles"], start["agents", "position"])
    assert torch.equal(episodes.num_targets, target.flatten(1).sum(-1))
    watched = watch(policy, None, arena_index=1, steps=3, arenas="corridor-24")
    assert torch.equal(watched[0]["obstacles"][0], start["obstacles"][1])


def test_results_are_written_as_text_json_and_csv(tmp_path):
    results = {"a": {"steps_to_95": 12.34, "useful_share": float("nan")}}
    results["b"] = {"steps_to_95": 7.0, "useful_share": 0.25}
    scores = {"a": {"steps_to_95": torch.tensor([12.0, 12.68])}}
    write_results(tmp_path, results, {"command": "test"}, scores)
    table = (tmp_path / "table.txt").read_text()
    assert table == format_table(results) + "\n"
    assert table.splitlines()[2].split() == ["a", "12.3", "-"]
    saved = json.loads((tmp_path / "results.json").read_text())
    assert saved["results"]["a"] == {"steps_to_95": 12.34, "useful_share": None}
    assert saved["run"] == {"command": "test"}
    assert saved["scores"]["a"]["steps_to_95"] == pytest.approx([12, 12.68])
    rows = list(csv.DictReader((tmp_path / "results.csv").read_text().splitlines()))
    assert [row["policy"] for row in rows] == ["a", "b"]
    assert float(rows[1]["useful_share"]) == 0.25


def test_an_unknown_policy_is_refused_with_what_there_is():
    with pytest.raises(ValueError, match=r"no policy 'nobody'.*planners: \['central'"):
        find_policy("nobody", SMALL)
