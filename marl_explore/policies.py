"""Trained policies as files: the actors of a team with the features they were trained on.

A file is safetensors (weights only, nothing in it is executed) whose metadata say how to build
the networks.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from marl_explore.config import Ability, Architecture, ArenaConfig, from_json
from marl_explore.core.frontier import Normalization
from marl_explore.features import make_features, set_range
from marl_explore.files import whole_file
from marl_explore.models import make_actor
from marl_explore.team import ACTION_MASK, TeamActor

FORMAT = "marl_explore.policy/1"
POLICY_FILE = "policy.safetensors"
FOV: NestedKey = ("agents", "observation", "fov")
BUNDLED = Path(__file__).parent / "policies"


@dataclass(frozen=True)
class PolicySpec:
    """What the networks of a policy are built from."""

    arena: ArenaConfig
    architecture: Architecture
    hidden: tuple[int, ...]
    fpr: Normalization | None
    norm_last: bool = False
    without: tuple[Ability, ...] = ()
    shared: bool = False
    communicate_every: int = 1
    communicate_after: int = 0

    def make_actors(self) -> list[nn.Module]:
        """A freshly initialised network per robot, or one that all share."""
        return [
            make_actor(
                self.arena,
                self.architecture,
                self.hidden,
                self.norm_last,
                self.without,
                self.communicate_every,
                self.communicate_after,
            )
            for _ in range(1 if self.shared else self.arena.num_agents)
        ]


class Policy(TensorDictModuleBase):
    """A team of actors that computes its own features: it acts on any ``ExplorationEnv``.

    Reads "map", "position", "action_mask" and ("observation", "fov") of the group "agents" and
    writes ("agents", "action") int64 [*B, N]. Actions are sampled, unless
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` asks for the likeliest.

    Args:
        spec: what the networks were built from.
        actors: a network per robot, or one that all share.
    """

    out_keys: list[NestedKey] = [("agents", "action")]  # noqa: RUF012

    def __init__(self, spec: PolicySpec, actors: Iterable[nn.Module]) -> None:
        super().__init__()
        self.spec = spec
        self.team = TeamActor(actors)
        self._features = make_features(spec.arena, spec.architecture, spec.fpr)
        read = [key for feature in self._features for key in feature.in_keys]
        self.in_keys: list[NestedKey] = [*dict.fromkeys((*read, ACTION_MASK, FOV))]

    @property
    def actors(self) -> nn.ModuleList:
        """The networks, one per robot or one for all."""
        return self.team.stacked.actors

    @property
    def sees(self) -> str:
        """What a robot decides by."""
        if self.spec.architecture == "deepset":
            return "own map, positions of robots in range, what was exchanged when, a clock"
        return "own FOV, FPR, NET"

    @property
    def any_team(self) -> bool:
        """Whether it acts for any number of robots."""
        return self.spec.shared and self.spec.architecture == "deepset"

    def actor_of(self, robot: int) -> nn.Module:
        """The network of one robot."""
        return self.actors[0 if self.spec.shared else robot]

    def start_from(self, other: Policy) -> None:
        """Take the weights of another policy's actors; those of a shared one for every robot.

        Raises:
            ValueError: when its networks are others, or it has fewer actors.
        """
        kind, theirs = (
            (
                spec.architecture,
                spec.hidden,
                spec.norm_last,
                spec.without,
                spec.arena.fov_size,
                # deepset actors read any number of robots
                None if spec.architecture == "deepset" else spec.arena.num_agents,
            )
            for spec in (self.spec, other.spec)
        )
        enough = other.spec.shared or len(other.actors) >= len(self.actors)
        if kind != theirs or not enough:
            raise ValueError(
                f"{len(self.actors)} actors {kind} cannot start from {len(other.actors)} {theirs}"
            )
        for robot, actor in enumerate(self.actors):
            actor.load_state_dict(other.actor_of(robot).state_dict())

    def use_range(self, cells: float) -> None:
        """Count robots up to this distance (cells) as in range; at first that of the training."""
        set_range(self._features, cells)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action")."""
        acted = self.team(self.observe(tensordict))
        return tensordict.set(("agents", "action"), acted.get(("agents", "action")))

    def observe(self, tensordict: TensorDictBase) -> TensorDictBase:
        """What the team decides by: the entries it reads, and its features."""
        observation = tensordict.select(*self.in_keys)
        fov = observation.get(FOV)
        self.check(robots=fov.shape[-3], fov_size=fov.shape[-1])
        return self._features(observation)

    def check(self, robots: int, fov_size: int) -> None:
        """Refuse another team or sensor than the policy was trained for.

        Raises:
            ValueError: naming both.
        """
        arena = self.spec.arena
        if robots != arena.num_agents and not self.any_team:
            raise ValueError(
                f"the policy was trained for num_agents={arena.num_agents}, and the environment "
                f"has {robots} robots"
            )
        if fov_size != arena.fov_size:
            raise ValueError(
                f"the policy was trained for fov_radius={arena.fov_radius}, and the environment's "
                f"field of view is {fov_size} x {fov_size} cells"
            )


def save_policy(policy: Policy, path: str | Path, info: Mapping[str, Any] | None = None) -> Path:
    """Write a policy to a file, or to ``policy.safetensors`` in a folder.

    Args:
        policy: the team.
        path: a file ending in .safetensors, or an existing folder.
        info: where the policy comes from (seed, command, scores); kept with the weights.
    """
    path = _file_of(Path(path))
    metadata = {
        "format": FORMAT,
        "spec": json.dumps(asdict(policy.spec)),
        "info": json.dumps(dict(info or {})),
    }
    weights = {name: tensor.contiguous() for name, tensor in policy.actors.state_dict().items()}
    if not path.parent.is_dir():
        raise ValueError(f"cannot save a policy to {path}: the folder does not exist")
    with whole_file(path) as unfinished:
        save_file(weights, unfinished, metadata)
    return path


def load_policy(path_or_name: str | Path) -> Policy:
    """The policy in a file or run folder, or a bundled one by name (``list_policies``).

    Raises:
        ValueError: when there is no such policy, or the file is not one.
    """
    path = _find(path_or_name)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} is not a readable policy file: {error}") from error
    if metadata.get("format") != FORMAT:
        raise ValueError(
            f"{path} is not a policy of this package: its format is "
            f"{metadata.get('format')!r}, expected {FORMAT!r}"
        )
    try:
        spec = PolicySpec(**from_json(json.loads(metadata["spec"])))
        policy = Policy(spec, spec.make_actors())
        policy.actors.load_state_dict(weights)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} is not a complete policy: {error!r}") from error
    return policy.eval()


def policy_info(path_or_name: str | Path) -> dict[str, Any]:
    """The information that was saved with a policy."""
    with safe_open(_find(path_or_name), framework="pt") as file:
        return json.loads((file.metadata() or {}).get("info", "{}"))


def policy_digest(path_or_name: str | Path) -> str:
    """SHA-256 of a policy's file."""
    return hashlib.sha256(_find(path_or_name).read_bytes()).hexdigest()


def list_policies() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(file.name.removesuffix(".safetensors") for file in BUNDLED.glob("*.safetensors"))


def _file_of(path: Path) -> Path:
    return path / POLICY_FILE if path.is_dir() else path


def _find(path_or_name: str | Path) -> Path:
    bundled = BUNDLED / f"{path_or_name}.safetensors"
    path = bundled if bundled.is_file() else _file_of(Path(path_or_name))
    if not path.is_file():
        raise ValueError(
            f"no policy {str(path_or_name)!r}: it is neither a file, nor a run folder with "
            f"{POLICY_FILE}, nor one of the bundled policies {list_policies()}"
        )
    return path
