"""What a robot cannot know: all of it is changed, nothing else, and policies that use it show."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from marl_explore import ArenaConfig, make_env, suite
from marl_explore.cli import check
from marl_explore.evaluation.episodes import play
from marl_explore.evaluation.knowledge import (
    CHANGES,
    changed_beyond,
    find_leak,
    require_decentralised,
)
from marl_explore.evaluation.registry import find_policy
from marl_explore.policies.observations import robot_observation
from tests.evaluation.test_outside import DATA

WIDE = ArenaConfig(
    num_agents=3,
    sensing_range=(1.5, 2.0, 2.0),
    sensing_shape="disc",
    line_of_sight=True,
    communication_range=2.5,
    wall_loss_db=6.0,
    message_loss=0.3,
    failure_rate=0.02,
    num_walkers=4,
    obstacle_density=0.2,
)


@pytest.fixture(autouse=True)
def _package(monkeypatch):
    monkeypatch.syspath_prepend(DATA)


def observations(config=WIDE, steps=12):
    """What teams observe with all features, and the actions that led there."""
    torch.manual_seed(0)
    env = make_env(config, 4, fpr="proximity")
    return list(play(find_policy("random", config), env, steps))


def test_what_a_robot_observes_stays_as_it_is():
    for number, step in enumerate(observations()):
        for robot in range(WIDE.num_agents):
            changed = changed_beyond(step, robot, seed=number)
            for arena in range(4):
                one, other = (robot_observation(td, arena, robot) for td in (step, changed))
                for name, before, now in zip(one._fields, one, other, strict=True):
                    assert np.array_equal(before, now), name
            for key in ("alive", "discovered", "received", "merged"):
                assert changed["agents", key][:, robot].equal(step["agents", key][:, robot])


def test_everything_else_changes():
    step = observations()[-1]
    changed = changed_beyond(step, robot=1)
    kept = []
    for key in step.keys(True, True):
        one, other = step[key], changed[key]
        if isinstance(key, tuple) and key[0] == "agents":
            one, other = one[:, [0, 2]], other[:, [0, 2]]
        if one.equal(other):
            kept.append(key)
    assert kept == ["step_count"]
    hidden = ~step["agents", "linked"][:, 1]
    moved = (step["agents", "position"] != changed["agents", "position"]).any(-1)
    assert moved.any()
    assert not moved[~hidden].any()


def test_a_change_alone_changes_that_alone():
    step = observations()[5]
    found = {}
    for name in CHANGES:
        changed = changed_beyond(step, 0, (name,))
        found[name] = {
            key[-1] if isinstance(key, tuple) else key
            for key in step.keys(True, True)
            if not step[key].equal(changed[key])
        }
    assert found["the obstacles"] == {"obstacles"}
    assert found["the maps of other robots"] == {"map"}
    assert found["which other robots have failed"] == {"alive"}
    assert found["where robots are that it is not linked to"] == {"position"}
    assert found["the team's reward and end"] == {"done", "terminated", "truncated"}
    assert {"fov", "fpr", "net", "action", "unshared", "dangerous"} <= found[
        "what other robots see, count and do"
    ]
    every = set().union(*found.values())
    assert len(every) == sum(map(len, found.values()))  # each entry has one home


@pytest.mark.parametrize("world", [ArenaConfig(num_agents=3), WIDE], ids=["paper", "wide"])
@pytest.mark.parametrize(
    "name",
    [
        "nearest-timer",
        "goal-utility",
        "explorers.agents:walk",
        "explorers.agents:Greedy",
        "explorers.agents:trained_on_agents",
        "explorers.cheats:ByRow",
        "explorers.teams:Counting",
    ],
)
def test_decentralised_policies_pass(name, world):
    require_decentralised(name, world, steps=15)


def test_trained_policies_pass():
    require_decentralised("best", ArenaConfig(num_agents=2), num_arenas=2, steps=10)
    require_decentralised("best:argmax", ArenaConfig(num_agents=2), num_arenas=2, steps=10)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("obstacles", "the obstacles"),
        ("walkers", "where people are"),
        ("draw_key", "what will happen"),
        ("maps", "the maps of other robots"),
        ("positions", "where robots are that it is not linked to"),
        ("links", "the links of other robots"),
        ("failures", "which other robots have failed"),
        ("masks", "what other robots see, count and do"),
    ],
)
def test_teams_that_use_what_a_robot_cannot_know_are_refused(name, change):
    with pytest.raises(ValueError, match=f"cannot know: at step .* was changed: {change}$"):
        require_decentralised(f"explorers.cheats:{name}", WIDE, steps=15)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("Telepath", "chose"),
        ("peeps", "fails"),
        ("unseeded", "chose"),
    ],
)
def test_robots_that_share_or_look_around_are_refused(name, what):
    message = f"does not follow from what its robot observed: at step .* robot . ({what}) "
    with pytest.raises(ValueError, match=message):
        require_decentralised(f"explorers.cheats:{name}", WIDE, num_arenas=2, steps=10)


def test_references_are_refused():
    for name in ("central", "clairvoyant"):
        with pytest.raises(ValueError, match=f"policy='{name}' is not allowed: .*cannot know"):
            require_decentralised(name, ArenaConfig(), num_arenas=2, steps=10)


def test_a_leak_says_where_and_what():
    """The first robot that acts on the others' maps, at the first step where that shows."""

    class Late:
        def __call__(self, td):
            known = (td["agents", "map"] != -1).flatten(1).sum(-1, keepdim=True)
            action = torch.where(td["step_count"] < 4, 8, known % 10).expand(-1, 3).clone()
            action[:, 0] = 8  # robot 0 is honest
            return td.set(("agents", "action"), action)

    leak = find_leak(Late, ArenaConfig(num_agents=3, communication_range=50.0), steps=10)
    assert (leak.robot, leak.step) == (1, 4)
    assert leak.changes == ("the maps of other robots",)
    assert str(leak).endswith("when this was changed: the maps of other robots")
    assert find_leak(Late, ArenaConfig(num_agents=3), steps=4) is None


def test_the_check_leaves_the_random_state_alone():
    before = torch.get_rng_state()
    require_decentralised("random", ArenaConfig(), num_arenas=2, steps=5)
    assert torch.get_rng_state().equal(before)


def test_the_command_checks_policies_on_arenas_of_any_kind(capsys):
    check.run(
        check.parse(["explorers.agents:walk", "random", "--arenas", "faulty-32", "--steps", "8"])
    )
    said = capsys.readouterr().out.splitlines()
    assert said == [
        f"{name}: 6 robots acted on what they know, for 8 steps in 4 arenas"
        for name in ("explorers.agents:walk", "random")
    ]
    with pytest.raises(ValueError, match="explorers.cheats:obstacles' is not allowed"):
        check.run(check.parse(["explorers.cheats:obstacles", "--steps", "8"]))
    with pytest.raises(ValueError, match="num_arenas=0 is not allowed"):
        check.parse(["random", "--num-arenas", "0"])
    assert suite("faulty-32").config.num_walkers  # so that people were among what was changed
