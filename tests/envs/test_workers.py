"""Arenas for worker processes: each has its own, and who forgets is told so."""

from __future__ import annotations

import pickle
from functools import partial

import pytest
import torch
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import ParallelEnv

from marl_explore import (
    PLANNERS,
    ArenaConfig,
    ExplorationEnv,
    TrainConfig,
    make_env,
    parallel_env,
    split_arenas,
)
from marl_explore.envs import exploration
from marl_explore.envs.workers import warn_of_shared_arenas
from marl_explore.training.collectors import make_collector
from marl_explore.training.trainer import make_training_env

SMALL = ArenaConfig(height=5, width=5, num_agents=2)
WARNED = "an ExplorationEnv was made in a worker process without first_arena or set_seed"


def whole(first_arena=0):
    """The arenas of one environment for all."""
    return make_env(SMALL, num_envs=6, first_arena=first_arena).reset()["obstacles"]


@pytest.mark.parametrize("workers", [1, 2, 3, 6])
@pytest.mark.parametrize("first_arena", [0, 10])
def test_the_parts_are_the_whole_in_order(workers, first_arena):
    parts = split_arenas(partial(make_env, SMALL), workers, num_envs=6, first_arena=first_arena)
    assert len(parts) == workers
    envs = [make() for make in pickle.loads(pickle.dumps(parts))]
    assert {env.batch_size for env in envs} == {torch.Size([6 // workers])}
    drawn = torch.cat([env.reset()["obstacles"] for env in envs])
    assert torch.equal(drawn, whole(first_arena))


def test_parallel_envs_have_arenas_of_their_own(capfd):
    env = ParallelEnv(2, split_arenas(partial(make_env, SMALL), workers=2, num_envs=6))
    steps = env.rollout(3)
    env.close()
    assert torch.equal(steps["obstacles"][:, :, 0].flatten(0, 1), whole())
    assert WARNED not in capfd.readouterr().err


def first_batch(makers):
    collector = MultiSyncCollector(makers, frames_per_batch=12, total_frames=12, cat_results=0)
    (batch,) = collector
    collector.shutdown()
    return batch["obstacles"][:, 0]


def test_collectors_have_arenas_of_their_own(capfd):
    drawn = first_batch(split_arenas(partial(make_env, SMALL), workers=2, num_envs=6))
    later = make_env(SMALL, num_envs=6)
    expected = [later.reset()["obstacles"] for _ in range(4)]
    assert any(torch.equal(drawn, arenas) for arenas in expected)  # TorchRL has reset before
    assert WARNED not in capfd.readouterr().err


@pytest.mark.parametrize("start", [ParallelEnv, MultiSyncCollector])
def test_workers_with_the_same_arenas_are_warned_of(start, capfd):
    make = partial(make_env, SMALL, num_envs=3)
    if start is ParallelEnv:
        env = ParallelEnv(2, make)
        env.reset()
        assert WARNED not in capfd.readouterr().err
        one, other = env.rollout(3)["obstacles"][:, :, 0]
        env.rollout(3)
        env.close()
    else:
        one, other = first_batch([make, make]).chunk(2)
    assert torch.equal(one, other)
    said = capfd.readouterr().err
    assert said.count(WARNED) == 2  # once in each process
    assert "marl_explore.split_arenas" in said


@pytest.fixture
def _worker(monkeypatch):
    """Make this process look like a worker that has not warned yet."""
    monkeypatch.setattr(exploration, "in_worker", lambda: True)
    warn_of_shared_arenas.cache_clear()


@pytest.mark.usefixtures("_worker")
@pytest.mark.parametrize("settings", [{}, {"seed": 4}, {"arenas": "mixed", "max_steps": 2}])
def test_the_first_step_warns_once(settings):
    env = make_env(SMALL, **settings)
    env.reset()
    with pytest.warns(UserWarning, match=WARNED):
        env.rollout(2)
    env.rollout(5, break_when_any_done=False)
    make_env(SMALL, **settings).rollout(2)


@pytest.mark.usefixtures("_worker")
def test_who_chose_the_arenas_is_not_warned():  # a warning would be an error
    for settings in ({"first_arena": 0}, {"first_arena": 5}, {"stream": "test"}):
        make_env(SMALL, **settings).rollout(2)
    env = make_env(SMALL)
    env.set_seed(7)
    env.rollout(2)
    parallel = parallel_env(SMALL)
    parallel.reset(seed=3)
    parallel.step(dict.fromkeys(parallel.agents, 8))


@pytest.mark.usefixtures("_worker")
def test_collectors_of_the_package_choose_the_arenas():
    create_env = partial(make_training_env, TrainConfig(SMALL))
    next(iter(make_collector(create_env, PLANNERS["random"](SMALL), num_envs=2, steps=3)))
    for create_part in split_arenas(create_env, workers=2, num_envs=4):
        create_part().rollout(2)


def test_the_main_process_is_not_warned():
    make_env(SMALL).rollout(3)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"workers": 4, "num_envs": 6}, "workers=4 is not allowed: it must divide num_envs=6"),
        ({"workers": 0, "num_envs": 6}, "workers=0 is not allowed"),
        ({"workers": 2, "num_envs": 0}, "num_envs=0 is not allowed"),
        ({"workers": 2, "num_envs": 6, "first_arena": -1}, "first_arena=-1 is not allowed"),
    ],
)
def test_shares_that_cannot_be_are_named(numbers, message):
    with pytest.raises(ValueError, match=message):
        split_arenas(make_env, **numbers)


def test_the_first_arena_is_the_default():
    assert ExplorationEnv().first_arena == make_env().base_env.first_arena == 0
