"""Ray's workers: the data of worker processes, replaced when they die, on a real local cluster."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial

import pytest
import ray
import torch
from torchrl.collectors.distributed import RayCollector

from marl_explore import ExplorationEnv, load_policy
from marl_explore.config.run import RunConfig
from marl_explore.training import runs
from marl_explore.training.checkpoint import list_checkpoints, read_checkpoint, write_checkpoint
from marl_explore.training.trainer import Trainer
from marl_explore.training.workers import WorkerError
from tests.helpers.killing import CONFIG
from tests.training.test_collectors import collect_checked, rollouts, run_to, weights

RAY = RunConfig(collector="ray", workers=2, checkpoint_every=0, validate_every=0)


@pytest.fixture(scope="module", autouse=True)
def cluster():
    ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
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
        (rollouts,) = run.rollouts.collectors
        ray.kill(rollouts._collector.remote_collectors[1])

    run = Trainer(CONFIG, RAY)
    with caplog.at_level(logging.WARNING, "marl_explore"):
        metrics = run_to(run, CONFIG.updates, disturb=kill_worker)
    assert "restarting all workers" in caplog.text
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
    with pytest.raises(WorkerError, match=r"Ray has 2 CPUs, too few for workers=4; upd"):
        runs.train(CONFIG, folder, replace(RAY, workers=4), progress=False)
    assert len(list_checkpoints(folder)) == 1


@pytest.mark.filterwarnings("ignore:RayCollector iteration started before weight sync")
def test_a_trained_policy_acts_in_torchrls_own_ray_collector():
    workers = [partial(ExplorationEnv, num_envs=4, first_arena=first) for first in (0, 4)]
    own = {"trust_policy": True, "auto_register_policy_transforms": False}
    collector = RayCollector(
        workers,
        load_policy("best"),
        frames_per_batch=80,
        total_frames=80,
        sync=True,
        collector_kwargs=own,
        remote_configs={"num_cpus": 1, "num_gpus": 0},
    )
    batch = next(iter(collector))
    agents = batch["agents"]
    assert agents["action"].shape[-1] == 4
    assert agents["action_mask"].gather(-1, agents["action"].unsqueeze(-1)).all()
    collector.shutdown(shutdown_ray=False)
