"""Runs that are stopped, killed or damaged, and resumed."""

from __future__ import annotations

import json
import logging
import os
import random
import signal
import threading
import time
from dataclasses import replace

import pytest
import torch

from marl_explore.policies.io import load_policy
from marl_explore.policies.networks import MLP
from marl_explore.training import loop, runs
from marl_explore.training.checkpoint import (
    CheckpointError,
    list_checkpoints,
    read_checkpoint,
    write_checkpoint,
)
from marl_explore.training.run_folder import is_finished
from marl_explore.training.trainer import Trainer
from marl_explore.utils.interrupts import RunInterruptedError, deferred
from tests.helpers.killing import CONFIG, RUN, start

TIMES = ("seconds", "rate")


def content(folder):
    """Everything a run produced but times: curves, the last state, the policies."""
    curves = {
        file.stem: file.read_text()
        for file in (folder / "scalars").iterdir()
        if file.stem not in TIMES
    }
    state = read_checkpoint(list_checkpoints(folder)[-1])
    del state["trainer"]["seconds"]
    policies = [load_policy(folder / name) for name in ("policy.safetensors", "best.safetensors")]
    return curves, state, [policy.state_dict() for policy in policies]


def assert_same(one, two, where=""):
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, two), where
    elif isinstance(one, dict):
        assert one.keys() == two.keys(), where
        for key in one:
            assert_same(one[key], two[key], f"{where}/{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(two), where
        for index, pair in enumerate(zip(one, two, strict=True)):
            assert_same(*pair, f"{where}/{index}")
    else:
        assert one == two, where


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "undisturbed"
    runs.train(CONFIG, folder, RUN, progress=False)
    return content(folder)


def finish(folder):
    process = start(folder)
    process.join(60)
    assert process.exitcode == 0
    assert is_finished(folder)


@pytest.mark.parametrize(
    ("moment", "call"),
    [
        ("collecting", 1),
        ("collecting", 8),
        ("in an update", 37),
        ("in an update", 90),
        ("logging", 100),
        ("validating", 2),
        ("before a checkpoint", 1),
        ("writing a checkpoint", 1),
        ("writing a checkpoint", 2),
        ("writing a checkpoint", 4),
        ("putting a file in its place", 3),
        ("putting a file in its place", 4),
        ("putting a file in its place", 6),
        ("removing a checkpoint", 4),
        ("writing the policy", 1),
    ],
)
def test_a_killed_run_ends_like_one_never_killed(tmp_path, undisturbed, moment, call):
    folder = tmp_path / "run"
    process = start(folder, moment, call)
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    finish(folder)
    assert_same(content(folder), undisturbed)


def test_a_run_killed_again_and_again_at_random_times(tmp_path, undisturbed):
    folder = tmp_path / "run"
    start(folder, "collecting", 1).join(60)
    draw, kills = random.Random(1), 1
    while not is_finished(folder):
        process = start(folder)
        # longer and longer: a busy machine must come to the next checkpoint in the end
        process.join(draw.uniform(0.05, 0.5) * (1 + kills / 10))
        process.kill()
        process.join()
        assert process.exitcode in (0, -signal.SIGKILL)
        kills += 1
        assert kills < 200
    assert_same(content(folder), undisturbed)
    starts = json.loads((folder / "run.json").read_text())["starts"]
    assert 1 < len(starts) <= kills
    assert [s["updates"] for s in starts] == sorted(s["updates"] for s in starts)


def test_no_half_written_file_is_left(tmp_path):
    folder = tmp_path / "run"
    start(folder, "writing a checkpoint", 2).join(60)
    assert list(folder.rglob("*.unfinished"))
    finish(folder)
    assert not list(folder.rglob("*.unfinished"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_the_update_with_a_checkpoint(tmp_path, undisturbed, number):
    folder = tmp_path / "run"
    before = signal.getsignal(number)
    timer = threading.Timer(0.3, os.kill, (os.getpid(), number))
    timer.start()
    with pytest.raises(
        RunInterruptedError, match=rf"stopped by {number.name}; update .* resume {folder}"
    ):
        runs.train(replace(CONFIG, episodes=24_000), folder, RUN, progress=False)
    assert signal.getsignal(number) is before
    config = json.loads((folder / "config.json").read_text())
    state = read_checkpoint(list_checkpoints(folder)[-1])
    rows = (folder / "scalars" / "reward.csv").read_text().splitlines()
    assert len(rows) == state["trainer"]["updates"]

    # the same run, as short as the undisturbed one, goes on to the same end
    if state["trainer"]["updates"] < CONFIG.updates:
        (folder / "config.json").write_text(json.dumps({**config, "episodes": CONFIG.episodes}))
        with pytest.raises(
            CheckpointError, match="belongs to another run: episodes=24000 there, 24"
        ):
            runs.resume(folder, progress=False)


@pytest.fixture
def interruptible():
    """What SIGINT does in a shell's foreground; who is started in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_second_signal_does_not_wait(interruptible):
    with deferred() as request:
        os.kill(os.getpid(), signal.SIGINT)
        assert request.signal is signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_signals_are_left_alone_outside_the_main_thread():
    def wait():
        with deferred():
            handlers.append(signal.getsignal(signal.SIGTERM))

    handlers = [signal.getsignal(signal.SIGTERM)]
    thread = threading.Thread(target=wait)
    thread.start()
    thread.join()
    assert handlers[0] is handlers[1]


def stopped(folder, updates=6):
    """A run that has come to some update."""
    start(folder, "collecting", updates + 1).join(60)
    return list_checkpoints(folder)


def test_a_damaged_checkpoint_is_named_and_the_one_before_it_is_used_when_asked(
    tmp_path, undisturbed
):
    folder = tmp_path / "run"
    previous, last = stopped(folder)
    last.write_bytes(last.read_bytes()[:-1])
    with pytest.raises(
        CheckpointError, match=rf"{last.name} is not a .*--from-previous True .*{previous.name}"
    ):
        runs.resume(folder, progress=False)
    runs.resume(folder, from_previous=True, progress=False)
    assert_same(content(folder), undisturbed)


def test_there_must_be_a_previous_checkpoint(tmp_path):
    folder = tmp_path / "run"
    stopped(folder, updates=3)
    with pytest.raises(ValueError, match="has no checkpoint before the last one: 1 in all"):
        runs.resume(folder, from_previous=True)


def test_an_abandoned_checkpoint_counts_no_longer(tmp_path, undisturbed, monkeypatch):
    folder = tmp_path / "run"
    previous, last = stopped(folder)

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "run_training", killed)
    with pytest.raises(KeyboardInterrupt):
        runs.resume(folder, from_previous=True, progress=False)
    assert list_checkpoints(folder) == [previous]
    with pytest.raises(ValueError, match="has no checkpoint before the last one: 1 in all"):
        runs.resume(folder, from_previous=True, progress=False)
    monkeypatch.undo()
    runs.resume(folder, progress=False)
    assert_same(content(folder), undisturbed)
    assert all(file in list_checkpoints(folder) for file in (folder / "checkpoints").iterdir())
    assert last in list_checkpoints(folder)  # written anew


def test_other_versions_are_told(tmp_path, monkeypatch, caplog, undisturbed):
    folder = tmp_path / "run"
    last = stopped(folder)[-1]
    now = loop.versions()
    monkeypatch.setattr(runs, "versions", lambda: now | {"torch": "9.9", "tensordict": "0.99"})
    with caplog.at_level(logging.WARNING, "marl_explore"):
        runs.resume(folder, progress=False)
    (message,) = caplog.messages
    assert message == (
        f"{last} was written with torch {now['torch']} (now 9.9), tensordict {now['tensordict']} "
        "(now 0.99): the run resumes, but may not be bit-exact"
    )
    assert_same(content(folder), undisturbed)


def test_the_same_versions_are_not_told(tmp_path, caplog):
    folder = tmp_path / "run"
    stopped(folder)
    runs.resume(folder, progress=False)
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("inside", "key", "message"),
    [
        (False, "best", "has no entry best"),
        (False, "trainer", "has no entry trainer"),
        (True, "generator", "cannot be resumed from: the state .*: it has no 'generator'"),
    ],
)
def test_a_checkpoint_that_lacks_something_is_named(tmp_path, inside, key, message):
    folder = tmp_path / "run"
    last = stopped(folder)[-1]
    state = read_checkpoint(last)
    del (state["trainer"] if inside else state)[key]
    write_checkpoint(folder, 6, state, keep=3)
    with pytest.raises(CheckpointError, match=f"{last.name} {message}"):
        runs.resume(folder, progress=False)


def test_a_finished_run_is_not_gone_on_with(tmp_path):
    folder = tmp_path / "run"
    finish(folder)
    with pytest.raises(ValueError, match=r"run is finished: there is nothing to resume"):
        runs.resume(folder)


def test_what_is_no_run_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a run folder"):
        runs.resume(tmp_path)
    stopped(tmp_path / "run", 1)
    config = tmp_path / "run" / "config.json"
    config.write_text(json.dumps({**CONFIG.to_json(), "gamma": 2.0}))
    with pytest.raises(ValueError, match=r"config.json: gamma=2.0 is not allowed"):
        runs.resume(tmp_path / "run")


def test_a_state_of_other_networks_is_refused():
    state = Trainer(CONFIG).state_dict()
    with pytest.raises(ValueError, match="the state does not fit this run: .*size mismatch"):
        Trainer(replace(CONFIG, network=MLP(hidden=(8, 8)))).load_state_dict(state)
    wider = Trainer(replace(CONFIG, arena=replace(CONFIG.arena, num_agents=3)))
    state["learners"]["team"]["loss"] = wider.state_dict()["learners"]["team"]["loss"]
    with pytest.raises(ValueError, match="the state does not fit this run: it has no 'robot_2'"):
        wider.load_state_dict(state)


def test_time_goes_on_from_the_checkpoint(tmp_path):
    folder = tmp_path / "run"
    stopped(folder)
    time.sleep(0.5)  # nobody trains meanwhile
    runs.resume(folder, progress=False)
    seconds = [
        float(row.split(",")[1])
        for row in (folder / "scalars" / "seconds.csv").read_text().splitlines()
    ]
    assert seconds == sorted(seconds)
    assert len(seconds) == CONFIG.updates
