"""Arenas for worker processes: each makes its part of one numbering, so that none is made twice."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import lru_cache, partial
from multiprocessing import parent_process
from typing import Protocol

from torchrl.envs import EnvBase

from marl_explore.config.checks import require, require_integer

_IGNORE_ALL = ("ignore", None, Warning, None, 0)
"""The filter of ``warnings.simplefilter("ignore")``."""


class CreateEnv(Protocol):
    """Makes a part of the arenas: ``num_envs`` of them, starting at index ``first_arena``."""

    def __call__(self, *, num_envs: int, first_arena: int) -> EnvBase:
        """A batched environment around an ``ExplorationEnv``."""


def split_arenas(
    create_env: CreateEnv, workers: int, num_envs: int, first_arena: int = 0
) -> list[Callable[[], EnvBase]]:
    """Functions for ``ParallelEnv`` or ``MultiSyncCollector``, each with arenas of its own.

    Together the workers have the arenas of ``create_env(num_envs=num_envs, first_arena=...)``, in
    that order. The functions can be pickled if ``create_env`` can.

    Args:
        create_env: such as ``make_env`` or ``partial(make_env, config, reward="team")``.
        workers: number of worker processes.
        num_envs: arenas of all workers together.
        first_arena: index of the first arena.

    Raises:
        ValueError: naming argument, value and what is allowed, for numbers out of range and when
            ``workers`` does not divide ``num_envs``.
    """
    require_integer("num_envs", num_envs, 1)
    require_integer("workers", workers, 1)
    require_integer("first_arena", first_arena, 0)
    require_even_shares(workers, num_envs)
    part = num_envs // workers
    return [
        partial(create_env, num_envs=part, first_arena=first)
        for first in range(first_arena, first_arena + num_envs, part)
    ]


def require_even_shares(workers: int, num_envs: int) -> None:
    """Require that every worker gets equally many arenas."""
    require(num_envs % workers == 0, "workers", workers, f"it must divide num_envs={num_envs}")


def in_worker() -> bool:
    """Whether this is a child process of ``multiprocessing``, as TorchRL's workers are."""
    return parent_process() is not None


@lru_cache
def warn_of_shared_arenas() -> None:
    """Say, once per process, that other workers may have the same arenas.

    TorchRL's workers ignore every warning, and so would never show one that is about them.
    """
    with warnings.catch_warnings():
        if warnings.filters and warnings.filters[0] == _IGNORE_ALL:
            warnings.simplefilter("default")
        warnings.warn(
            "an ExplorationEnv was made in a worker process without first_arena or set_seed: "
            "every worker that makes it with the same arguments steps through the same arenas. "
            "Use marl_explore.split_arenas, or pass first_arena (0 if the seeds differ)",
            UserWarning,
            stacklevel=2,
        )
