"""TensorBoard, W&B (offline) and MLflow get the values of the CSV files."""

from __future__ import annotations

import csv
from dataclasses import replace

import pytest

from marl_explore.training import runs
from tests.helpers.killing import CONFIG, RUN

# of the packages themselves
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def trained(folder, logger):
    """The rewards of a short run by frames."""
    runs.train(replace(CONFIG, episodes=4), folder, replace(RUN, logger=logger), progress=False)
    rows = csv.reader((folder / "scalars" / "reward.csv").read_text().splitlines())
    return {int(frames): pytest.approx(float(reward)) for frames, reward in rows}


def test_tensorboard(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    rewards = trained(tmp_path / "run", "tensorboard")
    events = EventAccumulator(str(tmp_path / "run")).Reload().Scalars("reward")
    assert {event.step: event.value for event in events} == rewards


def test_wandb(tmp_path, monkeypatch):
    import wandb

    monkeypatch.setenv("WANDB_MODE", "offline")
    rewards = trained(tmp_path / "run", "wandb")
    assert wandb.run.summary["reward"] == [*rewards.values()][-1]
    assert wandb.run.config["arena.height"] == 6
    wandb.finish()
    assert list((tmp_path / "run" / "wandb").glob("offline-run-*"))


def test_mlflow(tmp_path, monkeypatch):
    import mlflow

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    rewards = trained(tmp_path / "run", "mlflow")
    run = mlflow.active_run().info.run_id
    history = mlflow.MlflowClient().get_metric_history(run, "reward")
    assert {point.step: point.value for point in history} == rewards
    assert mlflow.get_run(run).data.params["arena.height"] == "6"
    mlflow.end_run()
