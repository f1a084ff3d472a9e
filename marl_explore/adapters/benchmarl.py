"""The exploration task, and HAPPO, for BenchMARL: a task that plugs in from here, an algorithm.

BenchMARL 1.5.2 asks for an older TorchRL: install it with ``pip install --no-deps benchmarl``. Two
lines below give it back what changed: a class's name, and that a check of shapes is optional. So
this module must be imported before ``benchmarl``.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import torch
import torchrl.collectors
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.data import Composite
from torchrl.envs import CatTensors, EnvBase, FlattenObservation, Transform
from torchrl.modules import QValueModule
from torchrl.objectives import LossModule

from marl_explore.config import ArenaConfig
from marl_explore.happo import HAPPOLoss
from marl_explore.make import make_env

torchrl.collectors.SyncDataCollector = torchrl.collectors.Collector  # its name until TorchRL 0.11

from benchmarl.algorithms import Mappo, MappoConfig, iql, qmix, vdn  # noqa: E402
from benchmarl.environments.common import TaskClass  # noqa: E402

# they hand it a spec without its group, which its new check takes for another shape
iql.QValueModule = vdn.QValueModule = qmix.QValueModule = partial(QValueModule, strict_shape=False)

FEATURES = ("agents", "features")


class ExplorationTask(TaskClass):
    """The exploration environment as a BenchMARL task.

    Robots observe ("agents", "features"), float32 [B, N, (2k+1)^2 + 24 + N] (FOV, FPR and NET in a
    row), and ("agents", "action_mask"). There is no state: critics read all robots' features.

    Args:
        config: arguments of ``make_env`` beside seed, num_envs and device; "config" may also be a
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
        )()  # refuses what is wrong

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """What makes the environment of ``num_envs`` arenas."""
        return lambda: make_env(
            num_envs=num_envs, seed=0 if seed is None else seed, device=device, **self.config
        )

    def get_env_transforms(self, env: EnvBase) -> list[Transform]:
        """What puts the features of a robot in a row."""
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
        """Steps of an episode."""
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


class Team(TensorDictModuleBase):
    """The actors of a group, each with parameters of its own, as the group's policy.

    Args:
        group: name of the group, entries [*B, n, ...].
        actors: a probabilistic actor per agent, of a group of its own, entries [*B, 1, ...].
    """

    def __init__(self, group: str, actors: Mapping[str, TensorDictModuleBase]) -> None:
        super().__init__()
        self.group = group
        self.actors = nn.ModuleDict(actors)
        first = next(iter(actors.values()))
        self.in_keys = [(group, *key[1:]) for key in first.in_keys]
        self.out_keys = [(group, "action"), (group, "log_prob")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the group's actions and their log-probabilities."""
        apart = self.split(tensordict, self.in_keys)
        for actor in self.actors.values():
            actor(apart)
        for *_, entry in self.out_keys:
            together = torch.cat([apart[name, entry] for name in self.actors], tensordict.ndim)
            tensordict.set((self.group, entry), together)
        return tensordict

    def split(self, tensordict: TensorDictBase, keys: Iterable[Any]) -> TensorDict:
        """Entries of the group, [*B, n, ...], as those of its agents' groups, [*B, 1, ...] each."""
        parts: dict[str, dict[str, torch.Tensor]] = {name: {} for name in self.actors}
        for key in keys:
            slices = tensordict.get(key).split(1, tensordict.ndim)
            for name, part in zip(parts, slices, strict=True):
                parts[name][key[1:] if len(key) > 2 else key[1]] = part
        return TensorDict(parts, batch_size=tensordict.batch_size, device=tensordict.device)


class CriticLast(HAPPOLoss):
    """HAPPO's losses, of which BenchMARL's own loop sees the critic's: the actors are done then."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The critic's loss."""
        return self.critic_loss(tensordict).select("loss_critic")


class Happo(Mappo):
    """HAPPO for any BenchMARL task: one actor per agent, updated one after the other.

    ``process_batch`` estimates advantages and updates the actors, with the experiment's learning
    rate, epochs, minibatches and gradient clipping; BenchMARL's loop then trains the critic, which
    is shared. The agents of a group get the mean of their rewards. The factor lives within a group.

    Raises:
        ValueError: for critics that share no parameters.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if not self.share_param_critic:
            raise ValueError("share_param_critic=False is not allowed: HAPPO has one critic")
        self._optimizers: dict[str, torch.optim.Optimizer] = {}

    def _get_policy_for_loss(self, group: str, model_config: Any, continuous: bool) -> Team:
        actors = {}
        for i, agent in enumerate(self.group_map[group]):
            name = f"{group}_{i}"
            alone = copy.copy(self)
            alone.group_map = {name: [agent]}
            for kind in ("observation_spec", "action_spec", "action_mask_spec"):
                spec = getattr(self, kind)
                if spec is not None:
                    setattr(alone, kind, Composite({name: spec[group][i : i + 1]}))
            actors[name] = Mappo._get_policy_for_loss(alone, name, model_config, continuous)
        return Team(group, actors)

    def _get_loss(
        self, group: str, policy_for_loss: Team, continuous: bool
    ) -> tuple[LossModule, bool]:
        critic: TensorDictModule = self.get_critic(group)[0]  # the value is the team's
        loss = CriticLast(
            dict(policy_for_loss.actors.items()),
            critic,
            clip_epsilon=self.clip_epsilon,
            entropy_coeff=self.entropy_coef,
        )
        for name in loss.names:
            stock: Any = loss.actor_losses[name]
            stock.set_keys(action=(name, "action"), sample_log_prob=(name, "log_prob"))
        loss.make_value_estimator(gamma=self.experiment_config.gamma, lmbda=self.lmbda)
        return loss, False

    def _get_parameters(self, group: str, loss: Any) -> dict[str, list[nn.Parameter]]:
        return {"loss_critic": list(loss.critic.parameters())}

    def process_batch(self, group: str, batch: TensorDictBase) -> TensorDictBase:
        """Estimate advantages, and update the group's actors one after the other."""
        self._share_reward(group, batch)
        loss, _ = self.get_loss_and_updater(group)
        team = self.get_policy_for_loss(group)
        loss.estimate_advantage(batch)
        flat = batch.reshape(-1)
        data = team.split(flat, [*team.in_keys, *team.out_keys])
        data.set("advantage", flat.get("advantage"))
        for name in loss.update_order():
            self._update(loss, name, data)
            loss.update_factor(data, name)
        return batch

    def process_loss_vals(self, group: str, loss_vals: TensorDictBase) -> TensorDictBase:
        """Nothing: the only loss left is the critic's."""
        return loss_vals

    def _share_reward(self, group: str, batch: TensorDictBase) -> None:
        """What the agents of a group get together, and when: entries without an agent axis."""
        after = batch.get("next")
        for key in ("reward", "done", "terminated"):
            own = after.get((group, key), None)
            if own is not None:
                shared = own.mean(-2) if key == "reward" else own.any(-2)
                after.set(key, shared)

    def _update(self, loss: HAPPOLoss, name: str, data: TensorDictBase) -> None:
        config = self.experiment_config
        parameters = list(loss.actor_losses[name].parameters())
        if name not in self._optimizers:
            self._optimizers[name] = torch.optim.Adam(parameters, config.lr, eps=config.adam_eps)
        optimizer = self._optimizers[name]
        for _ in range(config.n_optimizer_steps(self.on_policy)):
            for rows in torch.randperm(len(data)).split(
                config.train_minibatch_size(self.on_policy)
            ):
                losses = loss.actor_loss(data[rows], name)
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_entropy"]).backward()
                if config.clip_grad_norm and config.clip_grad_val is not None:
                    nn.utils.clip_grad_norm_(parameters, config.clip_grad_val)
                optimizer.step()


@dataclass
class HappoConfig(MappoConfig):
    """Settings of HAPPO: those of MAPPO, whose values are the defaults."""

    @staticmethod
    def associated_class() -> type[Happo]:
        """The algorithm."""
        return Happo

    @classmethod
    def get_from_yaml(cls, path: str | None = None) -> HappoConfig:
        """BenchMARL's settings of MAPPO, or those of a file."""
        theirs = MappoConfig.get_from_yaml(path)
        return cls(**{field.name: getattr(theirs, field.name) for field in fields(theirs)})
