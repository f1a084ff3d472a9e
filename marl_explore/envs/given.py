"""Checks of what callers hand to the environment: actions, seeds, starts and states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import index
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.checks import require
from marl_explore.core import world
from marl_explore.core.grid import NUM_ACTIONS
from marl_explore.core.links import links
from marl_explore.core.radio import reaches
from marl_explore.envs.state import EpisodeState

ACTION: NestedKey = ("agents", "action")
_ALLOWED = f"it must be an integer from 0 to {NUM_ACTIONS - 1}"
_INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
_SEEDS = 1 << 64
_WORLD_KEYS: dict[NestedKey, str] = {
    "obstacles": "obstacles",
    ("agents", "map"): "map",
    ("agents", "position"): "position",
    ("agents", "unshared"): "unshared",
    ("agents", "steps_since_merge"): "steps_since_merge",
    "step_count": "step_count",
}
_START_KEYS: tuple[NestedKey, NestedKey] = ("obstacles", ("agents", "position"))
_OPTIONAL_KEYS: dict[NestedKey, str] = {
    ("agents", "alive"): "alive",
    "walkers": "walkers",
    "draw_key": "draw_key",
}


DrawKeys = Callable[[int, Tensor], Tensor]
"""From a seed and episodes int64 [B] to the keys of their random events, int64 [B, 1]."""


def as_integer(value: Any) -> int | None:
    """The integer in a number of Python, NumPy or torch or an array of one; None: there is none."""
    try:
        array = np.asarray(value)
        return index(array.item()) if array.size == 1 and array.dtype.kind in "iuO" else None
    except (TypeError, ValueError):
        return None


def checked_seed(seed: Any) -> int:
    """A seed of arenas as a Python integer.

    Raises:
        ValueError: when it is not an integer from 0 to 2**64 - 1.
    """
    found = as_integer(seed)
    allowed = found is not None and 0 <= found < _SEEDS
    require(allowed, "seed", seed, "it must be an integer of at least 0 and below 2**64")
    return found  # type: ignore[return-value]


def checked_action(tensordict: TensorDictBase, robots: int) -> Tensor:
    """The actions in a TensorDict [B], int64 [B, N].

    Raises:
        ValueError: when they are missing, or of another dtype, shape or range.
    """
    action = tensordict.get(ACTION, None)
    if action is None:
        raise ValueError(f"the entry {ACTION} is missing: every robot needs an action, {_ALLOWED}")
    shape = (*tensordict.batch_size, robots)
    if action.dtype not in _INTEGERS or action.shape != shape:
        raise ValueError(
            f"{ACTION} must be torch.int64 of shape {shape}, integers from 0 to {NUM_ACTIONS - 1}, "
            f"got {action.dtype} of shape {tuple(action.shape)}{_first_value(action)}"
        )
    low, high = action.aminmax()
    if low.item() < 0 or high.item() >= NUM_ACTIONS:
        arena, robot = ((action < 0) | (action >= NUM_ACTIONS)).nonzero()[0].tolist()
        value = action[arena, robot].item()
        raise ValueError(
            f"{ACTION}={value} of robot {robot} in arena {arena} is not allowed: {_ALLOWED}"
        )
    return action.long()


def _first_value(action: Tensor) -> str:
    """What to add to an error, so that it shows one of the wrong values."""
    return f", such as {action.flatten()[0].item()}" if action.numel() else ""


def given_state(
    config: ArenaConfig, spec: Composite, given: TensorDictBase | None, draw_key: Tensor
) -> EpisodeState:
    """The state in a TensorDict: given starts, or all of an episode in progress.

    Robots that are alive, cells of walkers and keys of random events may be given as well; else all
    live, walkers are drawn, and the keys are ``draw_key`` [B, 1].

    Raises:
        ValueError: when entries are missing, of another dtype or shape, or contradict each other.
    """
    entries = {} if given is None else _entries(given, _WORLD_KEYS)
    missing = [key for key in _WORLD_KEYS if key not in entries]
    if any(key in missing for key in _START_KEYS) or (missing and len(entries) > len(_START_KEYS)):
        raise ValueError(
            f"reset(set_state=True) needs {_START_KEYS} to start an episode, or all of "
            f"{tuple(_WORLD_KEYS)} to continue one; missing: {missing}"
        )
    optional = {} if given is None else _entries(given, _OPTIONAL_KEYS)
    if not config.num_walkers and "walkers" in optional:
        raise ValueError("reset(set_state=True): 'walkers' is not allowed with num_walkers=0")
    for key, value in {**entries, **optional}.items():
        require_like("reset(set_state=True)", key, value, spec[key])
    obstacles, position = (entries[key] for key in _START_KEYS)
    world.check_starts(obstacles, position, optional.get("walkers"))
    every = {**_WORLD_KEYS, **_OPTIONAL_KEYS}
    parts = {every[key]: value.clone() for key, value in {**entries, **optional}.items()}
    parts.setdefault("draw_key", draw_key)
    if missing:
        return EpisodeState.at_rest(world.start(config, **parts), first=True)
    resumed = world.resume(config, **parts)
    world.check_maps(obstacles, position, resumed.map, resumed.alive)
    return EpisodeState.at_rest(resumed, first=False)


def _entries(tensordict: TensorDictBase, keys: Mapping[NestedKey, str]) -> dict[NestedKey, Tensor]:
    found = {key: tensordict.get(key, None) for key in keys}
    return {key: value for key, value in found.items() if value is not None}


def loaded_state(
    config: ArenaConfig, spec: Composite, state_dict: Mapping[str, Any], draw_keys: DrawKeys
) -> EpisodeState | None:
    """The state in a ``state_dict`` of an environment; None: it was made before the first reset.

    ``draw_keys`` are for a state of a version without random events.

    Raises:
        ValueError: when the entries are not those of this environment.
    """
    names = {"seed", "episode"}
    started = len(state_dict) > len(names)
    if started:
        names.update(EpisodeState.names())
        state_dict = _completed(config, state_dict, draw_keys)
    if set(state_dict) != names:
        raise ValueError(
            f"state_dict holds {sorted(state_dict)}, expected {sorted(names)} "
            "(made by ExplorationEnv.state_dict)"
        )
    episodes = len(state_dict["episode"])
    if episodes != spec.shape[0]:
        raise ValueError(
            f"state_dict is of {episodes} arenas, this environment has {spec.shape[0]}"
        )
    if not started:
        return None
    # derived tensors must match those of this configuration
    for name, like in _blank(config, spec).tensors().items():
        require_like("state_dict", name, state_dict[name], like)
    return EpisodeState.from_tensors(state_dict)


def _completed(
    config: ArenaConfig, state: Mapping[str, Any], draw_keys: DrawKeys
) -> Mapping[str, Any]:
    """A state of an older version with the entries that it lacks.

    Raises:
        ValueError: naming a setting that the older version did not have.
    """
    if not {"position", "obstacles", "known", "seed", "episode"} <= set(state):
        return state  # refused by its names
    added: dict[str, Tensor] = {}
    if "linked" not in state:  # version 0.1
        reach = reaches(config, draw_keys(state["seed"], state["episode"]))
        added["linked"] = links(config, state["position"], state["obstacles"], reach)
    if not {"alive", "walkers", "draw_key", "reach"} & set(state):
        config.require_as_in_paper("the state_dict is of an older version")
        batch = state["position"].shape[:-2]
        added["alive"] = torch.ones_like(state["known"], dtype=torch.bool)
        added["walkers"] = state["position"].new_zeros(*batch, 0, 2)
        added["draw_key"] = draw_keys(state["seed"], state["episode"])
        added["reach"] = state["position"].new_zeros(*batch, 0, 0)
    return {**state, **added}


def _blank(config: ArenaConfig, spec: Composite) -> EpisodeState:
    """A state with empty arenas, for its dtypes and shapes."""
    entries = spec.zero()
    blank = world.start(config, entries["obstacles"], entries["agents", "position"])
    return EpisodeState.at_rest(blank, first=True)


def require_like(where: str, key: NestedKey, value: Tensor, like: Tensor | TensorSpec) -> None:
    """Require a tensor of the dtype and shape of another one or of a spec."""
    if value.dtype != like.dtype or value.shape != like.shape:
        raise ValueError(
            f"{where}: {key!r} must be {like.dtype} of shape {tuple(like.shape)}, "
            f"got {value.dtype} of shape {tuple(value.shape)}"
        )
