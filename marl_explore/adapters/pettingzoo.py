"""The exploration task as a PettingZoo parallel environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from marl_explore.adapters.window import Window
from marl_explore.arenas import Generator
from marl_explore.config.arena import ArenaConfig
from marl_explore.core.frontier import Normalization
from marl_explore.core.grid import NUM_ACTIONS, STAY
from marl_explore.core.rewards import Reward
from marl_explore.envs.factory import make_env
from marl_explore.envs.given import as_integer, checked_seed
from marl_explore.policies.networks import OBSERVATION_KEYS
from marl_explore.policies.networks.inputs import concat_observation

RenderMode = Literal["human", "rgb_array", "ansi"]
_RENDER_MODES: tuple[RenderMode, ...] = get_args(RenderMode)
Observation = dict[str, NDArray[Any]]
_NAME, _FPS = "marl_explore_v0", 8
_START = ("obstacles", "positions")
_UNUSED = "options"
"""A key without a meaning, which PettingZoo's own tests give."""


def parallel_env(
    config: ArenaConfig | None = None,
    reward: str | Reward = "case2",
    max_steps: int = 200,
    render_mode: RenderMode | None = None,
    *,
    terminate_at_coverage: float | None = None,
    arenas: str | Generator = "uniform",
    seed: int = 0,
    stream: str = "train",
    first_arena: int | None = None,
    fpr: Normalization | None = "relative",
    shared_reward: bool = True,
) -> ParallelExploration:
    """One arena of the exploration task as a PettingZoo environment; see ``ParallelExploration``.

    Args:
        render_mode: "human" shows every step in a window, or as text where there is no display;
            ``render`` returns an image for "rgb_array" and text for "ansi".
        config, reward, max_steps, terminate_at_coverage, arenas, seed, stream, first_arena, fpr:
            as for ``make_env``.
        shared_reward: whether each robot gets the team's reward; False: its own.

    Raises:
        ValueError: naming argument, value and what is allowed.
    """
    return ParallelExploration(
        config,
        reward,
        max_steps,
        render_mode,
        terminate_at_coverage=terminate_at_coverage,
        arenas=arenas,
        seed=seed,
        stream=stream,
        first_arena=first_arena,
        fpr=fpr,
        shared_reward=shared_reward,
    )


class ParallelExploration(ParallelEnv[str, Observation, int]):
    """Robots "robot_0", "robot_1", ... that map an unknown arena together.

    It is the first arena of ``make_env`` with the same arguments: the same seed and actions give
    the same episode. A robot observes a dictionary of "observation", float32 [(2k+1)^2 + 24 + N]
    (FOV, FPR and NET concatenated), and "action_mask", int8 [10], which is also in the info. All
    robots get the team's reward, the mean of their own, unless ``shared_reward`` is False. A robot
    that fails is terminated in that step and leaves ``agents``.

    ``reset()`` continues with the next episode's arena, ``reset(seed)`` restarts at the first one
    of that seed, and ``reset(options={"obstacles": ..., "positions": ...})`` uses the given arena,
    bool [H, W], and starts [N, 2].
    """

    metadata = {  # noqa: RUF012 - as PettingZoo declares it
        "name": _NAME,
        "render_modes": list(_RENDER_MODES),
        "render_fps": _FPS,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        config: ArenaConfig | None,
        reward: str | Reward,
        max_steps: int,
        render_mode: RenderMode | None,
        shared_reward: bool,
        **options: Any,
    ) -> None:
        if render_mode not in (None, *_RENDER_MODES):
            raise ValueError(
                f"render_mode={render_mode!r} is not allowed: use None or one of {_RENDER_MODES}"
            )
        self.render_mode = render_mode
        self.shared_reward = shared_reward
        self._env = make_env(config, 1, reward, max_steps, **options)
        self._config: ArenaConfig = self._env.base_env.config
        self._now: TensorDictBase | None = None
        self._window = Window(_NAME, _FPS)
        robots = self._config.num_agents
        self.possible_agents = [f"robot_{i}" for i in range(robots)]
        self.agents: list[str] = []
        self.observation_spaces = {agent: self._observed_space() for agent in self.possible_agents}
        self.action_spaces = {agent: spaces.Discrete(NUM_ACTIONS) for agent in self.possible_agents}
        cells = self._config.num_cells
        size = (1 + robots) * cells + 2 * (robots + self._config.num_walkers)
        size += robots * (self._config.failure_rate > 0)
        self.state_space = spaces.Box(-1, 1, (size,), np.float32)

    def _observed_space(self) -> spaces.Dict:
        specs = (self._env.observation_spec[key] for key in OBSERVATION_KEYS)
        high = concat_observation(*(spec.high[0, 0] for spec in specs)).numpy()
        numbers = spaces.Box(np.zeros_like(high), high)
        return spaces.Dict(observation=numbers, action_mask=spaces.MultiBinary(NUM_ACTIONS))

    def observation_space(self, agent: str) -> spaces.Dict:
        """Observation space of one robot."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """The ten actions: 0 to 7 move N, NE, ... NW, 8 stays, 9 communicates."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode.

        Args:
            seed: of the arenas from now on, at least 0 and below 2**64; None: the next arena.
            options: "obstacles" and "positions" of an arena to start in.

        Raises:
            ValueError: for another seed or option, when only one of the two is given, or starts
                are out of bounds, occupied or shared. The episode in progress is kept.
        """
        start = self._given({} if options is None else options)
        if seed is not None:
            seed = checked_seed(seed)
        if start is not None:
            self._now = self._env.reset(start, set_state=True)
        if seed is not None:
            self._env.set_seed(seed)
        if start is None:
            self._now = self._env.reset()
        self.agents = list(self.possible_agents)
        self._show()
        return self._observations(), self._infos()

    def step(
        self, actions: dict[str, int]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """All robots act at once.

        Args:
            actions: of every robot in ``agents``; docs/environment.md defines the effect of
                actions that the mask forbids.

        Raises:
            ValueError: when a robot's action is missing or not one of the ten, or for an unknown
                robot.
            RuntimeError: before a reset, and after the end of an episode.
        """
        if not self.agents:
            raise RuntimeError("no episode is in progress: call reset() first")
        if strangers := set(actions).difference(self.agents):
            raise ValueError(
                f"actions of {sorted(strangers, key=str)} are not allowed: the robots are "
                f"{self.agents}"
            )
        chosen = {agent: _checked(agent, actions.get(agent)) for agent in self.agents}
        before = self._current.select("obstacles", "step_count", "agents", strict=False)
        every = [chosen.get(agent, STAY) for agent in self.possible_agents]
        before["agents", "action"] = torch.tensor([every])
        self._now = self._env.step(before)["next"]
        self._show()
        outcome = [self._now[key].item() for key in ("terminated", "truncated")]
        terminated, truncated = (dict.fromkeys(self.agents, value) for value in outcome)
        alive = self._of_robots("alive").tolist()
        terminated |= {agent: True for agent in self.agents if not alive[self._number(agent)]}
        rewards = self._rewards()
        observations, infos = self._observations(), self._infos()
        going_on = [] if self._now["done"].item() else self.agents
        self.agents = [agent for agent in going_on if not terminated[agent]]
        return observations, rewards, terminated, truncated, infos

    def state(self) -> NDArray[np.float32]:
        """The true state, for a centralised critic, float32 [(1 + N) H W + 2 N], or longer.

        Obstacles (1, else 0), every robot's map (-1 unknown, 0 free, 1 occupied), and positions as
        shares of the arena's sides; then the positions of walkers, if there are any, and who is
        alive (1, else 0), if robots can fail.
        """
        now = self._current
        height, width = self._config.height, self._config.width
        size = torch.tensor([height, width])
        parts = [now["obstacles"], now["agents", "map"], now["agents", "position"] / size]
        if self._config.num_walkers:
            parts.append(now["walkers"] / size)
        if self._config.failure_rate > 0:
            parts.append(now["agents", "alive"])
        return torch.cat([part.flatten().float() for part in parts]).numpy()

    def render(self) -> NDArray[np.uint8] | str | None:
        """The union of the robots' maps as an image uint8 [16 H, 16 W, 3], or as text.

        None without a render mode and for "human", which shows every step by itself.
        """
        if self.render_mode in (None, "human"):
            return None
        return self._env.render(mode=self.render_mode)

    def _show(self) -> None:
        if self.render_mode == "human":
            self._window.show(self._env.base_env.team())

    def close(self) -> None:
        """Close the window, if there is one."""
        self._window.close()

    @property
    def _current(self) -> TensorDictBase:
        if self._now is None:
            raise RuntimeError("no episode is in progress: call reset() first")
        return self._now

    def _given(self, options: Mapping[str, Any]) -> TensorDict | None:
        """The start that the options ask for, if they do."""
        if not isinstance(options, Mapping):
            raise ValueError(f"options={options!r} is not allowed: use a dictionary")
        for key in options:
            if key not in (*_START, _UNUSED):
                raise ValueError(f"options[{key!r}] is not allowed: use both of {_START}")
        start = {key: options[key] for key in _START if key in options}
        if not start:
            return None
        if len(start) < len(_START):
            raise ValueError(f"options={[*start]} is not allowed: give both of {_START}")
        try:
            obstacles, positions = (torch.as_tensor(np.asarray(start[k]))[None] for k in _START)
        except (TypeError, ValueError) as error:  # text, None, rows of different lengths
            raise ValueError(f"options of {_START} must be arrays of numbers: {error}") from error
        agents = TensorDict({"position": positions}, batch_size=[1])
        return TensorDict({"obstacles": obstacles, "agents": agents}, batch_size=[1])

    def _observations(self) -> dict[str, Observation]:
        numbers = concat_observation(*(self._current[key][0] for key in OBSERVATION_KEYS)).numpy()
        masks = self._masks()
        return {
            agent: {"observation": numbers[self._number(agent)], "action_mask": mask}
            for agent, mask in masks.items()
        }

    def _infos(self) -> dict[str, dict[str, Any]]:
        return {agent: {"action_mask": mask} for agent, mask in self._masks().items()}

    def _rewards(self) -> dict[str, float]:
        if self.shared_reward:
            return dict.fromkeys(self.agents, self._current["reward"].item())
        own = self._of_robots("individual_reward").flatten().tolist()
        return {agent: own[self._number(agent)] for agent in self.agents}

    def _masks(self) -> dict[str, NDArray[np.int8]]:
        masks = self._of_robots("action_mask").to(torch.int8).numpy()
        return {agent: masks[self._number(agent)] for agent in self.agents}

    def _of_robots(self, key: str) -> Tensor:
        """An entry of all robots [N, ...]."""
        return self._current["agents", key][0]

    def _number(self, agent: str) -> int:
        return self.possible_agents.index(agent)


def _checked(agent: str, action: Any) -> int:
    chosen = as_integer(action)
    if chosen is None or not 0 <= chosen < NUM_ACTIONS:
        raise ValueError(
            f"actions[{agent!r}]={action!r} is not allowed: every robot needs an action from "
            f"0 to {NUM_ACTIONS - 1}"
        )
    return chosen
