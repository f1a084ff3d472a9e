"""A folder has one owner, for as long as that process lives."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import pytest

from marl_explore.utils.interrupts import end_with_parent
from marl_explore.utils.locks import FolderInUseError, owned

SPAWN = multiprocessing.get_context("spawn")


def hold(folder, ready):
    with owned(folder):
        ready.set()
        time.sleep(600)


@pytest.fixture
def holder(tmp_path):
    ready = SPAWN.Event()
    process = SPAWN.Process(target=hold, args=(tmp_path, ready))
    process.start()
    assert ready.wait(100)
    yield process
    process.kill()
    process.join()


def test_a_second_owner_is_refused_by_name_until_the_first_is_gone(tmp_path, holder):
    with (
        pytest.raises(FolderInUseError, match=f"{tmp_path} is in use by process {holder.pid}"),
        owned(tmp_path),
    ):
        raise AssertionError
    os.kill(holder.pid, signal.SIGKILL)
    with owned(tmp_path, patience=30), pytest.raises(FolderInUseError, match=f"{os.getpid()}"):  # noqa: SIM117
        with owned(tmp_path):
            raise AssertionError
    with owned(tmp_path):
        pass


def test_who_waits_gets_the_folder(tmp_path, holder):
    timer = SPAWN.Process(target=kill_soon, args=(holder.pid,))
    timer.start()
    with owned(tmp_path, patience=100):
        assert not holder.is_alive() or holder.join(10) is None
    timer.join()


def kill_soon(pid):
    time.sleep(0.5)
    os.kill(pid, signal.SIGKILL)


def parent(numbers):
    child = SPAWN.Process(target=orphan, args=(numbers,))
    child.start()
    time.sleep(600)


def orphan(numbers):
    end_with_parent()
    numbers.put(os.getpid())
    time.sleep(600)


def test_a_child_ends_with_its_killed_parent():
    numbers = SPAWN.Queue()
    process = SPAWN.Process(target=parent, args=(numbers,))
    process.start()
    child = numbers.get(timeout=100)
    process.kill()
    process.join()
    deadline = time.monotonic() + 60
    while is_running(child):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def is_running(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
