"""Where metrics go: CSV files that fit a resumed run, other loggers by name."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from marl_explore.config.run import RunConfig
from marl_explore.training import loggers, runs
from marl_explore.training.loggers import Loggers, require_logger
from tests.helpers.killing import CONFIG, RUN


def test_rows_of_lost_updates_are_dropped(tmp_path):
    first = Loggers("csv", tmp_path, {"gamma": 0.9}, frames=0)
    for frames in (10, 20, 30):
        first.log({"reward": frames / 10, "coverage": 0.5}, frames)
    del first
    with (tmp_path / "scalars" / "reward.csv").open("a") as file:
        file.write("40,1")  # a row that its writer did not finish
    again = Loggers("csv", tmp_path, {"gamma": 0.9}, frames=20)
    again.log({"reward": 7.0}, 30)
    assert (tmp_path / "scalars" / "reward.csv").read_text() == "10,1.0\n20,2.0\n30,7.0\n"
    assert (tmp_path / "scalars" / "coverage.csv").read_text() == "10,0.5\n20,0.5\n"


def test_what_is_written_is_not_kept_in_memory(tmp_path):
    loggers = Loggers("csv", tmp_path, {}, frames=0)
    tracemalloc.start()
    try:
        for frames in range(4000):
            if frames == 1000:
                before = tracemalloc.get_traced_memory()[0]
            loggers.log({"reward": frames / 7}, frames)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 30_000  # a kept row takes 100 bytes or more
    assert len((tmp_path / "scalars" / "reward.csv").read_text().splitlines()) == 4000


def test_hyper_parameters_are_logged_flat(tmp_path):
    Loggers("csv", tmp_path, {"arena": {"height": 6}, "gamma": 0.9}, frames=0)
    (text,) = (tmp_path / "texts").iterdir()
    assert text.read_text() == "arena.height: 6\ngamma: 0.9"


@pytest.mark.parametrize("name", ["tensorboard", "wandb", "mlflow"])
def test_a_missing_package_is_named_before_anything_is_made(tmp_path, monkeypatch, name):
    monkeypatch.setattr(loggers, "find_spec", lambda package: None)
    with pytest.raises(ValueError, match=f"logger='{name}' needs {name}.*: pip install {name}"):
        runs.train(CONFIG, tmp_path / "run", RunConfig(logger=name))
    assert list(tmp_path.iterdir()) == []
    require_logger("csv")


def test_every_metric_of_a_run_is_documented(tmp_path):
    runs.train(CONFIG, tmp_path / "run", RUN, progress=False)
    documented = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text()
    for file in (tmp_path / "run" / "scalars").iterdir():
        assert f"`{file.stem}`" in documented, file.stem
