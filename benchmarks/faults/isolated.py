"""Functions that run in processes of their own, with their output, their time and their end."""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

LIMIT = 20.0
"""No refusal may take longer (seconds)."""
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["benchmarks.faults.programs"])


class Outcome(NamedTuple):
    """How a process ended."""

    status: int | None
    """Exit status; None when it had to be killed because it took too long."""
    output: str
    """What it printed, standard error included."""

    @property
    def crashed(self) -> bool:
        """Whether it showed a traceback or hung."""
        return self.status is None or "Traceback (most recent call last)" in self.output

    @property
    def refused(self) -> bool:
        """Whether it ended with an error that a user can read."""
        return not self.crashed and self.status not in (0, None) and bool(self.output.strip())


def start(target: Callable[..., None], *args: object, folder: Path, output: Path):
    """Start a function in a process of its own, in a folder, its output into a file."""
    process = SERVER.Process(target=_run, args=(target, args, str(folder), str(output)))
    process.start()
    return process


def run(target: Callable[..., None], *args: object, folder: Path, limit: float = LIMIT) -> Outcome:
    """Run a function in a process of its own until it ends, or is killed after a time."""
    handle, name = tempfile.mkstemp()
    os.close(handle)
    output = Path(name)
    process = start(target, *args, folder=folder, output=output)
    process.join(limit)
    if alive := process.is_alive():
        process.kill()
        process.join()
    text = output.read_text(errors="replace")
    output.unlink()
    return Outcome(None if alive else process.exitcode, text)


def wait_for(ready: Callable[[], bool], seconds: float = 120.0) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            raise TimeoutError("it never came to it")
        time.sleep(0.01)


def _run(target: Callable[..., None], args: tuple, folder: str, output: str) -> None:
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(file, stream)
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", closefd=False)
    os.chdir(folder)
    try:
        target(*args)
    finally:
        sys.stdout.flush()
