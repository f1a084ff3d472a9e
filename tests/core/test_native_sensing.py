"""What robots sense and merge: the kernels in C give what torch gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given

from marl_explore.arenas import Uniform
from marl_explore.config.arena import ArenaConfig
from marl_explore.core import native, sensing
from marl_explore.core.grid import COMMUNICATE, STAY
from marl_explore.core.native import step
from marl_explore.core.world import advance, exchange, start
from tests.helpers.strategies import repeatable
from tests.helpers.wide_worlds import wide_scenarios

pytestmark = pytest.mark.skipif(native.missing("sense") is not None, reason="no C compiler")


@repeatable(max_examples=100)
@given(scenario=wide_scenarios(max_side=16, max_steps=4))
def test_views_and_maps_are_those_of_torch(scenario):
    config = scenario.config
    state = start(config, **scenario.start())
    for action in scenario.actions:
        looks = [
            sensing.surroundings(
                state.walls, state.position, config.sight, state.walkers, backend=backend
            )
            for backend in ("torch", "native")
        ]
        assert looks[0].equal(looks[1])
        before = state.map
        state, _ = advance(config, state, action)
        everyone = [None] if all(all(episode.alive) for episode in scenario.episodes) else []
        for alive in (state.alive, *everyone):
            views = sensing.surroundings(state.walls, state.position, config.sight)
            by_torch, by_kernel = (
                sensing.sense(before, views, state.position, state.target, alive, backend)
                for backend in ("torch", "native")
            )
            assert all(a.equal(b) for a, b in zip(by_torch, by_kernel, strict=True))


@repeatable(max_examples=150)
@given(scenario=wide_scenarios(max_side=16, max_robots=9, max_steps=6))
def test_steps_at_once_are_those_of_torch(scenario):
    """In every entry of the state and of the record."""
    config = replace(
        scenario.config,
        communication_range=max(np.ravel(scenario.config.communication_range).tolist()),
        wall_loss_db=0.0,
        shadowing_db=0.0,
        message_loss=0.0,
        move_period=1,
        failure_rate=0.0,
        num_walkers=0,
    )
    state = start(config, **scenario.start() | {"alive": None})
    for action in scenario.actions:
        (by_torch, record), (by_kernel, its_record) = (
            advance(config, state, action, backend) for backend in ("torch", "native")
        )
        pairs = zip((*by_torch, *record[:9]), (*by_kernel, *its_record[:9]), strict=True)
        assert all(a.dtype == b.dtype and a.equal(b) for a, b in pairs)
        assert all(a.equal(b) for a, b in zip(record.maps, its_record.maps, strict=True))
        assert record[-2] == its_record[-2]
        assert torch.as_tensor(record[-1]).equal(torch.as_tensor(its_record[-1]))
        state = by_kernel


def test_steps_of_many_threads_are_those_of_one(monkeypatch):
    config = ArenaConfig(9, 8, num_agents=3)
    arenas = torch.arange(64)
    obstacles, position = Uniform(config)(0, arenas, torch.zeros(64, dtype=torch.int64))
    state = start(config, obstacles, position)
    action = torch.randint(10, (64, 3), generator=torch.Generator().manual_seed(0))
    alone, _ = advance(config, state, action, "native")
    monkeypatch.setattr(step, "CELLS_PER_THREAD", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 5)
    together, _ = advance(config, state, action, "native")
    assert all(a.equal(b) for a, b in zip(alone, together, strict=True))


@pytest.mark.parametrize(
    "settings",
    [
        {"wall_loss_db": 3.0},
        {"shadowing_db": 4.0},
        {"message_loss": 0.1},
        {"move_period": 2},
        {"failure_rate": 0.1},
        {"num_walkers": 1},
        {"communication_range": (3.0, 4.0)},
    ],
)
def test_a_world_with_hindrances_takes_its_steps_in_parts(settings):
    config = ArenaConfig(9, 8, num_agents=2, **settings)
    obstacles, position = Uniform(config)(0, torch.arange(1), torch.zeros(1, dtype=torch.int64))
    state, action = start(config, obstacles, position), torch.tensor([[0, 9]])
    assert advance(config, state, action)[0].step_count == 1
    with pytest.raises(ValueError, match="'native' is not allowed: .* hindrances, on the CPU"):
        advance(config, state, action, "native")


def test_a_robot_that_failed_takes_no_step_at_once():
    config = ArenaConfig(9, 8, num_agents=2)
    obstacles, position = Uniform(config)(0, torch.arange(1), torch.zeros(1, dtype=torch.int64))
    state = start(config, obstacles, position, alive=torch.tensor([[True, False]]))
    with pytest.raises(ValueError, match="hindrances"):
        advance(config, state, torch.tensor([[0, 9]]), "native")


def test_an_action_that_is_none_is_refused_at_once():
    config = ArenaConfig(9, 8, num_agents=2)
    obstacles, position = Uniform(config)(0, torch.arange(1), torch.zeros(1, dtype=torch.int64))
    state = start(config, obstacles, position)
    with pytest.raises(ValueError, match="no such map, action"):
        advance(config, state, torch.tensor([[0, 10]]), "native")


def test_robots_outside_are_refused():
    sight = sensing.Sight.square(1)
    walls = sensing.bordered(torch.zeros(1, 3, 3, dtype=torch.bool), 1)
    with pytest.raises(ValueError, match="outside its map"):
        sensing.surroundings(walls, torch.tensor([[[3, 3]]]), sight, backend="native")
    view = torch.zeros(1, 1, 3, 3, dtype=torch.int8)
    grid = torch.zeros(1, 1, 3, 3, dtype=torch.int8)
    with pytest.raises(ValueError, match="outside its map"):
        sensing.sense(
            grid, view, torch.tensor([[[3, 0]]]), torch.zeros(1, 3, 3).bool(), backend="native"
        )


@pytest.mark.parametrize("robots", [1, 2, 5, 16, 17, 40])
def test_merged_maps_are_those_of_torch(robots):
    """Also for large teams, whose networks torch finds by labels."""
    random = torch.Generator().manual_seed(robots)
    config = ArenaConfig(9, 8, obstacle_density=0.1, num_agents=robots)
    obstacles, position = Uniform(config)(0, torch.arange(12), torch.zeros(12, dtype=torch.int64))
    state = start(config, obstacles, position)
    known = torch.rand(state.map.shape, generator=random) < 0.3
    grid = torch.where(known, obstacles.unsqueeze(1).to(torch.int8), state.map)
    share = 1.5 / robots
    linked = torch.rand(12, robots, robots, generator=random) < share
    linked = linked | linked.mT | torch.eye(robots, dtype=torch.bool)
    action = torch.where(torch.rand(12, robots, generator=random) < 0.7, COMMUNICATE, STAY)
    maps = {backend: grid.clone() for backend in ("torch", "native")}
    brought = [exchange(maps[b], state, linked, action, backend=b) for b in maps]
    assert all(a.equal(b) for a, b in zip(*brought, strict=True))
    assert maps["torch"].equal(maps["native"])
    assert robots == 1 or brought[0].received.any()
    member = brought[0].network.diagonal(dim1=-2, dim2=-1)
    assert maps["torch"][~member].equal(grid[~member])


def test_a_step_takes_only_actions_of_its_kind():
    config = ArenaConfig(9, 8, num_agents=2)
    obstacles, position = Uniform(config)(0, torch.arange(1), torch.zeros(1, dtype=torch.int64))
    state = start(config, obstacles, position)
    with pytest.raises(ValueError, match="action must be int64 on the CPU, got torch.int32"):
        advance(config, state, torch.tensor([[0, 9]], dtype=torch.int32), "native")
