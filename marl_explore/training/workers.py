"""Failing workers: distinguishes a worker that was killed from one that raised an error."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from torchrl.collectors import MultiAsyncCollector, MultiSyncCollector

SECONDS_TO_END = 10
"""How long to wait for the exit code of a process whose pipe has closed."""
_REPORT_BYTES = 2000  # small enough for an atomic write to a pipe


class WorkerError(ChildProcessError):
    """A worker raised an error, or workers died repeatedly; the last full batch is not lost."""


class WorkerDeathError(ChildProcessError):
    """A worker was killed from outside, so replacing it may help."""


class Watched:
    """Aborts the start of TorchRL's worker processes when one of them dies.

    TorchRL waits for the first message of each worker in turn, and does not notice a dead one
    while others hold its pipe or wait for a lock that it held.
    """

    procs: list[BaseProcess]
    reports: Connection | None = None
    """Pipe through which workers report the errors that end them."""

    def _run_processes(self) -> None:
        self.procs = []
        ready = threading.Event()
        watch = threading.Thread(target=self._end_all_with_one, args=(ready,), daemon=True)
        watch.start()
        try:
            with classify_worker_errors(lambda: self):
                super()._run_processes()  # type: ignore[misc]
        finally:
            ready.set()
            watch.join()

    def _end_all_with_one(self, ready: threading.Event) -> None:
        while not ready.wait(0.1):
            processes = [*self.procs]
            if any(process.exitcode not in (None, 0) for process in processes):
                for process in processes:
                    process.terminate()


class SyncWorkers(Watched, MultiSyncCollector):
    """Worker processes in step."""


class AsyncWorkers(Watched, MultiAsyncCollector):
    """Worker processes that never wait."""


def report(error: Exception, reports: Connection | None) -> None:
    """Report, in a worker, the error that ends it."""
    if reports is not None:
        with suppress(OSError):  # nobody is listening any more
            reports.send_bytes(_line(error).encode()[:_REPORT_BYTES])


@contextmanager
def classify_worker_errors(find_collector: Callable[[], Any]) -> Iterator[None]:
    """Convert any failure of a collector's workers into one of two errors.

    Args:
        find_collector: returns the collector, or None if it has not been made.

    Raises:
        WorkerDeathError: for a worker that was killed from outside.
        WorkerError: for an error that a worker or this process raised; it names the error.
    """
    try:
        yield
    except (WorkerDeathError, WorkerError):
        raise
    except Exception as error:
        collector = find_collector()
        # TorchRL raises RuntimeError for both: exit codes tell which it was
        cut_off = isinstance(error, _CUT_OFF) or isinstance(error.__cause__, _CUT_OFF)
        ends = _ends(getattr(collector, "procs", ()), SECONDS_TO_END if cut_off else 0)
        failed = [worker for worker, code in ends.items() if code > 0]
        if failed:
            said = _read(collector.reports) or "an error; its traceback is above"
            raise WorkerError(f"worker {failed[0]} failed with {said}") from error
        if any(ends.values()):
            killed = {worker: code for worker, code in ends.items() if code < 0}
            # the others were terminated because of it
            first = min(killed, key=lambda worker: killed[worker] == -signal.SIGTERM)
            how = signal.Signals(-killed[first]).name
            raise WorkerDeathError(f"worker {first} was killed by {how}") from error
        if cut_off or _died_in_ray(error):
            raise WorkerDeathError(f"a worker died: {_line(error)}") from error
        raise WorkerError(f"collecting failed: {_line(error)}") from error


_CUT_OFF = (EOFError, ConnectionError)


def _ends(processes: Sequence[BaseProcess], patience: float) -> dict[int, int]:
    """Exit codes of the workers that have ended; TorchRL closes the others."""
    ends = {}
    with suppress(ValueError):  # of processes that are closed
        ended = wait([process.sentinel for process in processes], patience)
        for process in processes:
            if process.sentinel in ended:
                process.join(patience)
    for worker, process in enumerate(processes):
        with suppress(ValueError):
            if process.exitcode is not None:
                ends[worker] = process.exitcode
    return ends


def _read(reports: Connection | None) -> str | None:
    with suppress(EOFError):
        if reports is not None and reports.poll():
            return reports.recv_bytes().decode(errors="replace")
    return None


def _died_in_ray(error: Exception) -> bool:
    if "ray" not in sys.modules or not isinstance(error, sys.modules["ray"].exceptions.RayError):
        return False
    exceptions = sys.modules["ray"].exceptions
    return not (
        isinstance(error, exceptions.RayTaskError) or getattr(error, "actor_init_failed", False)
    )


def _line(error: Exception) -> str:
    """Type and message of an error in one line; for one that Ray wraps, those of its cause."""
    cause = getattr(error, "cause", None) or error
    message = next(iter(str(cause).strip().splitlines()), "")
    return f"{type(cause).__name__}: {message}"
