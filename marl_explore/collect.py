"""From settings to a TorchRL collector: in this process, in worker processes, or in Ray's."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial
from importlib.util import find_spec
from typing import Any, Protocol

import torch
from safetensors.torch import load, save
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase
from torchrl.weight_update import SharedMemWeightSyncScheme

from marl_explore.core.hashing import stream_seed
from marl_explore.execution import RunConfig
from marl_explore.interrupts import detach
from marl_explore.team import TeamActor

logger = logging.getLogger(__name__)

ArenaStates = dict[str, Tensor]


class CreateEnv(Protocol):
    """Makes a part of all arenas: ``num_envs`` of them from number ``first_arena`` on."""

    def __call__(self, *, num_envs: int, first_arena: int) -> EnvBase:
        """A batched environment around an ``ExplorationEnv``, with "episode_reward"."""


class ResumableCollector(Collector):
    """A collector whose state holds what TorchRL's leaves out, so that it goes on exactly.

    ``state_dict`` has the arenas under way, the returns so far, and the random generator that
    actions are drawn from; ``load_state_dict`` puts all of them back.
    """

    _returns: Tensor | None = None

    def rollout(self) -> TensorDictBase:
        """The next batch [B, T], the actors of a team run as one network."""
        team = isinstance(self.policy, TeamActor)
        with self.policy.stacked.together() if team else nullcontext():
            batch = super().rollout()
        last = batch["next"][:, -1]
        self._returns = last["episode_reward"].masked_fill(last["done"], 0.0)
        return batch

    def state_dict(self) -> dict[str, bytes]:
        """Everything the future depends on but the policy, packed into one entry.

        One entry, because between processes each tensor takes a file descriptor.
        """
        state: dict[str, Any] = self.env.base_env.state_dict()
        returns = self._returns
        if returns is None:
            returns = self.env.full_reward_spec.zero()["reward"]
        tensors = {name: value.clone() for name, value in state.items() if name != "seed"}
        tensors |= {"returns": returns, "random": torch.get_rng_state()}
        return {"packed": save(tensors)}

    def load_state_dict(self, state_dict: dict[str, bytes], **_: Any) -> None:
        """Go on from a ``state_dict`` of a collector of the same arenas."""
        tensors = load(state_dict["packed"])
        random, returns = tensors.pop("random"), tensors.pop("returns")
        env = self.env.base_env
        env.load_state_dict({**tensors, "seed": env.state_dict()["seed"]})
        observed = self.env.reset()  # of the loaded arenas
        # and a reset of none of them, which keeps the returns it is given
        observed.set("_reset", torch.zeros_like(returns, dtype=torch.bool))
        self.reset(tensordict=observed.set("episode_reward", returns), set_state=False)
        self._returns = returns
        torch.set_rng_state(random)

    def load_weights(self, packed: bytes) -> None:
        """Act with these parameters from now on."""
        self.policy.load_state_dict(load(packed))


def make_collector(
    create_env: CreateEnv,
    policy: TensorDictModuleBase,
    num_envs: int,
    steps: int,
    run: RunConfig | None = None,
    seed: int = 0,
    first_arena: int = 0,
) -> BaseCollector:
    """A collector of endless rollouts.

    This process uses the policy's parameters in place, workers hold copies (see ``Rollouts``).

    Args:
        create_env: makes a part of the arenas; workers must be able to import it.
        policy: acts on a whole batch of arenas.
        num_envs: arenas in all; the workers share their numbering.
        steps: of every arena per batch.
        run: which collector; default: this process.
        seed: of the actions that workers draw; this process draws from torch's generator.
        first_arena: number of the first arena.

    Raises:
        ValueError: when the arenas cannot be shared evenly, or Ray is not installed.
    """
    run = run or RunConfig()
    require_collector(run, num_envs)
    options: dict[str, Any] = {
        "trust_policy": True,  # planners have no parameters to tell their device by
        "auto_register_policy_transforms": False,
    }
    if run.collector == "process":
        env = create_env(num_envs=num_envs, first_arena=first_arena)
        return ResumableCollector(
            env, policy, frames_per_batch=num_envs * steps, device=env.device, **options
        )
    part = num_envs // run.workers
    workers = [
        partial(_worker_env, create_env, part, first, stream_seed(f"worker of arena {first}", seed))
        for first in range(first_arena, first_arena + num_envs, part)
    ]
    options |= {"frames_per_batch": num_envs * steps, "total_frames": -1, "device": "cpu"}
    options["collector_class"] = ResumableCollector
    if run.collector == "multiasync":
        # without waiting for workers to have the weights: one that died never would
        schemes = {"policy": SharedMemWeightSyncScheme(sync=False)}
        return MultiAsyncCollector(workers, policy, weight_sync_schemes=schemes, **options)
    options |= {"policy_factory": partial(_itself, policy), "weight_sync_schemes": {}}
    return MultiSyncCollector(workers, cat_results=0, use_buffers=True, **options)


def _itself(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    return policy


def require_collector(run: RunConfig, num_envs: int) -> None:
    """Refuse a collector that cannot be made.

    Raises:
        ValueError: when the arenas cannot be shared evenly, or Ray is not installed.
    """
    if num_envs % run.workers:
        raise ValueError(
            f"workers={run.workers} is not allowed: it must divide num_envs={num_envs}"
        )
    if run.collector == "ray" and find_spec("ray") is None:
        raise ValueError("collector='ray' needs the package ray: pip install ray")


def _worker_env(create_env: CreateEnv, num_envs: int, first_arena: int, seed: int) -> EnvBase:
    """Called in a worker: its arenas, and its own random actions."""
    detach()
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    return create_env(num_envs=num_envs, first_arena=first_arena)


class WorkerError(ChildProcessError):
    """Workers died again and again; the arenas of the last whole batch are not lost."""


class Rollouts:
    """Batches [B, T] one after the other, whoever collects them.

    Workers that die are replaced: all of them start again with the arenas and the random
    generators they had before the batch, so that the same batch is collected. Only those of
    "multiasync", who are always under way, start with new arenas.

    Args:
        start: makes the collector, given ``first_arena``.
        policy: whose parameters workers get before every batch.
        run: which collector it is.
        num_envs: arenas in all.
    """

    MAX_RESTARTS = 3

    def __init__(
        self,
        start: Callable[..., BaseCollector],
        policy: TensorDictModuleBase,
        run: RunConfig,
        num_envs: int,
    ) -> None:
        self._start, self._policy = start, policy
        self._kind, self._workers, self._num_envs = run.collector, run.workers, num_envs
        self._collector: BaseCollector | None = None
        self._states: list[Any] | None = None
        self._done = 0

    def next(self) -> TensorDictBase:
        """The next batch.

        Raises:
            WorkerError: when workers died once more after ``MAX_RESTARTS`` restarts.
        """
        if self._kind == "process":
            return self._collect()
        for restarts in range(self.MAX_RESTARTS + 1):
            try:
                return self._collect()
            except _signs_of_death() as error:
                self.close()
                cause = error
                logger.warning("%s; starting all workers again (%d)", error, restarts + 1)
        raise WorkerError(f"workers died {self.MAX_RESTARTS + 1} times in a row") from cause

    def _collect(self) -> TensorDictBase:
        if self._collector is None:
            lost = self._done if self._kind == "multiasync" else 0
            self._collector = self._start(first_arena=lost * self._num_envs)
            if self._states is not None:
                self._collector.map_fn("load_state_dict", [(state,) for state in self._states])
            self._batches = iter(self._collector)
        in_step = self._kind in ("multisync", "ray")
        if in_step:  # not by TorchRL's schemes, which wait for ever for a worker that died
            weights = save(self._policy.state_dict())
            self._collector.map_fn("load_weights", [(weights,)] * self._workers)
        elif self._kind == "multiasync":
            self._collector.update_policy_weights_()
        batch = next(self._batches)
        if in_step:
            self._states = self._collector.map_fn("state_dict")
        self._done += 1
        return batch.flatten(0, 1) if self._kind == "ray" else batch  # Ray stacks its workers'

    def state(self) -> list[ArenaStates]:
        """Per worker what its next batch depends on; empty where that cannot be told."""
        if self._kind == "process" and self._collector is not None:
            self._states = self._collector.map_fn("state_dict")
        return [load(state["packed"]) for state in self._states or ()]

    def load(self, states: list[ArenaStates], done: int) -> None:
        """Go on from a ``state``; to be called before the first batch.

        Args:
            states: of the same number of workers.
            done: batches that were collected before.

        Raises:
            ValueError: for another number of workers.
        """
        if len(states) not in (0, self._workers):
            raise ValueError(
                f"workers={self._workers} is not allowed: the state is of {len(states)}"
            )
        self._states = [{"packed": save(state)} for state in states] or None
        self._done = done

    def close(self) -> None:
        """End the workers."""
        if self._collector is not None:
            with suppress(Exception):  # of workers that are dead already
                self._collector.shutdown()
            self._collector = None


def _signs_of_death() -> tuple[type[BaseException], ...]:
    """What TorchRL raises when it misses a worker: of Ray, or of a pipe."""
    ray = (sys.modules["ray"].exceptions.RayError,) if "ray" in sys.modules else ()
    return (RuntimeError, EOFError, OSError, *ray)
