"""What robots know of their team, their surroundings and the time, as transforms."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from marl_explore import ArenaConfig, make_env
from marl_explore.config.shapes import Sight
from marl_explore.core.information_gain import step_gains, territory_table
from marl_explore.core.links import within_range
from marl_explore.policies.networks import DeepSet
from marl_explore.transforms import Clock, FrontierTerritory, LocalMap, StepGain, Teammates
from marl_explore.transforms.features import make_features
from tests.helpers.boards import known_map

NAMES = ("gain", "territory", "teammates", "clock", "local")
KEYS = [("agents", "observation", name) for name in NAMES]
ARENA = ArenaConfig(height=6, width=7, num_agents=3, communication_range=1.5)


def rollout(steps=25):
    """Arenas that end at different times."""
    env = make_env(
        ARENA, num_envs=6, terminate_at_coverage=0.7, max_steps=11, features=DeepSet.features
    )
    return env.rollout(steps, break_when_any_done=False)


def test_online_equals_offline_at_the_root_and_under_next():
    online = rollout()
    keys = [*KEYS, *(("next", *key) for key in KEYS)]
    offline = make_features(ARENA, ("fpr", "net", *DeepSet.features))(online.exclude(*keys).clone())
    for key in keys:
        assert torch.equal(online[key], offline[key]), key


def test_a_reset_of_no_arena_leaves_every_feature():
    """Collectors ask for one when they go on from a checkpoint."""
    env = make_env(ARENA, num_envs=2, features=DeepSet.features)
    before = env.rollout(3)[:, -1]["next"]
    nowhere = torch.zeros(2, 1, dtype=torch.bool)
    after = env.reset(before.clone().set("_reset", nowhere), set_state=True)
    for key in KEYS:
        assert torch.equal(after[key], before[key]), key


def test_specs_hold():
    env = make_env(ARENA, num_envs=2, features=DeepSet.features)
    td = env.rollout(15)
    for key in KEYS:
        spec = env.observation_spec[key]
        assert all(spec.is_in(entry) for entry in td[key].unbind(1)), key


def test_maps_become_the_tables_of_the_core():
    step = rollout(8)[:, -1]
    grid, position = step["agents", "map"], step["agents", "position"]
    assert torch.equal(step[KEYS[0]], step_gains(grid, position, Sight.square(1)) / 9)
    reach = within_range(position, 3.0)
    assert torch.equal(step[KEYS[1]], territory_table(grid, position, reach, Sight.square(1)))


def a_team(**entries):
    return TensorDict({"agents": entries}, [])


def test_teammates_by_hand():
    td = a_team(
        position=torch.tensor([[0, 0], [3, 4], [0, 20]]),
        unshared=torch.tensor([[0, 16, 4], [2, 0, 0], [0, 0, 0]]),
        steps_since_merge=torch.tensor([[0, 8, 1000], [8, 0, 0], [1000, 0, 0]]),
    )
    table = Teammates(range_cells=5.0)(td)["agents", "observation", "teammates"]
    assert table.shape == (3, 3, 6)
    assert (table.diagonal() == 0).all()
    expected = [1, 3 / 8, 4 / 8, 1 / 5, 1 / 2, 1 / 2]
    torch.testing.assert_close(table[0, 1], torch.tensor(expected))
    torch.testing.assert_close(table[1, 0, :3], torch.tensor([1, -3 / 8, -4 / 8]))
    torch.testing.assert_close(table[0, 2], torch.tensor([0, 0, 0, 0, 4 / 20, 1000 / 1008]))


def test_far_away_is_as_far_as_eight_cells():
    td = a_team(
        position=torch.tensor([[0, 0], [2, 20]]),
        unshared=torch.zeros(2, 2, dtype=torch.int64),
        steps_since_merge=torch.zeros(2, 2, dtype=torch.int64),
    )
    table = Teammates(range_cells=math.inf)(td)["agents", "observation", "teammates"]
    assert table[0, 1, 1:3].tolist() == [0.25, 1.0]


def test_the_local_map_by_hand():
    grid, own = known_map("?.#\n?@.\n...")
    td = a_team(map=grid.expand(2, 3, 3), position=torch.stack((own, torch.tensor([2, 2]))))
    unknown, blocked, robots = LocalMap(view=2)(td)["agents", "observation", "local"][0].int()
    assert unknown.tolist() == [[0] * 5, [0, 1, 0, 0, 0], [0, 1, 0, 0, 0], [0] * 5, [0] * 5]
    inside = [[1, 0, 0, 1, 1], [1, 0, 0, 0, 1], [1, 0, 0, 0, 1]]
    assert blocked.tolist() == [[1] * 5, *inside, [1] * 5]
    assert robots.nonzero().tolist() == [[3, 3]]


@pytest.mark.parametrize(("range_cells", "seen"), [(1.0, 0), (1.5, 1)])
def test_the_local_map_shows_robots_in_range_only(range_cells, seen):
    grid, own = known_map("...\n.@.\n...")
    td = a_team(map=grid.expand(2, 3, 3), position=torch.stack((own, torch.tensor([2, 2]))))
    local = LocalMap(range_cells=range_cells, view=1)(td)["agents", "observation", "local"]
    assert local[:, 2].sum() == 2 * seen


def test_the_clock_by_hand():
    td = a_team(position=torch.zeros(2, 2, dtype=torch.int64)).set("step_count", torch.tensor([8]))
    clock = Clock(period=3)(td)["agents", "observation", "clock"]
    torch.testing.assert_close(clock, torch.tensor([[1 / 3, 0, 0, 1]]).expand(2, -1))


@pytest.mark.parametrize(
    ("transform", "wrong", "message"),
    [
        (StepGain(), {"map": torch.zeros(2, 3, 3)}, "StepGain: .*map.* must be int8"),
        (
            FrontierTerritory(),
            {"position": torch.zeros(2, 3, dtype=torch.int64)},
            r"FrontierTerritory: .*position.* must be int64 of shape \(2, 2\)",
        ),
        (LocalMap(), {"map": torch.zeros(3, 3, dtype=torch.int8)}, r"LocalMap: .*\[\*B, N, H, W\]"),
        (
            Teammates(),
            {"unshared": torch.zeros(2, 3, dtype=torch.int64)},
            r"Teammates: .*unshared.* int64 of shape \(2, 2\)",
        ),
        (Clock(), {"position": torch.zeros(2, 2)}, "Clock: .*position.* must be int64"),
    ],
)
def test_entries_that_do_not_fit_are_refused(transform, wrong, message):
    right = {
        "map": torch.zeros(2, 3, 3, dtype=torch.int8),
        "position": torch.zeros(2, 2, dtype=torch.int64),
        "unshared": torch.zeros(2, 2, dtype=torch.int64),
        "steps_since_merge": torch.zeros(2, 2, dtype=torch.int64),
    }
    td = a_team(**(right | wrong)).set("step_count", torch.zeros(1, dtype=torch.int64))
    with pytest.raises(ValueError, match=message):
        transform(td)


@pytest.mark.parametrize("transform", [FrontierTerritory, Teammates, LocalMap])
def test_a_range_that_cannot_be_is_refused(transform):
    with pytest.raises(ValueError, match=r"range_cells=-1 is not allowed"):
        transform(range_cells=-1)
