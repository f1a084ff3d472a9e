"""Ray's workers: the data of worker processes, replaced when they die, on a real local cluster."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import ray
import torch

from marl_explore import runs
from marl_explore.checkpoint import list_checkpoints, read_checkpoint, write_checkpoint
from marl_explore.execution import RunConfig
from marl_explore.trainer import Trainer
from marl_explore.workers import WorkerError
from tests.killing import CONFIG
from tests.test_collect import collect_checked, rollouts, run_to, weights

RAY = RunConfig(collector="ray", workers=2, checkpoint_every=0, validate_every=0)


@pytest.fixture(scope="module", autouse=True)
def cluster():
    yield
    ray.shutdown()


@pytest.fixture(scope="module")
def undisturbed():
    run = Trainer(CONFIG, RAY)
    run.collect = lambda collect=run.collect: collect_checked(run, collect)
    return repr(run_to(run, CONFIG.updates)), weights(run)


def test_the_data_are_those_of_one_process():
    here, there = rollouts(RunConfig()), rollouts(RAY)
    assert there.shape == here.shape == (4, 18)
    for key in here.keys(True, True):
        if "action_log_prob" in key:
            torch.testing.assert_close(there[key], here[key], atol=1e-5, rtol=0)
        elif "traj_ids" not in key:
            assert torch.equal(there[key], here[key]), key


def test_the_run_is_that_of_worker_processes(undisturbed):
    run = Trainer(CONFIG, replace(RAY, collector="multisync"))
    assert repr(run_to(run, CONFIG.updates)) == undisturbed[0]
    assert all(torch.equal(a, b) for a, b in zip(weights(run), undisturbed[1], strict=True))


def test_a_worker_that_is_killed_is_replaced_and_nothing_changes(undisturbed, caplog):
    def kill_worker(run):
        ray.kill(run.rollouts._collector.remote_collectors[1])

    run = Trainer(CONFIG, RAY)
    with caplog.at_level(logging.WARNING, "marl_explore"):
        metrics = run_to(run, CONFIG.updates, disturb=kill_worker)
    assert "starting all workers again" in caplog.text
    assert repr(metrics) == undisturbed[0]
    assert all(torch.equal(a, b) for a, b in zip(weights(run), undisturbed[1], strict=True))


def test_a_run_goes_on_exactly_from_a_checkpoint(undisturbed, tmp_path):
    stopped = Trainer(CONFIG, RAY)
    curve = run_to(stopped, 5)
    path = write_checkpoint(tmp_path, 5, stopped.state_dict(), keep=1)
    resumed = Trainer(CONFIG, RAY)
    resumed.load_state_dict(read_checkpoint(path))
    assert repr(curve + run_to(resumed, CONFIG.updates)) == undisturbed[0]


def test_a_cluster_that_is_too_small_ends_the_run_with_a_checkpoint(tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(WorkerError, match=r"Ray has 2 CPUs, which is too few for workers=4; upd"):
        runs.train(CONFIG, folder, replace(RAY, workers=4), progress=False)
    assert len(list_checkpoints(folder)) == 1
