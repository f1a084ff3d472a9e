"""Calls of a C function on the rows of a batch, shared among torch's number of threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch


def share_rows(run: Callable[[int, int], int], rows: int, per_thread: int) -> int:
    """Call a function on parts of ``rows`` side by side; returns the largest of its error codes.

    Args:
        run: of the first and the last row of a part, returning an error code; 0 is success.
        rows: how many.
        per_thread: a thread is worth starting for so many rows.
    """
    threads = max(1, min(torch.get_num_threads(), rows // per_thread))
    bounds = [rows * i // threads for i in range(threads + 1)]
    run_all = map if threads == 1 else _pool(threads).map
    return max(run_all(run, bounds[:-1], bounds[1:]))


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="native")


if hasattr(os, "register_at_fork"):  # threads do not survive a fork
    os.register_at_fork(after_in_child=_pool.cache_clear)
