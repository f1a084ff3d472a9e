"""A robot's actor in numpy, from the .npz file that ``marl_explore/policies/export.py`` writes."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.constants import (
    ABILITIES,
    COMMUNICATE,
    FORBIDDEN_LOGIT,
    NORMALIZATIONS,
    NUM_ACTIONS,
    NUM_DIRECTIONS,
    NUM_FEATURES,
    Normalization,
)
from marl_explore.config.fields import read_fields
from marl_explore.robot.goal_actor import GoalActor
from marl_explore.robot.networks import TWINS, Array
from marl_explore.robot.observation import Observation
from marl_explore.utils.json_files import parse_object

FORMAT = "marl_explore.actors/2"
GOALS = "goals"
"""The twin of actors that choose among goals (``goal_actor.GoalActor``)."""
_ALLOWED = {"twin": (*TWINS, GOALS), "fpr": NORMALIZATIONS}


class ExportedPolicy:
    """One robot's actor: logits from numpy, then a choice.

    Called with an ``Observation`` it returns an action. A policy that chooses among goals
    (docs/goals.md) has a memory of its episode: call it once per step. The memory is blank at
    first, after ``reset``, and whenever the step is 0 or before the last one. Its robots give way
    (docs/planners.md), so they also draw random numbers when the most likely choice is taken.

    Args:
        path: an exported .npz file.
        robot: whose actor to take.
        sample: whether actions are sampled; False: the most likely action, with which a memoryless
            policy can repeat a refused move forever.
        seed: of all random numbers.

    Raises:
        ValueError: when the file is not an exported policy, naming what does not fit, or has no
            such robot.
    """

    def __init__(self, path: str | Path, robot: int, sample: bool = True, seed: int = 0) -> None:
        self.robot = robot
        self.spec, weights = _read(Path(path))
        self.arena = ArenaConfig(**self.spec["arena"])
        self.fpr: Normalization | None = self.spec["fpr"]
        if robot < 0 or (robot >= self.arena.num_agents and not self.any_team):
            raise ValueError(
                f"robot={robot!r} is not allowed: {path} has actors of {self.arena.num_agents}"
            )
        prefix = "0." if self.spec.get("shared") else f"{robot}."
        self._weights = {
            name.removeprefix(prefix).removeprefix("actor."): array
            for name, array in weights.items()
            if name.startswith(prefix)
        }
        self._ablate = frozenset(self.spec["ablate"])
        self._sample, self._chance = sample, np.random.default_rng([seed, robot])
        self._goals: GoalActor | None = None
        try:
            self._check_finite()
            if self.spec["twin"] == GOALS:
                sight, options = self.arena.sight, self.spec["options"]
                self._goals = GoalActor(self._weights, options, robot, sight)
            else:
                self._logits = TWINS[self.spec["twin"]]
                self._check_weights()
        except (LookupError, ValueError) as error:
            reason = f"the actor of robot {robot} does not fit its spec: {error}"
            raise ValueError(f"{path} is not an exported policy: {reason}") from error

    @property
    def any_team(self) -> bool:
        """Whether it works for any number of robots, all with the same sensor."""
        equal = len(self.arena.sight.ranges_cells) == 1
        return self.spec["twin"] == GOALS and bool(self.spec.get("shared")) and equal

    def check(self, robots: int, fov_size: int) -> None:
        """Raise an error for another team or sensor than the policy was trained for.

        Args:
            robots: size of the team.
            fov_size: side of the field of view (cells).

        Raises:
            ValueError: naming both.
        """
        arena = self.arena
        if robots != arena.num_agents and not self.any_team:
            raise ValueError(
                f"the policy was trained for num_agents={arena.num_agents}, not {robots}"
            )
        if fov_size != arena.fov_size:
            raise ValueError(
                f"the policy was trained for fov_radius={arena.fov_radius}, and the field of view "
                f"is {fov_size} x {fov_size} cells"
            )

    def _check_finite(self) -> None:
        for name, array in self._weights.items():
            if array.dtype.kind != "f" or not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite floating-point numbers")

    def _check_weights(self) -> None:
        """Check, with a trial run, that the arrays are a network for the arena."""
        for name, array in self._weights.items():
            layer, _, kind = name.rpartition(".")
            bias = self._weights.get(f"{layer}.bias")
            if kind == "weight" and (bias is None or bias.shape != array.shape[:1]):
                shape = None if bias is None else bias.shape
                raise ValueError(f"{layer}.bias of shape {shape} must have {array.shape[:1]}")
        side, robots = self.arena.fov_size, self.arena.num_agents
        shapes = {"fov": (side, side), "fpr": (NUM_DIRECTIONS, NUM_FEATURES), "net": (robots,)}
        inputs = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        logits = self._logits(self._weights, **inputs)
        if logits.shape != (NUM_ACTIONS,):
            raise ValueError(f"it gives {logits.shape} instead of {NUM_ACTIONS} logits")

    def __call__(self, observation: Observation) -> int:
        """An allowed action.

        Raises:
            ValueError: for an observation of another team or field of view than the policy's, where
                it chooses among goals.
        """
        if self._goals is not None:
            self.check(len(observation.net), len(observation.fov))
            return self._goals.act(observation, self._chance, self._sample)
        logits = self.masked_logits(
            observation.fov, observation.fpr, observation.net, observation.action_mask
        )
        if not self._sample:
            return int(logits.argmax())
        return int((logits + self._chance.gumbel(size=logits.shape)).argmax())

    def with_seed(self, seed: int | Sequence[int]) -> ExportedPolicy:
        """The same actor with another seed and a blank memory; the weights are shared."""
        other = copy.copy(self)
        other._chance = np.random.default_rng(seed)
        other._goals = self._goals and self._goals.blank()
        return other

    def reset(self) -> None:
        """Forget the episode; most policies remember nothing."""
        if self._goals is not None:
            self._goals.reset()

    def masked_logits(
        self, fov: Array, fpr: Array, net: Array, action_mask: NDArray[np.bool_]
    ) -> Array:
        """Logits float32 [*B, 10], minus infinity where an action is not allowed.

        Args:
            fov: [*B, 2k + 1, 2k + 1].
            fpr: [*B, 8, 3].
            net: [*B, N].
            action_mask: bool [*B, 10].

        Raises:
            ValueError: for a policy that chooses among goals.
        """
        if self._goals is not None:
            raise ValueError("the policy chooses among goals: it has no logits of actions")
        inputs = {"fov": fov, "fpr": fpr, "net": net}
        for name in self._ablate & inputs.keys():
            inputs[name] = np.zeros_like(inputs[name])
        logits = self._logits(self._weights, **inputs)
        if "communication" in self._ablate:
            logits[..., COMMUNICATE] = FORBIDDEN_LOGIT
        return np.where(action_mask, logits, np.float32(-np.inf))


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    try:
        # opened here, since numpy leaves a damaged archive open
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        signed = str(arrays.pop("sha256", None))
        spec = parse_object(str(arrays["spec"]), "its spec")
        _check_spec(spec)
        if signed != _digest(arrays):
            raise ValueError("its contents do not match its SHA-256")
        del arrays["spec"]
    except Exception as error:  # zipfile, zlib and numpy raise many kinds for damaged files
        raise ValueError(f"{path} is not an exported policy: {error}") from error
    return spec, arrays


def save_arrays(file: BinaryIO, spec: str, weights: Mapping[str, NDArray[Any]]) -> None:
    """Write an exported policy with its SHA-256, in the format that ``ExportedPolicy`` reads."""
    arrays = {**weights, "spec": np.array(spec)}
    np.savez(file, sha256=np.array(_digest(arrays)), **arrays)  # type: ignore[arg-type]


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of the arrays of an exported policy, its spec included."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def _check_spec(spec: Mapping[str, Any]) -> None:
    if spec.get("format") != FORMAT:
        raise ValueError(f"its format is {spec.get('format')!r}, expected {FORMAT!r}")
    for name in ("arena", "twin", "fpr", "ablate"):
        if name not in spec:
            raise ValueError(f"its spec has no {name!r}")
    for name, allowed in _ALLOWED.items():
        if spec[name] not in allowed:
            raise ValueError(f"{name}={spec[name]!r} is not allowed: use one of {allowed}")
    if not set(spec["ablate"]) <= set(ABILITIES):
        raise ValueError(f"ablate={spec['ablate']!r} is not allowed: use some of {ABILITIES}")
    if not isinstance(spec.get("shared", False), bool):
        raise ValueError(f"shared={spec['shared']!r} is not allowed: it must be true or false")
    read_fields(ArenaConfig, spec["arena"], "its spec, arena")
    if spec["twin"] == GOALS:
        if not isinstance(spec.get("options"), dict):
            raise ValueError(
                f"options={spec.get('options')!r} is not allowed: goals need an object"
            )
        if spec["ablate"]:
            raise ValueError(f"ablate={spec['ablate']!r} is not allowed: goals have no ablations")
