"""Sweeps over seeds: the runs are those of one seed each, and survive being stopped."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import time
from dataclasses import replace

import pytest
import torch

from marl_explore.config.run import RunConfig, parse_seeds
from marl_explore.policies.io import load_policy
from marl_explore.training import runs, seeds
from marl_explore.training.run_folder import RunRecord, is_finished, prepare
from marl_explore.utils import records
from marl_explore.utils.interrupts import RunInterruptedError
from tests.helpers.configs import TINY
from tests.helpers.killing import CONFIG, RUN


@pytest.mark.parametrize(
    ("text", "seeds"), [("3", [3]), ("0-4", [0, 1, 2, 3, 4]), ("5,0-1,9", [5, 0, 1, 9])]
)
def test_seeds_in_words(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "-3", "1-", "0-2,1", "1.5", "4-2", "5-3,1"])
def test_wrong_words(text):
    with pytest.raises(ValueError, match=f"seeds='{text}' is not allowed"):
        parse_seeds(text)


def test_a_sweep_has_the_runs_of_its_seeds_and_a_summary(tmp_path, capsys):
    summary = seeds.sweep(CONFIG, tmp_path / "sweep", [0, 3], RUN, jobs=2)
    assert sorted(capsys.readouterr().out.splitlines()) == ["seed 0: done", "seed 3: done"]
    alone = runs.train(replace(CONFIG, seed=3), tmp_path / "alone", RUN, progress=False)
    policy = load_policy(tmp_path / "sweep" / "seed-3")
    for name, weight in alone.state_dict().items():
        assert torch.equal(policy.state_dict()[name], weight)

    last = []
    for seed in (0, 3):
        rows = (tmp_path / "sweep" / f"seed-{seed}" / "scalars" / "reward.csv").read_text()
        last.append(float(rows.splitlines()[-1].split(",")[1]))  # a tenth of 12 updates is one
    assert summary["reward"] == {
        "mean": pytest.approx(sum(last) / 2),
        "low": min(last),  # a quarter of the draws of two seeds are twice the same one
        "high": max(last),
        "seeds": 2,
    }
    assert json.loads((tmp_path / "sweep" / "summary.json").read_text()) == summary
    assert "validation_steps_to_100" in seeds.format_summary(summary)


def long_sweep(folder):
    config, run = replace(CONFIG, episodes=10**6), replace(RUN, checkpoint_every=0)
    try:
        seeds.sweep(config, folder, [0, 1, 2], run, jobs=2)
    except RunInterruptedError as interrupted:
        sys.exit(interrupted.status)


def test_a_stopped_sweep_keeps_a_checkpoint_of_every_run_and_goes_on(tmp_path):
    folder = tmp_path / "sweep"
    process = multiprocessing.get_context("spawn").Process(target=long_sweep, args=(folder,))
    process.start()
    curves = [folder / f"seed-{seed}" / "scalars" / "reward.csv" for seed in (0, 1)]
    deadline = time.monotonic() + 100
    while not all(curve.exists() for curve in curves):
        assert process.is_alive()
        assert time.monotonic() < deadline
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGTERM)
    process.join(60)
    assert process.exitcode == 128 + signal.SIGTERM
    for seed, number in ((0, 1), (1, 1), (2, 0)):
        assert len(list((folder / f"seed-{seed}").glob("checkpoints/*"))) == number
    assert "stopped by SIGTERM; update" in (folder / "seed-0.log").read_text()

    # shorter runs, so that going on ends; the runs that were stopped refuse them
    for seed in (0, 1, 2):
        config = folder / f"seed-{seed}" / "config.json"
        config.write_text(config.read_text().replace(str(10**6), "24"))
    with pytest.raises(ChildProcessError, match=r"seeds \[0, 1\] failed, see .*seed-0\.log"):
        seeds.resume_sweep(folder)
    assert "belongs to another run: episodes=1000000 there" in (folder / "seed-0.log").read_text()
    assert is_finished(folder / "seed-2")
    assert len(json.loads((folder / "sweep.json").read_text())["starts"]) == 2


def test_wrong_settings_are_refused_before_a_folder_is_made(tmp_path):
    with pytest.raises(ValueError, match="reward='fame' is unknown"):
        seeds.sweep(replace(CONFIG, reward="fame"), tmp_path / "sweep", [0], RunConfig())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("numbers", "jobs", "message"),
    [
        ([], None, r"seeds=\(\) is not allowed"),
        ([1, 0, 1], None, r"seeds=\(1, 0, 1\) is not allowed"),
        ([0], 0, "jobs=0 is not allowed"),
    ],
)
def test_wrong_arguments_are_refused_before_a_folder_is_made(tmp_path, numbers, jobs, message):
    with pytest.raises(ValueError, match=message):
        seeds.sweep(CONFIG, tmp_path / "sweep", numbers, jobs=jobs)
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_was_stopped_is_not_done(tmp_path, monkeypatch):
    def stopped(folder, **_):
        raise RunInterruptedError(signal.SIGTERM, "go on with it")

    monkeypatch.setattr(seeds, "detach", lambda: None)
    monkeypatch.setattr(runs, "resume", stopped)
    with pytest.raises(SystemExit) as ended:
        seeds._run_one(tmp_path / "seed-0", None)
    assert ended.value.code == 128 + signal.SIGTERM
    assert "stopped by SIGTERM" in (tmp_path / "seed-0.log").read_text()


def test_one_seed_says_nothing_of_others(tmp_path):
    folder = tmp_path / "seed-0" / "scalars"
    folder.mkdir(parents=True)
    (folder / "episode_return.csv").write_text("1,2.5\n")
    summary = seeds.summarize_seeds(tmp_path, [0])
    assert summary == {"episode_return": {"mean": 2.5, "low": None, "high": None, "seeds": 1}}
    assert seeds.format_summary(summary).split()[-4:] == ["episode_return", "2.500", "-", "-"]


def test_the_runs_of_a_sweep_are_known_once_all_are_finished(tmp_path):
    folder = tmp_path / "sweep"
    frames = TINY.updates * TINY.batch_frames
    for seed, finished in ((0, True), (7, False), (9, False)):
        run = prepare(replace(TINY, seed=seed), folder / f"seed-{seed}", RunConfig())
        RunRecord(RunConfig(), finished=finished, frames=frames).write(run)
    assert seeds.seed_runs(folder) == [str(folder)]  # as yet it is no sweep
    records.write_json(folder / "sweep.json", {"seeds": [0, 7, 9]})
    with pytest.raises(ValueError, match=r"seeds \[7, 9\] of the sweep in .* are not finished"):
        seeds.seed_runs(folder)
    records.write_json(folder / "sweep.json", {"seeds": [0]})
    assert seeds.seed_runs(str(folder)) == [str(folder / "seed-0")]
    assert seeds.seed_runs("best", folder) == ["best", str(folder / "seed-0")]


def test_what_could_not_be_measured_does_not_count(tmp_path):
    for seed, rows in enumerate(("1,nan\n2,0.5\n", "1,nan\n2,nan\n", "1,0.25\n2,0.25\n")):
        folder = tmp_path / f"seed-{seed}" / "scalars"
        folder.mkdir(parents=True)
        (folder / "useful_share.csv").write_text(rows)
    summary = seeds.summarize_seeds(tmp_path, [0, 1, 2])
    assert summary == {"useful_share": {"mean": 0.375, "low": 0.25, "high": 0.5, "seeds": 2}}
