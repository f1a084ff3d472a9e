"""Settings of an exploration task: metres as a person gives them, cells as the rules use them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

ANY_SIZE = ("uniform", "mixed")
"""Kinds of arenas that take any size; suites have their own."""
TOLERANCE = 1e-9
"""Slack of every comparison of real distances, so that 0.3 / 0.1 counts as 3."""


def _require(condition: bool, name: str, value: object, allowed: str) -> None:
    if not condition:
        raise ValueError(f"{name}={value!r} is not allowed: {allowed}")


def require_integer(name: str, value: object, low: int) -> None:
    """Refuse what is no integer of at least ``low``."""
    integer = isinstance(value, int) and not isinstance(value, bool)
    _require(
        integer and value >= low,  # type: ignore[operator]
        name,
        value,
        f"it must be an integer of at least {low}",
    )


def require_positive(name: str, value: float, unit: str) -> None:
    """Refuse what is no positive finite number."""
    _require(0 < value < math.inf, name, value, f"it must be a positive finite number of {unit}")


def require_not_negative(name: str, value: float, unit: str) -> None:
    """Refuse what is no finite number of at least 0."""
    _require(0 <= value < math.inf, name, value, f"it must be at least 0 {unit}, and finite")


def require_coverage(name: str, value: float | None) -> None:
    """Refuse a share of coverage that ends no episode or all of them."""
    _require(value is None or 0 < value <= 1, name, value, "it must be None or lie in (0, 1]")


@dataclass(frozen=True)
class ArenaConfig:
    """The arena, its robots and their sensors; the defaults are the paper's Table III.

    Raises:
        ValueError: naming the field, its value and the bound, when a value is out of range.
    """

    height: int = 12
    """Rows of the grid (cells)."""
    width: int = 12
    """Columns of the grid (cells)."""
    obstacle_density: float = 0.1
    """Share of the cells that hold a static obstacle."""
    num_agents: int = 4
    """Robots in the arena."""
    cell_size: float = 0.5
    """Side of a cell (metres)."""
    sensing_range: float = 1.1
    """Radius of the sensing disc (metres)."""
    communication_range: float = 3.2
    """Largest distance between two robots that can exchange maps (metres; may be infinite)."""
    occlusion: bool = False
    """Whether two obstacles hide the diagonal cell behind them (3 x 3 field of view only)."""

    def __post_init__(self) -> None:
        """Refuse settings that describe no arena."""
        require_integer("height", self.height, 1)
        require_integer("width", self.width, 1)
        require_integer("num_agents", self.num_agents, 1)
        for name in ("cell_size", "sensing_range"):
            require_positive(name, getattr(self, name), "metres")
        _require(
            self.communication_range >= 0,
            "communication_range",
            self.communication_range,
            "it must be at least 0 metres",
        )
        _require(
            0 <= self.obstacle_density < 1,
            "obstacle_density",
            self.obstacle_density,
            "it must lie in [0, 1)",
        )
        smallest = 1.5 * math.sqrt(2) * self.cell_size
        _require(
            self.fov_radius >= 1,
            "sensing_range",
            self.sensing_range,
            f"it must be at least {smallest:.4g} m to hold a 3 x 3 square of "
            f"{self.cell_size} m cells",
        )
        _require(
            not self.occlusion or self.fov_radius == 1,
            "occlusion",
            self.occlusion,
            f"it needs a 3 x 3 field of view, and sensing_range={self.sensing_range} gives "
            f"{self.fov_size} x {self.fov_size}",
        )
        free = self.num_cells - self.num_obstacles
        _require(
            self.num_agents <= free,
            "num_agents",
            self.num_agents,
            f"{self.height} x {self.width} cells with obstacle_density={self.obstacle_density} "
            f"leave room for at most {free}",
        )

    @property
    def num_cells(self) -> int:
        """Cells of the grid."""
        return self.height * self.width

    @property
    def num_obstacles(self) -> int:
        """Static obstacles of every arena."""
        return round(self.obstacle_density * self.num_cells)

    @property
    def fov_radius(self) -> int:
        """The k of the (2k+1) x (2k+1) field of view: its square lies inside the sensing disc."""
        return math.floor(self.sensing_range / (math.sqrt(2) * self.cell_size) - 0.5 + TOLERANCE)

    @property
    def fov_size(self) -> int:
        """Side of the field of view, 2k + 1 (cells)."""
        return 2 * self.fov_radius + 1

    @property
    def communication_cells(self) -> float:
        """Communication range (cells)."""
        return self.communication_range / self.cell_size

    @property
    def max_discovery(self) -> int:
        """Most cells one diagonal move can discover, the paper's e_max = 4k + 1 (Eq. 5)."""
        return 4 * self.fov_radius + 1

    @property
    def observation_size(self) -> int:
        """Numbers one robot's actor reads: FOV, FPR (8 x 3) and NET; 37 for the paper's arena."""
        return self.fov_size**2 + 24 + self.num_agents


def from_json(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a configuration from what JSON made of its fields: an arena, and tuples."""
    arena = ArenaConfig(**fields["arena"])
    tuples = {name: tuple(value) for name, value in fields.items() if isinstance(value, list)}
    return {**fields, **tuples, "arena": arena}


Algorithm = Literal["happo", "mappo", "ippo"]
Architecture = Literal["mlp", "cnn", "deepset"]
Ability = Literal["fov", "fpr", "net", "communication"]
CriticInput = Literal["observation", "state"]
Precision = Literal["float32", "bfloat16"]
_CHOICES = {
    "algorithm": get_args(Algorithm),
    "architecture": get_args(Architecture),
    "critic_reads": get_args(CriticInput),
    "precision": get_args(Precision),
    "fpr": ("relative", "proximity", "absolute"),
}


ABILITIES: tuple[Ability, ...] = get_args(Ability)


@dataclass(frozen=True)
class TrainConfig:
    """A training run; the defaults are the paper's Table III and, where it is silent, HAPPO's."""

    arena: ArenaConfig = field(default_factory=ArenaConfig)
    """The arena, its robots and their sensors; size and density are those of a suite."""
    arenas: str = "uniform"
    """Kind of arenas: a suite's name; uniform or mixed for any size."""
    reward: str = "case2"
    """Reward: case1, case2, case2-literal, team or progress."""
    fpr: Literal["relative", "proximity", "absolute"] = "relative"
    """Normalisation of the frontier table."""
    algorithm: Algorithm = "happo"
    """Actors in turn (happo), one actor that all share (mappo), or each learning alone (ippo)."""
    architecture: Architecture = "mlp"
    """Networks of actors and critic."""
    hidden: tuple[int, ...] = (2400, 300)
    """Widths of the hidden layers; a CNN uses the last one."""
    norm_last: bool = False
    """Whether the last hidden layer of an MLP is normalised too."""
    start_from: str | None = None
    """Policy whose actors the run starts from: a file, a run folder or a bundled one's name."""
    without: tuple[Ability, ...] = ()
    """What actors must do without: parts of the observation (they read 0), or to communicate."""
    communicate_every: int = 1
    """Steps between the times at which deepset actors may communicate, by a shared clock."""
    communicate_after: int = 0
    """Fewest steps since the last exchange with a robot in range before they may do it again."""
    critic_reads: CriticInput = "observation"
    """Whether the critic reads the joint observation (the paper) or the true state."""
    episodes: int = 5000
    """Training length, n_e (episodes of episode_steps steps)."""
    episode_steps: int = 200
    """Steps after which an episode is truncated, n_s."""
    terminate_at_coverage: float | None = None
    """Share of the target cells that ends an episode; None: never."""
    num_envs: int = 8
    """Arenas stepped side by side; with rollout_steps = episode_steps, episodes per update, n_b."""
    rollout_steps: int = 200
    """Steps of every arena per update."""
    clip_epsilon: float = 0.2
    """Half width of the clipping range of the policy ratio, epsilon."""
    ppo_epochs: int = 5
    """Passes over the batch per update of an actor or the critic."""
    minibatches: int = 1
    """Parts the batch is split into in every pass."""
    actor_lr: float = 5e-4
    """Adam's step size for the actors."""
    critic_lr: float = 5e-4
    """Adam's step size for the critic."""
    lr_decay: bool = False
    """Whether step sizes fall linearly to 5 % of their start."""
    adam_eps: float = 1e-5
    """Adam's epsilon."""
    max_grad_norm: float = 10.0
    """Bound of the gradient's norm per network."""
    gamma: float = 0.99
    """Discount per step."""
    lmbda: float = 0.95
    """GAE's lambda."""
    entropy_coeff: float = 0.01
    """Weight of the entropy bonus."""
    value_norm: bool = True
    """Whether the critic predicts in units of running return statistics."""
    precision: Precision = "float32"
    """Numbers in the products of an update: bfloat16 is faster on processors that have it."""
    compile: bool = False
    """Whether torch.compile fuses the networks of an update; it takes minutes to warm up."""
    seed: int = 0
    """Seed of arenas, initial weights, actions and minibatches."""

    def __post_init__(self) -> None:
        """Refuse settings that describe no run."""
        self._require_ranges()
        self._require_networks()
        self._require_batch()

    def _require_ranges(self) -> None:
        """What holds for each setting alone."""
        for name in ("episodes", "episode_steps", "num_envs", "rollout_steps", "ppo_epochs"):
            require_integer(name, getattr(self, name), 1)
        require_integer("seed", self.seed, 0)
        require_integer("communicate_after", self.communicate_after, 0)
        for name, allowed in _CHOICES.items():
            _require(getattr(self, name) in allowed, name, getattr(self, name), f"use {allowed}")
        for width in self.hidden:
            require_integer("hidden", width, 1)
        for ability in self.without:
            _require(ability in ABILITIES, "without", self.without, f"use some of {ABILITIES}")
        _require(len(self.hidden) > 0, "hidden", self.hidden, "it needs at least one width")
        for name in ("clip_epsilon", "actor_lr", "critic_lr", "adam_eps", "max_grad_norm"):
            _require(getattr(self, name) > 0, name, getattr(self, name), "it must be positive")
        _require(
            self.entropy_coeff >= 0, "entropy_coeff", self.entropy_coeff, "it must be at least 0"
        )
        require_coverage("terminate_at_coverage", self.terminate_at_coverage)
        for name in ("gamma", "lmbda"):
            _require(
                0 <= getattr(self, name) <= 1, name, getattr(self, name), "it must lie in [0, 1]"
            )

    def _require_networks(self) -> None:
        """What actors and critics can read, of those that are chosen."""
        periods = (1, 2, 3, 6) if self.architecture == "deepset" else (1,)
        _require(
            self.communicate_every in periods,
            "communicate_every",
            self.communicate_every,
            f"with {self.architecture} actors, use one of {periods}",
        )
        _require(
            self.architecture == "deepset" or self.communicate_after == 0,
            "communicate_after",
            self.communicate_after,
            f"{self.architecture} actors do not read when robots exchanged",
        )
        _require(
            self.architecture != "deepset" or "net" not in self.without,
            "without",
            self.without,
            "deepset actors do not read net",
        )
        _require(
            self.architecture != "deepset" or self.critic_reads == "state",
            "critic_reads",
            self.critic_reads,
            "beside deepset actors the critic reads the state",
        )
        _require(
            self.algorithm != "ippo" or self.critic_reads == "observation",
            "critic_reads",
            self.critic_reads,
            "ippo's critics read their own robot's observation",
        )

    def _require_batch(self) -> None:
        """A batch that can be normalised over and split, and steps for at least one."""
        _require(
            isinstance(self.minibatches, int) and 1 <= self.minibatches <= self.batch_frames,
            "minibatches",
            self.minibatches,
            f"it must be an integer from 1 to num_envs x rollout_steps = {self.batch_frames}",
        )
        _require(
            self.batch_frames >= 2,
            "rollout_steps",
            self.rollout_steps,
            "num_envs x rollout_steps must be at least 2, to normalise advantages over",
        )
        _require(
            self.updates >= 1,
            "episodes",
            self.episodes,
            f"one update takes {self.batch_frames} steps of an arena, "
            f"{self.batch_frames / self.episode_steps:g} episodes",
        )

    @property
    def batch_frames(self) -> int:
        """Steps of single arenas per update."""
        return self.num_envs * self.rollout_steps

    @property
    def updates(self) -> int:
        """Updates of a whole run."""
        return self.episodes * self.episode_steps // self.batch_frames
