"""Ownership of a folder by one process."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from marl_explore.utils.files import naming

LOCK_FILE = ".lock"
"""Locked while a process owns the folder; it stays, and holds the number of the last owner."""


class FolderInUseError(ValueError):
    """Another process owns a folder; the message names both."""


@contextmanager
def owned(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Own a folder in this context; the operating system ends ownership with the process.

    Args:
        folder: must exist.
        patience: how long to wait for another owner (seconds).

    Raises:
        FolderInUseError: when another process still owns it.
        OSError: naming the lock file, when it cannot be made.
    """
    file = folder / LOCK_FILE
    owner = _owner(file)
    lock = FileLock(file)
    try:
        with naming(file):
            lock.acquire(timeout=patience)
    except Timeout as error:
        raise FolderInUseError(
            f"{folder} is in use by {owner}: wait until it ends, or stop it"
        ) from error
    try:
        with naming(file):
            file.write_text(str(os.getpid()))
        yield
    finally:
        lock.release()


def _owner(file: Path) -> str:
    with suppress(OSError, ValueError):
        return f"process {int(file.read_text())}"
    return "another process"
