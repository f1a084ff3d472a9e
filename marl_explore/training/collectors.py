"""TorchRL collectors from settings: in this process, in worker processes, or on Ray."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import torch
from safetensors.torch import load, save
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase
from torchrl.weight_update import SharedMemWeightSyncScheme

from marl_explore.config.run import RunConfig
from marl_explore.core.hashing import stream_seed
from marl_explore.envs.workers import CreateEnv, require_even_shares, split_arenas
from marl_explore.policies.actors import TeamActor
from marl_explore.training.clusters import connect, require_cluster
from marl_explore.training.workers import AsyncWorkers, SyncWorkers, report
from marl_explore.transforms.memory import MEMORY
from marl_explore.utils.interrupts import detach, end_with_parent

_REMEMBERED = "memory."
"""Prefix of the entries of robots' memory in a collector's state."""
_TRAJECTORY_IDS = ("collector", "traj_ids")
"""Entry by which TorchRL counts the steps that workers send."""


class ResumableCollector(Collector):
    """A collector that resumes exactly: its state holds what TorchRL's leaves out.

    ``state_dict`` has the arenas in progress, the returns so far, and the state of the random
    generator that actions are drawn from; ``load_state_dict`` restores all of them.

    Args:
        args, options: of ``Collector``.
        keep: entries of a batch that are returned, beside TorchRL's trajectory ids if they are
            tracked; None: all of them. Workers send no others.
        reports: pipe through which a worker reports the error that ends it.
    """

    _returns: Tensor | None = None
    _memory: TensorDictBase | None = None
    _buffers: TensorDictBase | None = None
    _kept: TensorDictBase | None = None

    def __init__(
        self,
        *args: Any,
        keep: Sequence[NestedKey] | None = None,
        reports: Connection | None = None,
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        self._keep, self._reports = keep, reports

    @property
    def _generator(self) -> torch.Generator | None:
        """That of the device, if actions are not drawn from the CPU's."""
        device = self.env.device
        if device.type != "cuda":
            return None
        number = torch.cuda.current_device() if device.index is None else device.index
        return torch.cuda.default_generators[number]

    def rollout(self) -> TensorDictBase:
        """The next batch [B, T]; the actors of a team run as one network."""
        team = isinstance(self.policy, TeamActor)
        try:
            with self.policy.stacked.together() if team else nullcontext():
                batch = super().rollout()
        except Exception as error:
            report(error, self._reports)
            raise
        last = batch["next"][:, -1]
        self._returns = last["episode_reward"].masked_fill(last["done"], 0.0)
        self._memory = last.get(MEMORY, None)
        if self._keep is None:
            return batch
        # TorchRL writes into the same buffers, and its workers must return the same TensorDict
        if self._buffers is not batch or self._kept is None:
            counted = [_TRAJECTORY_IDS] if self.track_traj_ids else []
            self._buffers, self._kept = batch, batch.select(*self._keep, *counted)
        return self._kept

    def state_dict(self) -> dict[str, bytes]:
        """Everything that the rest of the run depends on except the policy, in one entry.

        It is one entry because each tensor sent between processes takes a file descriptor.
        """
        state: dict[str, Any] = self.env.base_env.state_dict()
        returns = self._returns
        if returns is None:
            returns = self.env.full_reward_spec.zero()["reward"]
        tensors = {name: value.clone() for name, value in state.items() if name != "seed"}
        tensors |= {"returns": returns, "random": torch.get_rng_state()}
        if self._generator is not None:
            tensors["device_random"] = self._generator.get_state()
        if self._memory is not None:
            tensors |= {_REMEMBERED + name: x.clone() for name, x in self._memory.items()}
        return {"packed": save(tensors)}

    def load_state_dict(self, state_dict: dict[str, bytes], **_: Any) -> None:
        """Resume from a ``state_dict`` of a collector of the same arenas."""
        tensors = load(state_dict["packed"])
        random, returns = tensors.pop("random"), tensors.pop("returns").to(self.env.device)
        device_random = tensors.pop("device_random", None)
        remembered = {
            name.removeprefix(_REMEMBERED): tensors.pop(name)
            for name in [*tensors]
            if name.startswith(_REMEMBERED)
        }
        env = self.env.base_env
        env.load_state_dict({**tensors, "seed": env.state_dict()["seed"]})
        given = TensorDict({}, batch_size=env.batch_size)
        if remembered:
            shape = remembered["heading"].shape
            self._memory = TensorDict(remembered, batch_size=shape, device=self.env.device)
            given.set(MEMORY, self._memory)
        observed = self.env.reset(given)  # of the loaded arenas
        # then a reset of no arena, which keeps the returns that it is given
        observed.set("_reset", torch.zeros_like(returns, dtype=torch.bool))
        self.reset(tensordict=observed.set("episode_reward", returns), set_state=False)
        self._returns = returns
        torch.set_rng_state(random)
        if self._generator is not None and device_random is not None:
            self._generator.set_state(device_random)

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
    keep: Sequence[NestedKey] | None = None,
) -> BaseCollector:
    """A collector of endless rollouts.

    This process uses the policy's parameters in place; workers hold copies, which
    ``restarts.RestartingCollector`` keeps up to date.

    Args:
        create_env: makes a part of the arenas, with "episode_reward"; workers must be able to
            import it.
        policy: acts on a whole batch of arenas.
        num_envs: total number of arenas; the workers share their numbering.
        steps: of every arena per batch.
        run: which collector; default: this process.
        seed: of the actions that workers sample; this process samples from torch's generator.
        first_arena: index of the first arena.
        keep: entries of a batch that are returned; None: all of them. Those of workers also have
            TorchRL's trajectory ids.

    Raises:
        ValueError: when the arenas cannot be shared evenly, or Ray is not installed.
        WorkerError, WorkerDeathError: when a worker fails while starting.
    """
    run = run or RunConfig()
    require_collector(run, num_envs)
    options: dict[str, Any] = {
        "trust_policy": True,  # planners have no parameters that show their device
        "auto_register_policy_transforms": False,
    }
    if run.collector == "process":
        env = create_env(num_envs=num_envs, first_arena=first_arena)
        options |= {"device": env.device, "track_traj_ids": False}
        return ResumableCollector(
            env, policy, frames_per_batch=num_envs * steps, keep=keep, **options
        )
    parts = split_arenas(create_env, run.workers, num_envs, first_arena)
    firsts = range(first_arena, first_arena + num_envs, num_envs // run.workers)
    workers = [
        partial(_worker_env, part, stream_seed(f"worker of arena {first}", seed))
        for part, first in zip(parts, firsts, strict=True)
    ]
    options |= {"frames_per_batch": num_envs * steps, "total_frames": -1, "device": "cpu"}
    start = _ray_collector if run.collector == "ray" else _worker_processes
    return start(workers, policy, run, keep, options)


def _worker_processes(
    workers: Sequence[Callable[[], EnvBase]],
    policy: TensorDictModuleBase,
    run: RunConfig,
    keep: Sequence[NestedKey] | None,
    options: dict[str, Any],
) -> BaseCollector:
    """Worker processes on this machine."""
    reader, writer = Pipe(duplex=False)
    options["collector_class"] = partial(ResumableCollector, keep=keep, reports=writer)
    collector: AsyncWorkers | SyncWorkers
    if run.collector == "multiasync":
        # does not wait until workers have the weights: a dead one never confirms
        scheme = SharedMemWeightSyncScheme(sync=False)
        try:
            collector = AsyncWorkers(
                workers, policy, weight_sync_schemes={"policy": scheme}, **options
            )
        except Exception:
            scheme.shutdown()  # otherwise it blocks forever when the program exits
            raise
    else:
        options |= {"policy_factory": partial(_itself, policy), "weight_sync_schemes": {}}
        collector = SyncWorkers(workers, cat_results=0, use_buffers=True, **options)
    collector.reports = reader
    return collector


def _ray_collector(
    workers: Sequence[Callable[[], EnvBase]],
    policy: TensorDictModuleBase,
    run: RunConfig,
    keep: Sequence[NestedKey] | None,
    options: dict[str, Any],
) -> BaseCollector:
    """Actors of a Ray cluster, one CPU each; the cluster outlives the collector."""
    from torchrl.collectors.distributed import RayCollector

    connect(run)
    own = ("trust_policy", "auto_register_policy_transforms")
    # it does not see the weights that restarts.RestartingCollector sends
    warnings.filterwarnings("ignore", "RayCollector iteration started before weight sync")
    return RayCollector(
        workers,
        policy,
        sync=True,
        postproc=lambda stacked: stacked.flatten(0, 1),  # [workers, arenas per worker, T]
        weight_sync_schemes={},
        collector_kwargs={"keep": keep, **{name: options.pop(name) for name in own}},
        remote_configs={"num_cpus": 1, "num_gpus": 0},
        collector_class=ResumableCollector,
        **options | {"total_frames": sys.maxsize},
    )


def _itself(policy: TensorDictModuleBase) -> TensorDictModuleBase:
    return policy


def require_collector(run: RunConfig, num_envs: int) -> None:
    """Raise an error for a collector that cannot be made.

    Raises:
        ValueError: when the arenas cannot be shared evenly, Ray is not installed, or nothing
            answers at its cluster's address.
    """
    require_even_shares(run.workers, num_envs)
    if run.collector == "ray":
        require_cluster(run)


def _worker_env(create_part: Callable[[], EnvBase], seed: int) -> EnvBase:
    """Called in a worker: its arenas; seeds its own random actions."""
    detach()
    end_with_parent()
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    return create_part()
