"""Batches from any collector; workers that die are replaced."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from safetensors.torch import load, save
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector

from marl_explore.config.run import RunConfig
from marl_explore.training.workers import WorkerDeathError, WorkerError, classify_worker_errors

logger = logging.getLogger(__name__)

ArenaStates = dict[str, Tensor]


class RestartingCollector:
    """Batches [B, T] from any collector, with workers that die replaced.

    When a worker dies, all of them are restarted with the arenas and random generators that they
    had before the batch, so that the same batch is collected again. Workers of "multiasync", which
    never wait, start with new arenas.

    Args:
        make: makes the collector, given ``first_arena``.
        policy: its parameters are sent to the workers before every batch.
        run: which collector it is.
        num_envs: total number of arenas.
    """

    MAX_RESTARTS = 3

    def __init__(
        self,
        make: Callable[..., BaseCollector],
        policy: TensorDictModuleBase,
        run: RunConfig,
        num_envs: int,
    ) -> None:
        self._make, self._policy = make, policy
        self._kind, self._workers, self._num_envs = run.collector, run.workers, num_envs
        self._collector: BaseCollector | None = None
        self._states: list[Any] | None = None
        self._done = 0

    def next(self) -> TensorDictBase:
        """The next batch.

        Raises:
            WorkerError: when a worker died after ``MAX_RESTARTS`` restarts, or raised an error
                of its own.
        """
        if self._kind == "process":
            return self._collect()
        for restarts in range(self.MAX_RESTARTS + 1):
            try:
                with classify_worker_errors(lambda: self._collector):
                    return self._collect()
            except WorkerDeathError as error:
                self.close()
                cause = error
                logger.warning("%s; restarting all workers (%d)", error, restarts + 1)
        times = self.MAX_RESTARTS + 1
        raise WorkerError(f"workers died {times} times in a row; last error: {cause}") from cause

    def prepare(self) -> None:
        """Start a collector of this process, if it is not running; ``next`` starts any.

        Loading a state sets the process's random generator, so if it has several collectors, all
        must be prepared before any of them collects.
        """
        if self._kind == "process":
            self._start()

    def _start(self) -> None:
        if self._collector is None:
            lost = self._done if self._kind == "multiasync" else 0
            self._collector = self._make(first_arena=lost * self._num_envs)
            if self._states is not None:
                self._collector.map_fn("load_state_dict", [(state,) for state in self._states])
            self._batches = iter(self._collector)

    def _collect(self) -> TensorDictBase:
        self._start()
        assert self._collector is not None
        in_step = self._kind in ("multisync", "ray")
        if in_step:  # not with TorchRL's schemes, which wait forever for a worker that died
            weights = save(self._policy.state_dict())
            self._collector.map_fn("load_weights", [(weights,)] * self._workers)
        elif self._kind == "multiasync":
            self._collector.update_policy_weights_()
        batch = next(self._batches)
        if in_step:
            self._states = self._collector.map_fn("state_dict")
        self._done += 1
        return batch

    def state(self) -> list[ArenaStates]:
        """For every worker, what its next batch depends on; empty where it is not known."""
        if self._kind == "process" and self._collector is not None:
            self._states = self._collector.map_fn("state_dict")
        return [load(state["packed"]) for state in self._states or ()]

    def load(self, states: list[ArenaStates], done: int) -> None:
        """Resume from a ``state``; call this before the first batch.

        Args:
            states: for the same number of workers.
            done: number of batches that were collected before.

        Raises:
            ValueError: for another number of workers.
        """
        if len(states) not in (0, self._workers):
            raise ValueError(
                f"workers={self._workers} is not allowed: the state is for {len(states)}"
            )
        self._states = [{"packed": save(state)} for state in states] or None
        self._done = done

    def close(self) -> None:
        """Stop the workers."""
        if self._collector is not None:
            with suppress(Exception):  # of workers that are dead already
                self._collector.shutdown()
            self._collector = None
