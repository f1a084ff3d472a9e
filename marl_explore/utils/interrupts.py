"""Signals that stop a run cleanly."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class RunInterruptedError(Exception):
    """A run was stopped by a signal and can be resumed; the message says how.

    Args:
        which: the signal.
        how: how to resume.
    """

    def __init__(self, which: signal.Signals, how: str) -> None:
        super().__init__(f"stopped by {which.name}; {how}")
        self.status = 128 + which
        """Exit status of a program that is ended by this signal."""


class Request:
    """Which signal asked to stop, if one did."""

    signal: signal.Signals | None = None


@contextmanager
def deferred() -> Iterator[Request]:
    """Record SIGINT and SIGTERM in this context instead of exiting; a second one acts as usual.

    Outside the main thread, where Python cannot handle signals, this does nothing.
    """
    request = Request()
    before: dict[signal.Signals, Any] = {}

    def note(number: int, _: FrameType | None) -> None:
        request.signal = signal.Signals(number)
        restore()

    def restore() -> None:
        while before:
            signal.signal(*before.popitem())

    if threading.current_thread() is threading.main_thread():
        for which in SIGNALS:
            before[which] = signal.signal(which, note)
    try:
        yield request
    finally:
        restore()


def end_with_parent() -> None:
    """Send this process a SIGTERM as soon as the process that started it is gone, even killed."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()


def detach() -> None:
    """Take a worker out of its parent's process group, so that Ctrl-C reaches only the parent."""
    if hasattr(os, "setsid") and os.getpgrp() != os.getpid():  # else it already leads one
        os.setsid()
