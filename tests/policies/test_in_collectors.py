"""Trained policies act in TorchRL's own collectors, on any environment that they fit."""

from __future__ import annotations

from functools import partial

import pytest
from torchrl.collectors import Collector, MultiSyncCollector

from marl_explore import ExplorationEnv, load_policy, make_env

FRAMES = 40


def allowed(batch):
    """Whether the mask allowed every action."""
    agents = batch["agents"]
    return agents["action_mask"].gather(-1, agents["action"].unsqueeze(-1)).all()


@pytest.mark.parametrize("make", [make_env, ExplorationEnv], ids=["with features", "bare"])
@pytest.mark.parametrize("name", ["best", "paper-cnn-case1"])
def test_one_process(make, name):
    collector = Collector(
        partial(make, num_envs=4),
        load_policy(name),
        frames_per_batch=FRAMES,
        total_frames=FRAMES,
        auto_register_policy_transforms=False,
    )
    (batch,) = collector
    collector.shutdown()
    assert batch["agents", "action"].shape == (4, 10, 4)
    assert allowed(batch)


def test_worker_processes():
    workers = [partial(ExplorationEnv, num_envs=4, first_arena=first) for first in (0, 4)]
    collector = MultiSyncCollector(
        workers,
        load_policy("best"),
        frames_per_batch=2 * FRAMES,
        total_frames=2 * FRAMES,
        auto_register_policy_transforms=False,
    )
    (batch,) = collector
    collector.shutdown()
    assert batch["agents", "action"].shape == (2, 4, 10, 4)
    assert allowed(batch)
