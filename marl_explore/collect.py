"""From an environment and a policy to a TorchRL collector."""

from __future__ import annotations

from collections.abc import Callable

from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase


def make_collector(
    create_env: Callable[[], EnvBase],
    policy: TensorDictModuleBase,
    frames_per_batch: int,
    total_frames: int,
) -> Collector:
    """A collector of rollouts [B, T] in this process.

    Args:
        create_env: makes the batched environment.
        policy: acts on the whole batch; its parameters are used in place, so that an update needs
            no copy.
        frames_per_batch: arenas times steps of one batch.
        total_frames: arenas times steps in all.
    """
    env = create_env()
    return Collector(
        env,
        policy,
        frames_per_batch=frames_per_batch,
        total_frames=total_frames,
        device=env.device,
        trust_policy=True,  # planners have no parameters to tell their device by
        auto_register_policy_transforms=False,
    )
