"""Run folders: their owner, their files, and runs that are made longer."""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
import signal
import sys
import time
from dataclasses import replace

import pytest

from marl_explore.config.run import RunConfig
from marl_explore.training import loggers, memory, runs, seeds
from marl_explore.training.nan_guard import NonFiniteError
from marl_explore.training.run_folder import (
    is_finished,
    lengthen,
    prepare,
    read_config,
    read_record,
)
from marl_explore.training.trainer import Trainer
from marl_explore.utils.interrupts import RunInterruptedError
from marl_explore.utils.locks import FolderInUseError, owned
from tests.helpers.configs import TINY
from tests.helpers.killing import CONFIG, RUN
from tests.training.test_resume import assert_same, content


def test_a_run_has_one_owner(tmp_path):
    folder = prepare(TINY, tmp_path / "run", RunConfig(validate_every=0))
    with owned(folder):
        for attempt in (lambda: runs.resume(folder), lambda: lengthen(folder, 48)):
            with pytest.raises(FolderInUseError, match=f"{folder} is in use by process"):
                attempt()
    assert read_record(folder).starts == ()
    runs.resume(folder, progress=False)
    assert is_finished(folder)


@pytest.mark.parametrize("finished", [True, False], ids=["finished", "stopped"])
def test_a_longer_run_is_that_of_this_length_from_the_start(tmp_path, finished):
    config, folder = replace(CONFIG, lr_decay=False), tmp_path / "run"
    # validations fall on the same updates: the last update of the short run has one too
    run = replace(RUN, validate_every=3)
    short = replace(config, episodes=config.episodes // 2)
    if finished:
        runs.train(short, folder, run, progress=False)
    else:
        prepare(short, folder, run)
    lengthen(folder, config.episodes)
    assert not is_finished(folder)
    runs.resume(folder, progress=False)
    runs.train(config, tmp_path / "long", run, progress=False)
    assert_same(content(folder), content(tmp_path / "long"))
    assert read_record(folder).frames == config.updates * config.batch_frames


def test_a_run_cannot_be_made_shorter(tmp_path):
    folder = prepare(TINY, tmp_path / "run", RunConfig(validate_every=0))
    with pytest.raises(ValueError, match=r"episodes=23 is not allowed: the run in .* has 24"):
        lengthen(folder, 23)
    assert read_config(folder) == TINY
    runs.resume(folder, progress=False)
    more_but_no_update = TINY.episodes + 1
    for attempt in (lengthen, lambda f, n: runs.resume(f, episodes=n)):
        with pytest.raises(ValueError, match="can only be made longer, by whole updates of 4 epis"):
            attempt(folder, more_but_no_update)
    assert read_config(folder) == TINY


def test_a_sweep_is_made_longer_as_a_whole_or_not_at_all(tmp_path):
    run = RunConfig(validate_every=0)
    seeds.sweep(replace(TINY, episodes=8), tmp_path / "sweep", [0, 1], run, jobs=1)
    lengthen(tmp_path / "sweep" / "seed-1", 24)
    with pytest.raises(ValueError, match="episodes=16 is not allowed: the run in .*seed-1 has 24"):
        seeds.resume_sweep(tmp_path / "sweep", episodes=16)
    assert read_config(tmp_path / "sweep" / "seed-0").episodes == 8


def test_a_run_without_its_record_goes_on_with_the_default_settings(tmp_path, caplog):
    folder = prepare(TINY, tmp_path / "run", RunConfig(validate_every=0))
    (folder / "run.json").unlink()
    runs.resume(folder, progress=False)
    assert caplog.text.count("run.json is missing") == 1
    assert read_record(folder).execution == RunConfig()
    assert is_finished(folder)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("config.json", "{", "config.json is not JSON"),
        ("config.json", '{"episodes": 3}', "config.json: network=None"),
        ("run.json", "[]", "run.json is not a JSON object"),
        ("run.json", '{"execution": {"workers": "2"}}', "run.json, execution: workers='2'"),
        ("run.json", '{"execution": {}, "frames": "x"}', "run.json: frames='x'"),
    ],
)
def test_damaged_records_are_named(tmp_path, file, text, message):
    folder = prepare(TINY, tmp_path / "run", RunConfig())
    (folder / file).write_text(text)
    with pytest.raises(ValueError, match=message):
        runs.resume(folder)


def test_a_folder_without_a_run_is_named(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path} is not a run folder: it has no config.json"):
        runs.resume(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_run_whose_folder_is_removed_ends_with_its_name(tmp_path):
    folder = prepare(TINY, tmp_path / "run", RunConfig())
    log = loggers.Loggers("csv", folder, {}, 0)
    assert not (folder / "videos").exists()
    log.log({"reward": 1.0}, 10)
    (folder / "scalars" / "reward.csv").unlink()
    (folder / "scalars").rmdir()
    with pytest.raises(OSError, match=f"{folder / 'scalars'}"):
        log.log({"other": 1.0}, 20)


def test_an_overflow_in_the_loss_names_the_last_good_checkpoint(tmp_path, monkeypatch):
    def fail(*_):
        raise FloatingPointError("the factor is not finite")

    monkeypatch.setattr(Trainer, "update", fail)
    with pytest.raises(NonFiniteError, match="the factor is not finite; there is no checkpoint"):
        runs.train(TINY, tmp_path / "run", RunConfig(validate_every=0), progress=False)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"num_envs": 10**8, "episodes": 10**9},
            "num_envs=100000000 x rollout_steps=10 would need",
        ),
        ({"rollout_steps": 10**9, "episodes": 10**9}, "rollout_steps=1000000000 would need"),
        ({"arena": replace(TINY.arena, height=10**6, width=10**6)}, "would need"),
        ({"network": replace(TINY.network, hidden=(10**9, 10**9))}, "weights of network=.* need"),
        ({"network": replace(TINY.network, hidden=(2**62, 2**62))}, "weights of network=.* need"),
    ],
)
def test_runs_that_do_not_fit_are_refused_before_anything_is_made(changes, message):
    with pytest.raises(ValueError, match=message):
        memory.require_training_memory(replace(TINY, **changes))


@pytest.mark.parametrize("setting", ["validation_arenas", "validation_steps"])
def test_validations_that_do_not_fit_are_refused_before_anything_is_made(tmp_path, setting):
    run = RunConfig(**{setting: 10**12})
    with pytest.raises(ValueError, match=f"{setting}=1000000000000 .*not allowed: .* would need"):
        runs.train(TINY, tmp_path / "run", run)
    assert not list(tmp_path.iterdir())


LONG = replace(CONFIG, episodes=4 * CONFIG.episodes)


def sweep(folder):
    try:
        if seeds.is_sweep(folder):
            seeds.resume_sweep(folder)
        else:
            seeds.sweep(LONG, folder, [0, 1], RUN, jobs=2)
    except RunInterruptedError as interrupted:
        sys.exit(interrupted.status)


def test_a_sweep_that_is_killed_and_resumed_at_once_loses_nothing(tmp_path):
    folder = tmp_path / "sweep"
    process = multiprocessing.get_context("spawn").Process(target=sweep, args=(folder,))
    process.start()
    curves = [folder / f"seed-{seed}" / "scalars" / "reward.csv" for seed in (0, 1)]
    deadline = time.monotonic() + 100
    while not all(curve.exists() for curve in curves):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)  # its children find out and end after their update
    process.join()
    seeds.resume_sweep(folder)
    for seed in (0, 1):
        alone = tmp_path / f"alone-{seed}"
        runs.train(replace(LONG, seed=seed), alone, RUN, progress=False)
        assert_same(content(folder / f"seed-{seed}"), content(alone))
    starts = json.loads((folder / "seed-0" / "run.json").read_text())["starts"]
    assert len(starts) == 2


def test_a_sweep_can_be_made_longer(tmp_path):
    short = replace(TINY, episodes=12)
    run = RunConfig(validate_every=0)
    seeds.sweep(short, tmp_path / "sweep", [0, 1], run, jobs=1)
    seeds.resume_sweep(tmp_path / "sweep", episodes=24)
    for seed in (0, 1):
        folder = tmp_path / "sweep" / f"seed-{seed}"
        assert is_finished(folder)
        assert len((folder / "scalars" / "reward.csv").read_text().splitlines()) == TINY.updates


def test_a_full_disk_under_a_curve_is_one_error(tmp_path, capfd):
    folder = prepare(TINY, tmp_path / "run", RunConfig())
    log = loggers.Loggers("csv", folder, {}, 0)
    log.log({"reward": 1.0}, 10)
    files = log._loggers[0].experiment.files
    path = str(folder / "scalars" / "reward.csv")
    files[path].close()
    files[path] = open("/dev/full", "a")  # noqa: SIM115 - as TorchRL's logger holds it
    with pytest.raises(OSError, match=f"No space left on device: '{path}'"):
        log.log({"reward": 2.0}, 20)
    log.close()
    del log
    gc.collect()
    assert "Traceback" not in capfd.readouterr().err
