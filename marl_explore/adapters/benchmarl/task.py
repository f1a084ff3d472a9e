"""The exploration environment as a BenchMARL task."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from benchmarl.environments.common import TaskClass
from torchrl.data import Composite
from torchrl.envs import CatTensors, EnvBase, FlattenObservation, Transform

from marl_explore.config.arena import ArenaConfig
from marl_explore.envs.factory import make_env

FEATURES = ("agents", "features")


class ExplorationTask(TaskClass):
    """The exploration environment as a BenchMARL task.

    Robots observe ("agents", "features"), float32 [B, N, (2k+1)^2 + 24 + N] (FOV, FPR and NET
    concatenated), and ("agents", "action_mask"). There is no state: critics read all robots'
    features.

    Args:
        config: arguments of ``make_env`` except seed, num_envs and device; "config" may also be a
            mapping of ``ArenaConfig``'s fields. "max_steps" is 200 if not given.

    Raises:
        ValueError: naming argument, value and what is allowed, for arguments out of range.
    """

    def __init__(self, config: Mapping[str, Any] | None = None) -> None:
        options = {"max_steps": 200, **(config or {})}
        if isinstance(options.get("config"), Mapping):
            options["config"] = ArenaConfig(**options["config"])
        super().__init__("exploration", options)
        self.get_env_fun(
            1, continuous_actions=False, seed=0, device="cpu"
        )()  # raises an error for wrong arguments

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """A function that makes the environment with ``num_envs`` arenas."""
        return lambda: make_env(
            num_envs=num_envs, seed=0 if seed is None else seed, device=device, **self.config
        )

    def get_env_transforms(self, env: EnvBase) -> list[Transform]:
        """The transforms that concatenate a robot's features."""
        fov, fpr, net = (("agents", "observation", key) for key in ("fov", "fpr", "net"))
        flat = [("agents", "flat", key) for key in ("fov", "fpr")]
        return [
            FlattenObservation(-2, -1, in_keys=[fov, fpr], out_keys=flat),
            CatTensors([*flat, net], FEATURES, del_keys=False, sort=False),
        ]

    def supports_continuous_actions(self) -> bool:
        """No: the ten actions are discrete."""
        return False

    def supports_discrete_actions(self) -> bool:
        """Yes."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """No; ``marl_explore.replay`` shows episodes."""
        return False

    def max_steps(self, env: EnvBase) -> int:
        """Length of an episode in steps."""
        return self.config["max_steps"]

    def group_map(self, env: EnvBase) -> dict[str, list[str]]:
        """One group, "agents"."""
        return env.group_map

    def observation_spec(self, env: EnvBase) -> Composite:
        """Spec of the features."""
        return _only(env.full_observation_spec, FEATURES)

    def action_mask_spec(self, env: EnvBase) -> Composite:
        """Spec of the action masks."""
        return _only(env.full_observation_spec, ("agents", "action_mask"))

    def action_spec(self, env: EnvBase) -> Composite:
        """Spec of the actions."""
        return env.full_action_spec_unbatched

    def state_spec(self, env: EnvBase) -> None:
        """None."""

    def info_spec(self, env: EnvBase) -> None:
        """None."""

    @staticmethod
    def env_name() -> str:
        """The name of the environment."""
        return "marl_explore"


def _only(spec: Composite, key: tuple[str, str]) -> Composite:
    group, entry = key
    one = spec[key][0]  # of one arena
    return Composite({group: Composite({entry: one}, shape=one.shape[:1])})
