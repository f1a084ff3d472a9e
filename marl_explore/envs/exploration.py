"""The exploration task as a TorchRL environment that steps a whole batch of arenas at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from marl_explore import arenas as suites
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require, require_coverage, require_integer
from marl_explore.core import mapping, rewards, sensing, world
from marl_explore.core.draws import episode_key
from marl_explore.core.hashing import stream_seed
from marl_explore.core.links import require_radio
from marl_explore.core.survivors import largest_of_living, mean_of_living, some_failed
from marl_explore.core.world import WorldState
from marl_explore.envs.given import checked_action, checked_seed, given_state, loaded_state
from marl_explore.envs.masks import CurrentMask
from marl_explore.envs.memory import require_env_memory
from marl_explore.envs.pictures import RenderMode, Team, picture
from marl_explore.envs.specs import exploration_specs
from marl_explore.envs.state import EpisodeState, LastStep
from marl_explore.envs.workers import in_worker, warn_of_shared_arenas


class ExplorationEnv(EnvBase):
    """Robots that map unknown arenas together; docs/environment.md describes rules and entries.

    Args:
        config: the arena, its robots and their sensors; None: the default of ``arenas``, or the
            paper's.
        num_envs: arenas B stepped at once; the batch size is [B].
        reward: "case1", "case2", "case2-lone-idle", "team", "progress", "union", or a callable that
            takes a ``StepRecord``.
        max_steps: episode length after which an arena is truncated (steps).
        terminate_at_coverage: coverage of the largest map, in (0, 1], that ends an episode; None:
            never.
        arenas: a suite's name, or a callable (seed, arena indices, episodes) -> (obstacles,
            positions).
        seed: together with ``stream``, arena index and episode number, it determines every arena.
        stream: name of an independent family of arenas, such as "train" or "test".
        first_arena: index of the first arena (None: 0); workers with disjoint ranges share one
            numbering (``split_arenas``).
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
        first_arena: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        config = suites.default_config(arenas) if config is None else config
        if not isinstance(config, ArenaConfig):
            raise ValueError(f"config={config!r} is not allowed: it must be an ArenaConfig")
        require_integer("num_envs", num_envs, 1)
        require_integer("max_steps", max_steps, 1)
        if first_arena is not None:
            require_integer("first_arena", first_arena, 0)
        if not isinstance(stream, str):
            raise ValueError(f"stream={stream!r} is not allowed: it must be a string")
        require_coverage("terminate_at_coverage", terminate_at_coverage)
        seed = checked_seed(seed)
        require_radio(config)
        require_env_memory(config, num_envs)
        super().__init__(device=device, batch_size=[num_envs])
        self.config = config
        self.max_steps = max_steps
        self.terminate_at_coverage = terminate_at_coverage
        self.stream = stream
        self.first_arena = first_arena or 0
        self.group_map = {"agents": [f"robot_{i}" for i in range(config.num_agents)]}
        self._reward = rewards.resolve(reward)
        self._generate = suites.resolve(arenas, config)
        self._names = {"reward": _name(reward), "arenas": _name(arenas)}
        self._seed = seed
        self._may_share_arenas = first_arena is None and stream == "train" and in_worker()
        # -1: no arena drawn yet; the first reset draws episode 0
        self._episode = torch.full((num_envs,), -1, dtype=torch.int64, device=self.device)
        self._mask = CurrentMask()
        self._state: EpisodeState | None = None
        self._restored = False
        specs = exploration_specs(config, self.batch_size, self.device, self._mask)
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
            self._seed = checked_seed(seed)
            self._restored = self._may_share_arenas = False
            self._episode = torch.full_like(self._episode, -1)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **_: Any
    ) -> TensorDictBase:
        flagged = None if tensordict is None else tensordict.get("_reset", None)
        if set_state:
            keys = self._keys(self._seed, self._episode)
            given = given_state(self.config, self.full_state_spec, tensordict, keys)
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
        keys = self._keys(self._seed, self._episode)[rows]
        return world.start(self.config, obstacles, position, keys)

    def _keys(self, seed: int, episode: Tensor) -> Tensor:
        """Keys of the random events in episodes int64 [B] of all arenas, int64 [B, 1]."""
        arenas = self.first_arena + torch.arange(len(episode), device=episode.device)
        return episode_key(stream_seed(self.stream, seed), arenas, episode).unsqueeze(-1)

    def _replace_rows(self, rows: Tensor, fresh: EpisodeState) -> None:
        """Write new arenas into the state, without changing tensors that were returned earlier."""
        if self._state is None or len(rows) == self.num_envs:
            self._enter(fresh)
        else:
            self._enter(self._state.replace_rows(rows, fresh))

    def _enter(self, state: EpisodeState | None) -> None:
        self._state = state
        self._mask.value = None if state is None else state.world.action_mask

    # ------------------------------------------------------------------- step

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = checked_action(tensordict, self.config.num_agents)
        if self._may_share_arenas:
            warn_of_shared_arenas()
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
        self._enter(EpisodeState(state, last))
        terminated = self._covered(state, record).unsqueeze(-1)
        if some_failed(state.alive):
            terminated = terminated | ~state.alive.any(-1, keepdim=True)
        truncated = state.step_count >= self.max_steps
        return self._observe(
            reward=mean_of_living(reward, state.alive).unsqueeze(-1),
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
        largest = largest_of_living(targets.unsqueeze(-1) - state.missing, state.alive)
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
                "alive": state.alive,
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
        if config.num_walkers:
            root["walkers"] = state.walkers
        return TensorDict(
            {
                "obstacles": state.obstacles,
                "step_count": state.step_count,
                "draw_key": state.draw_key,
                "agents": agents,
                **root,
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    # ---------------------------------------------------------------- to look at

    def render(self, mode: RenderMode = "ansi", arena: int = 0) -> str | NDArray[np.uint8]:
        """The union of the living robots' maps in one arena, as text or as an image.

        Args:
            mode: "ansi", a line of text per row, or "rgb_array", uint8 [16 H, 16 W, 3].
            arena: which of the B arenas.

        Raises:
            ValueError: for another mode or arena.
            RuntimeError: before the first reset.
        """
        return picture(self.team(arena), mode)

    def team(self, arena: int = 0) -> Team:
        """What a picture shows of one arena.

        Raises:
            ValueError: for another arena.
            RuntimeError: before the first reset.
        """
        state = self._now.world
        require_integer("arena", arena, 0)
        require(arena < self.num_envs, "arena", arena, f"there are {self.num_envs} arenas")
        shown = (state.map, state.position, state.alive, state.walkers)
        return Team(*(entry[arena].cpu() for entry in shown))

    def __repr__(self) -> str:
        config = self.config
        return (
            f"{type(self).__name__}(num_envs={self.num_envs}, robots={config.num_agents}, "
            f"cells={config.height}x{config.width}, reward={self._names['reward']}, "
            f"arenas={self._names['arenas']}, max_steps={self.max_steps}, seed={self._seed}, "
            f"stream={self.stream!r}, first_arena={self.first_arena}, device={self.device})"
        )

    # ------------------------------------------------------------ state, device

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._enter(self._state)  # a copied mask is empty

    def state_dict(self, *_: Any, **__: Any) -> dict[str, Any]:
        """Everything that the future of the environment depends on, as tensors and integers."""
        state: dict[str, Any] = {"seed": self._seed, "episode": self._episode}
        return state if self._state is None else state | self._state.tensors()

    def load_state_dict(self, state_dict: dict[str, Any], *_: Any, **__: Any) -> None:
        """Restore a ``state_dict``: the next full reset returns its observation.

        Raises:
            ValueError: when the entries are not those of this environment.
        """
        state = loaded_state(self.config, self.full_state_spec, state_dict, self._keys)
        self._seed = state_dict["seed"]
        self._episode = state_dict["episode"].to(self.device)
        self._enter(state and state.apply(lambda x: x.to(self.device)))
        self._restored = state is not None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> ExplorationEnv:
        """Move the state when the environment moves to another device."""
        self._episode = fn(self._episode)
        if self._state is not None:
            self._enter(self._state.apply(fn))
        return super()._apply(fn, recurse)


def _name(value: Any) -> str:
    """How ``repr`` shows a reward or a generator."""
    if isinstance(value, str):
        return repr(value)
    return getattr(value, "__name__", type(value).__name__)
