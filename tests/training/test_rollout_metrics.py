"""How episodes of a batch ended, and that a batch holds what is read of it and no more."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from statistics import fmean

import pytest
import torch

from marl_explore import PLANNERS, ArenaConfig, TrainConfig
from marl_explore.core.mapping import target_cells
from marl_explore.training.collectors import make_collector
from marl_explore.training.environment import make_training_env
from marl_explore.training.presets import PRESETS
from marl_explore.training.rollout_metrics import METRIC_KEYS, FinalShares, rollout_metrics
from marl_explore.training.trainer import Trainer

PAPER = ArenaConfig(height=6, width=7, num_agents=3)
FAULTY = replace(PAPER, failure_rate=0.1, num_walkers=1)


def collected(arena, keep=None, steps=30):
    """Episodes of 9 steps, or until everything is mapped."""
    config = TrainConfig(arena, episode_steps=9, terminate_at_coverage=1.0)
    torch.manual_seed(0)
    create = partial(make_training_env, config)
    collector = make_collector(create, PLANNERS["nearest-timer"](arena), 5, steps, keep=keep)
    batch = next(iter(collector))
    collector.shutdown()
    return batch


def ends_by_hand(batch):
    """Coverage and share of known cells at each end: those of the living robot that knows most."""
    found = []
    for row, step in batch["next", "done"].squeeze(-1).nonzero().tolist():
        end = batch["next"][row, step]
        target = target_cells(end["obstacles"][None], end["agents", "position"][None])[0]
        alive = end["agents", "alive"]
        known = [
            grid != -1 for grid, lives in zip(end["agents", "map"], alive, strict=True) if lives
        ]
        covered = [float((cells & target).sum() / target.sum()) for cells in known]
        found.append(
            (max(covered, default=0.0), max((float(k.float().mean()) for k in known), default=0.0))
        )
    return found


@pytest.mark.parametrize("arena", [PAPER, FAULTY], ids=["paper", "faulty"])
def test_how_episodes_ended(arena):
    batch = collected(arena)
    ended = batch["next", "done"].squeeze(-1)
    expected = ends_by_hand(batch)
    assert len(expected) > 10
    if arena is FAULTY:
        assert any(not step["agents", "alive"].all() for step in batch["next"][ended])
    for number, name in enumerate(FinalShares._fields):
        each = [end[number] for end in expected]
        assert batch["next", name][ended].flatten().tolist() == pytest.approx(each)
        assert not batch["next", name][~ended].any()
        assert not batch[name].any()  # of the step before: 0 after each reset, too
        assert rollout_metrics(batch)[name] == pytest.approx(fmean(each))


def test_metrics_read_no_other_entries():
    assert rollout_metrics(collected(FAULTY, METRIC_KEYS)) == rollout_metrics(collected(FAULTY))


@pytest.mark.parametrize("preset", ["paper-mlp-case2", "fast", "best"])
def test_a_batch_is_what_is_read(preset):
    config = replace(PRESETS[preset], arena=PAPER, scenes=(), num_envs=4, rollout_steps=5)
    trainer = Trainer(config)
    (batch,) = trainer.collect()
    entries = set(batch.keys(True, True))
    reads_maps = config.critic_input == "state"
    assert (("agents", "map") in entries) == (("next", "obstacles") in entries) == reads_maps
    assert not any("memory" in key or "linked" in key for key in entries)
    read = [key for one in trainer.learners.values() for key in one.loss.rollout_keys]
    assert entries == {*METRIC_KEYS, *read}
    assert trainer.update(batch)
