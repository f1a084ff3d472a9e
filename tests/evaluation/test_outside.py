"""Policies of other packages: found by name, called with what a robot observes, and checked."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from marl_explore import ArenaConfig, make_env, parallel_env
from marl_explore.evaluation import leaderboard
from marl_explore.evaluation.episodes import record, watch
from marl_explore.evaluation.leaderboard import Cell, cells
from marl_explore.evaluation.registry import find_policy, is_outside
from marl_explore.evaluation.results import evaluate
from marl_explore.policies.observations import robot_observation
from tests.evaluation.test_leaderboard import PAPER

DATA = Path(__file__).parents[1] / "data" / "outside"
SMALL = ArenaConfig(height=8, width=8, num_agents=3)


@pytest.fixture(autouse=True)
def agents(monkeypatch):
    """The module ``explorers.agents``, as another package that is installed."""
    monkeypatch.syspath_prepend(DATA)
    from explorers import agents

    agents.made.clear()
    agents.seen.clear()
    return agents


@pytest.mark.parametrize(
    ("name", "outside"),
    [
        ("mypackage.agents:Explorer", True),
        ("agents:make.walk", True),
        ("best:argmax", False),
        ("runs/a:argmax", False),
        ("runs.a:argmax", False),
        ("nearest-timer", False),
        ("runs/a:b", False),
        ("my-package:walk", False),
        ("a:", False),
    ],
)
def test_names_of_modules_and_attributes(name, outside):
    assert is_outside(name) is outside


@pytest.mark.parametrize(
    "name", ["explorers.agents:walk", "explorers.agents:Greedy", "explorers.teams:Counting"]
)
def test_policies_of_others_are_evaluated_and_repeat(name):
    before = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state()
    one, two = (
        record(find_policy(name, SMALL), SMALL, num_arenas=4, steps=25, seed=3) for _ in range(2)
    )
    assert one.action.equal(two.action)
    assert len(one.action.unique()) > 3
    assert random.getstate() == before[0]
    assert np.random.get_state()[1].tolist() == before[1]
    assert torch.get_rng_state().equal(before[2])
    other = record(find_policy(name, SMALL), SMALL, num_arenas=4, steps=25, seed=4)
    assert not other.action.equal(one.action)


@pytest.mark.parametrize("name", ["walk", "Greedy"])
def test_robots_of_others_act_alike_in_any_batch(name):
    policy = find_policy(f"explorers.agents:{name}", SMALL)
    all_arenas = record(policy, SMALL, num_arenas=4, steps=25)
    alone = watch(policy, SMALL, arena_index=2, steps=25)
    actions = torch.stack([step["agents", "action"][0] for step in alone[1:]])
    assert all_arenas.action[2, : len(actions)].equal(actions)


def test_a_class_is_made_for_every_robot_and_episode(agents):
    policy = find_policy("explorers.agents:Greedy", SMALL)
    agents.made.clear()
    for _ in range(2):
        record(policy, SMALL, num_arenas=2, steps=3)
    assert [robot for robot, _ in agents.made] == [0, 1, 2] * 4
    seeds = [seed for _, seed in agents.made]
    assert len(set(seeds)) == 6
    assert seeds[:6] == seeds[6:]
    assert min(seeds) >= 0
    assert policy.sees == "its frontier table"
    assert evaluate(policy, SMALL, num_arenas=3, steps=60)["final_largest_coverage"] > 0.9


def test_two_arenas_of_one_episode_have_robots_of_their_own(agents, monkeypatch):
    class Count:
        def __init__(self):
            self.calls = 0

        def __call__(self, observation):
            self.calls += 1
            return self.calls % 8

    monkeypatch.setattr(agents, "Count", Count, raising=False)
    policy = find_policy("explorers.agents:Count", SMALL)
    seen = make_env(SMALL, 2).reset()
    twice = torch.cat((seen, seen))
    for step in range(3):
        twice["step_count"] = torch.full_like(twice["step_count"], step)
        assert (policy(twice.clone())["agents", "action"] == step + 1).all()


def test_a_robot_gets_its_observation_with_the_table_it_asks_for(agents, monkeypatch):
    got = []
    monkeypatch.setattr(agents, "walk", lambda observation: got.append(observation) or 8)
    monkeypatch.setattr(agents.walk, "fpr", "proximity", raising=False)
    env = make_env(SMALL, 2, fpr="proximity")
    step = env.reset()
    find_policy("explorers.agents:walk", SMALL)(step.clone())
    for number, (arena, robot) in enumerate((a, r) for a in range(2) for r in range(3)):
        expected = robot_observation(step, arena, robot)
        assert expected.fpr.any()
        for one, other in zip(got[number], expected, strict=True):
            assert np.array_equal(one, other)


def test_what_a_policy_writes_into_its_observation_changes_nothing():
    episodes = [
        record(find_policy(f"explorers.{name}", SMALL), SMALL, num_arenas=2, steps=5)
        for name in ("agents:Vandal", "teams:staying")
    ]
    assert episodes[0].maps.known_cells.equal(episodes[1].maps.known_cells)
    assert episodes[0].action.equal(episodes[1].action)


def test_robots_that_failed_are_not_asked(agents, monkeypatch):
    asked = []
    monkeypatch.setattr(agents, "walk", lambda observation: asked.append(observation.position) or 8)
    config = ArenaConfig(num_agents=6, failure_rate=0.2)
    episodes = record(find_policy("explorers.agents:walk", config), config, 2, steps=10)
    assert 0 < len(asked) == int(episodes.alive[:, :-1].sum()) < 2 * 6 * 10
    assert (episodes.action[~episodes.acting] == 8).all()


def test_agents_of_pettingzoo_see_and_do_the_same_here(agents):
    policy = find_policy("explorers.agents:trained_on_agents", SMALL)
    actions = record(policy, SMALL, num_arenas=1, steps=20, seed=5).action[0]
    seen = agents.seen.copy()
    env = parallel_env(SMALL, max_steps=20, seed=5, stream="test")
    observations, _ = env.reset()
    for step in range(20):
        for number, name in enumerate(env.agents):
            ours = seen[3 * step + number]
            assert ours.keys() == observations[name].keys()
            for key, entry in observations[name].items():
                assert np.array_equal(ours[key], entry)
                assert ours[key].dtype == entry.dtype
        chosen = {name: int(agents.trained_on_agents(observations[name])) for name in env.agents}
        assert list(chosen.values()) == actions[step].tolist()
        observations, *_ = env.step(chosen)


def test_modules_act_for_teams_and_keep_their_memory_to_themselves():
    from explorers import teams

    mask = make_env(SMALL, 3).reset()
    acted = find_policy("explorers.teams:first", SMALL)(mask.clone())
    assert acted["agents", "action"].equal(mask["agents", "action_mask"].int().argmax(-1))
    assert find_policy("explorers.teams:first", SMALL)._act is not teams.first
    counting = find_policy("explorers.teams:Counting", SMALL)
    assert counting._act.robots == 3
    assert counting.sees == "which actions are allowed"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere.agents:walk", r"module 'nowhere.agents' cannot be imported .*ModuleNotFound"),
        ("explorers.broken:walk", r"module 'explorers.broken' cannot be imported .*KeyError: 7"),
        ("explorers.agents:fly", r"'explorers.agents' has no attribute 'fly'"),
        ("explorers.agents:Greedy.no", r"'explorers.agents' has no attribute 'Greedy.no'"),
        ("explorers.agents:number", "it is no function, no class and no module"),
        ("explorers.agents:NeedsMore", "may take robot, config, seed, and needs weights"),
        ("explorers.agents:Mute", "objects of its class cannot be called"),
    ],
)
def test_what_is_no_policy_is_one_error(name, message):
    with pytest.raises(ValueError, match=f"^policy={name!r} is not allowed: .*{message}"):
        find_policy(name, SMALL)


def test_a_table_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match=r"blurred.fpr='blurred' is not allowed: use one of"):
        find_policy("explorers.agents:blurred", SMALL)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("agents:wrong", r"at step 2 robot 0 chose 3.5, and an action is an integer from 0 to 9"),
        ("teams:forgetful", r"teams:forgetful' is not allowed: .*'action'.* is missing"),
        ("teams:wordless", "must return a TensorDict, got NoneType"),
    ],
)
def test_what_is_no_action_is_an_error_that_names_the_policy(name, message):
    with pytest.raises(ValueError, match=message):
        record(find_policy(f"explorers.{name}", SMALL), SMALL, num_arenas=1, steps=5)


def test_the_working_folder_is_searched(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "beside.py").write_text("def stay(observation):\n    return 8\n")
    policy = find_policy("beside:stay", SMALL)
    assert (record(policy, SMALL, num_arenas=1, steps=3).action == 8).all()


def test_a_cell_is_measured_again_when_the_code_of_the_package_changes(tmp_path, monkeypatch):
    package = tmp_path / "mine"
    package.mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    (package / "__init__.py").write_text("")
    (package / "agents.py").write_text("def stay(observation):\n    return 8\n")
    cell = Cell("mine.agents:stay", PAPER, num_arenas=1, steps=5, seed=0)
    measured = []
    measure = cells.measure
    monkeypatch.setattr(cells, "measure", lambda one: measured.append(one) or measure(one))
    for _ in range(2):
        results = leaderboard.make_cells(tmp_path / "cells", [cell], progress=False)
    assert len(measured) == 1
    assert not results[cell]["planner"]
    assert results[cell]["settings"]["weights"] is None
    (package / "tables.py").write_text("SIZE = 3\n")
    leaderboard.make_cells(tmp_path / "cells", [cell], progress=False)
    assert len(measured) == 2
    (package / "tables.py").write_text("SIZE = 3  # of a table\n")
    (package / "old.py").write_text("print 'not Python 3'\n")
    leaderboard.make_cells(tmp_path / "cells", [cell], progress=False)
    assert len(measured) == 3
