"""The exploration task as a TorchRL environment that steps a whole batch of arenas at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from marl_explore import arenas as suites
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require_coverage, require_integer
from marl_explore.core import mapping, motion, rewards, sensing, world
from marl_explore.core.hashing import stream_seed
from marl_explore.core.links import links
from marl_explore.core.world import WorldState
from marl_explore.envs.memory import require_env_memory
from marl_explore.envs.specs import exploration_specs
from marl_explore.envs.state import EpisodeState, LastStep

_WORLD_KEYS: dict[NestedKey, str] = {
    "obstacles": "obstacles",
    ("agents", "map"): "map",
    ("agents", "position"): "position",
    ("agents", "unshared"): "unshared",
    ("agents", "steps_since_merge"): "steps_since_merge",
    "step_count": "step_count",
}
_START_KEYS: tuple[NestedKey, NestedKey] = ("obstacles", ("agents", "position"))


class ExplorationEnv(EnvBase):
    """Robots that map unknown arenas together; docs/environment.md describes rules and entries.

    Args:
        config: the arena, its robots and their sensors; None: the default of ``arenas``, or the
            paper's.
        num_envs: arenas B stepped at once; the batch size is [B].
        reward: "case1", "case2", "case2-literal", "team", "progress", or a callable that takes a
            ``StepRecord``.
        max_steps: episode length after which an arena is truncated (steps).
        terminate_at_coverage: coverage of the largest map, in (0, 1], that ends an episode; None:
            never.
        arenas: a suite's name, or a callable (seed, arena indices, episodes) -> (obstacles,
            positions).
        seed: together with ``stream``, arena index and episode number, it determines every arena.
        stream: name of an independent family of arenas, such as "train" or "test".
        first_arena: index of the first arena; workers with disjoint ranges share one numbering.
        device: of all tensors.

    Raises:
        ValueError: naming argument, value and what is allowed, for arguments out of range.
    """

    _supports_set_state = True

    def __init__(
        self,
        config: ArenaConfig | None = None,
        num_envs: int = 1,
        reward: str | rewards.Reward = "case2",
        max_steps: int = 200,
        terminate_at_coverage: float | None = None,
        arenas: str | suites.Generator = "uniform",
        seed: int = 0,
        stream: str = "train",
        first_arena: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        config = config or suites.default_config(arenas)
        require_integer("num_envs", num_envs, 1)
        require_integer("max_steps", max_steps, 1)
        require_integer("first_arena", first_arena, 0)
        require_integer("seed", seed, 0)
        if not isinstance(stream, str):
            raise ValueError(f"stream={stream!r} is not allowed: it must be a string")
        require_coverage("terminate_at_coverage", terminate_at_coverage)
        require_env_memory(config, num_envs)
        super().__init__(device=device, batch_size=[num_envs])
        self.config = config
        self.max_steps = max_steps
        self.terminate_at_coverage = terminate_at_coverage
        self.stream = stream
        self.first_arena = first_arena
        self.group_map = {"agents": [f"robot_{i}" for i in range(config.num_agents)]}
        self._reward = rewards.resolve(reward)
        self._generate = suites.resolve(arenas, config)
        self._seed = seed
        # -1: no arena drawn yet; the first reset draws episode 0
        self._episode = torch.full((num_envs,), -1, dtype=torch.int64, device=self.device)
        self._state: EpisodeState | None = None
        self._restored = False
        specs = exploration_specs(config, self.batch_size, self.device)
        self.full_state_spec, self.full_observation_spec, *others = specs
        self.full_action_spec, self.full_reward_spec, self.full_done_spec = others

    @property
    def num_envs(self) -> int:
        """Number of arenas B."""
        return self.batch_size[0]

    @property
    def _now(self) -> EpisodeState:
        if self._state is None:
            raise RuntimeError("ExplorationEnv has no arenas yet: call reset() first")
        return self._state

    # ------------------------------------------------------------------ reset

    def _set_seed(self, seed: int | None) -> None:
        """Restart the numbering of episodes with another seed."""
        if seed is not None:
            self._restored = False
            self._seed = seed
            self._episode = torch.full_like(self._episode, -1)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: Any
    ) -> TensorDictBase:
        flagged = None if tensordict is None else tensordict.get("_reset", None)
        if set_state:
            given = self._given_state(tensordict)
            rows = self._rows(flagged)
            self._replace_rows(rows, given.apply(lambda entry: entry[rows]))
        elif not self._restored or flagged is not None:
            rows = self._rows(flagged)
            if len(rows):
                self._replace_rows(rows, EpisodeState.at_rest(self._draw(rows), first=True))
        self._restored = False  # else: continue from the loaded state
        never = torch.zeros_like(self._now.world.step_count, dtype=torch.bool)
        return self._observe(done=never, terminated=never.clone(), truncated=never.clone())

    def _rows(self, flagged: Tensor | None) -> Tensor:
        """Indices of the arenas to reset, int64 [A]."""
        if flagged is None or self._state is None:
            return torch.arange(self.num_envs, device=self.device)
        return flagged.flatten().nonzero().squeeze(-1)

    def _draw(self, rows: Tensor) -> WorldState:
        """The arenas of the next episode for some rows."""
        self._episode = self._episode.index_add(0, rows, torch.ones_like(rows))
        seed = stream_seed(self.stream, self._seed)
        obstacles, position = self._generate(seed, self.first_arena + rows, self._episode[rows])
        return world.start(self.config, obstacles, position)

    def _given_state(self, tensordict: TensorDictBase | None) -> EpisodeState:
        """The state in a TensorDict: given starts, or all of an episode in progress."""
        entries = {} if tensordict is None else self._state_entries(tensordict)
        missing = [key for key in _WORLD_KEYS if key not in entries]
        if any(key in missing for key in _START_KEYS) or (
            missing and len(entries) > len(_START_KEYS)
        ):
            raise ValueError(
                f"reset(set_state=True) needs {_START_KEYS} to start an episode, or all of "
                f"{tuple(_WORLD_KEYS)} to continue one; missing: {missing}"
            )
        self._check_entries(entries)
        obstacles, position = (entries[key] for key in _START_KEYS)
        world.check_starts(obstacles, position)
        if missing:
            started = world.start(self.config, obstacles, position)
            return EpisodeState.at_rest(started, first=True)
        world.check_maps(obstacles, position, entries["agents", "map"])
        given = {name: entries[key].clone() for key, name in _WORLD_KEYS.items()}
        resumed = world.resume(self.config, given.pop("obstacles"), given.pop("position"), **given)
        return EpisodeState.at_rest(resumed, first=False)

    @staticmethod
    def _state_entries(tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        found = {key: tensordict.get(key, None) for key in _WORLD_KEYS}
        return {key: value for key, value in found.items() if value is not None}

    def _check_entries(self, entries: Mapping[NestedKey, Tensor]) -> None:
        """Check that given entries have their spec's dtype and shape."""
        for key, value in entries.items():
            _require_like("reset(set_state=True)", key, value, self.full_state_spec[key])

    def _replace_rows(self, rows: Tensor, fresh: EpisodeState) -> None:
        """Write new arenas into the state, without changing tensors that were returned earlier."""
        if self._state is None or len(rows) == self.num_envs:
            self._state = fresh
        else:
            self._state = self._state.replace_rows(rows, fresh)

    # ------------------------------------------------------------------- step

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get(("agents", "action"))
        self._restored = False
        state, record = world.advance(self.config, self._now.world, action)
        reward = rewards.checked(self._reward(record), record)
        last = LastStep(
            dangerous=record.dangerous,
            merged=record.merged,
            discovered=record.discovered,
            received=record.received,
            individual_reward=reward.unsqueeze(-1),
        )
        self._state = EpisodeState(state, last)
        terminated = self._covered(state, record).unsqueeze(-1)
        truncated = state.step_count >= self.max_steps
        return self._observe(
            reward=reward.mean(-1, keepdim=True),
            done=terminated | truncated,
            terminated=terminated,
            truncated=truncated,
        )

    def _covered(self, state: WorldState, record: rewards.StepRecord) -> Tensor:
        """Arenas whose largest map has the coverage that ends an episode, bool [B]."""
        if self.terminate_at_coverage is None:
            return torch.zeros(self.batch_size, dtype=torch.bool, device=self.device)
        if self.terminate_at_coverage == 1:
            return record.complete
        targets = world.num_targets(state.target)
        largest = targets - state.missing.amin(-1)
        return largest >= mapping.cells_of_share(self.terminate_at_coverage, targets)

    def _observe(self, **root: Tensor) -> TensorDict:
        """All observation entries, with further root entries, in one nested TensorDict."""
        (state, last), config = self._now, self.config
        fov = sensing.field_of_view(state.view)
        group = (*self.batch_size, config.num_agents)
        agents = TensorDict(
            {
                "map": state.map,
                "position": state.position,
                "unshared": state.unshared,
                "steps_since_merge": state.steps_since_merge,
                "linked": state.linked,
                "action_mask": state.action_mask,
                "observation": TensorDict({"fov": fov}, batch_size=group, device=self.device),
                **last._asdict(),
            },
            batch_size=group,
            device=self.device,
        )
        return TensorDict(
            {
                "obstacles": state.obstacles,
                "step_count": state.step_count,
                "agents": agents,
                **root,
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Uniform random allowed actions (of the current state, without an input)."""
        if tensordict is None:
            if self._state is None:
                return super().rand_action(None)
            mask = self._now.world.action_mask
            tensordict = TensorDict({}, batch_size=self.batch_size, device=self.device)
        else:
            mask = tensordict.get(("agents", "action_mask"))
        return tensordict.set(("agents", "action"), motion.random_allowed(mask))

    # ------------------------------------------------------------ state, device

    def state_dict(self, *_: Any, **__: Any) -> dict[str, Any]:
        """Everything that the future of the environment depends on, as tensors and integers."""
        state: dict[str, Any] = {"seed": self._seed, "episode": self._episode}
        return state if self._state is None else state | self._state.tensors()

    def load_state_dict(self, state_dict: dict[str, Any], *_: Any, **__: Any) -> None:
        """Restore a ``state_dict``: the next full reset returns its observation.

        Raises:
            ValueError: when the entries are not those of this environment.
        """
        started = len(state_dict) > 2
        if started and "linked" not in state_dict:  # version 0.1 had no such entry
            linked = links(self.config, state_dict["position"], state_dict["obstacles"])
            state_dict = {**state_dict, "linked": linked}
        names = {"seed", "episode", *(EpisodeState.names() if started else ())}
        if set(state_dict) != names:
            raise ValueError(
                f"state_dict holds {sorted(state_dict)}, expected {sorted(names)} "
                "(made by ExplorationEnv.state_dict)"
            )
        if state_dict["episode"].shape != self._episode.shape:
            raise ValueError(
                f"state_dict is of {len(state_dict['episode'])} arenas, "
                f"this environment has {self.num_envs}"
            )
        state = None
        if started:
            # derived tensors must match those of this configuration
            for name, like in self._blank().tensors().items():
                _require_like("state_dict", name, state_dict[name], like)
            state = EpisodeState.from_tensors(state_dict).apply(lambda x: x.to(self.device))
        self._seed = state_dict["seed"]
        self._episode = state_dict["episode"].to(self.device)
        self._state, self._restored = state, started

    def _blank(self) -> EpisodeState:
        """A state with empty arenas, for its dtypes and shapes."""
        entries = self.full_state_spec.zero()
        blank = world.start(self.config, entries["obstacles"], entries["agents", "position"])
        return EpisodeState.at_rest(blank, first=True)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ExplorationEnv:
        """Move the state when the environment moves to another device."""
        self._episode = fn(self._episode)
        if self._state is not None:
            self._state = self._state.apply(fn)
        return super()._apply(fn, recurse)


def _require_like(where: str, key: NestedKey, value: Tensor, like: Tensor | TensorSpec) -> None:
    if value.dtype != like.dtype or value.shape != like.shape:
        raise ValueError(
            f"{where}: {key!r} must be {like.dtype} of shape {tuple(like.shape)}, "
            f"got {value.dtype} of shape {tuple(value.shape)}"
        )
