"""Settings of a training run: the task, the networks and the hyper-parameters."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from marl_explore.arenas import fit
from marl_explore.config.arena import ANY_SIZE, ArenaConfig
from marl_explore.config.checks import (
    require,
    require_coverage,
    require_integer,
    require_not_negative,
    require_positive,
    require_share,
)
from marl_explore.config.constants import Ability
from marl_explore.config.fields import check_types
from marl_explore.happo.update import UpdateOrder
from marl_explore.policies.networks import MLP, CriticInput, Network, NetworkSettings
from marl_explore.policies.networks.ablation import require_abilities
from marl_explore.training.worlds import random_world

Algorithm = Literal["happo", "mappo", "ippo"]
Precision = Literal["float32", "bfloat16"]


@dataclass(frozen=True)
class TrainConfig(NetworkSettings):
    """A training run; the defaults are the paper's Table III and, where it is open, HAPPO's."""

    arena: ArenaConfig = field(default_factory=ArenaConfig)
    """The arena, its robots and their sensors; a suite fixes size and density, or all of it."""
    arenas: str = "uniform"
    """Kind of arenas: the name of a suite, or uniform, uniform-v2 or mixed, which take any size."""
    reward: str = "case2"
    """Reward function: case1, case2, case2-lone-idle, team, progress or union."""
    fpr: Literal["relative", "proximity", "absolute"] = "relative"
    """Normalisation of the frontier table."""
    algorithm: Algorithm = "happo"
    """happo: an actor per robot, updated in turn; mappo: a shared actor; ippo: all independent."""
    actors: Literal["robot", "type"] = "robot"
    """Whether happo has an actor per robot, or one per type of robots: those with the same sensor,
    radio and speed."""
    update_order: UpdateOrder = "random"
    """Order in which happo updates its actors; fixed and simultaneous are for ablations."""
    network: Network = field(default_factory=MLP)
    """Kind of network for the actors and the critic, with its options."""
    init_from: str | None = None
    """Policy whose actors initialise the run: a file, a run folder or a bundled policy's name."""
    ablate: tuple[Ability, ...] = ()
    """What actors do without: parts of the observation (read as 0), or communication."""
    critic_input: CriticInput = "observation"
    """Input of the critic: the joint observation (as in the paper) or the true state."""
    scenes: tuple[str, ...] = ()
    """Kinds of arenas, each with a number of robots, that train side by side in equal shares, such
    as uniform/3 uniform-16/4 open-24/6 (kinds of any size may have another side than ``arena``),
    and uniform-16/4@7 in the random world of number 7 (``worlds.random_world``); empty: ``arenas``
    alone. The actors must be shared and choose among goals; ``arena`` and ``arenas`` are then for
    validation."""
    episodes: int = 5000
    """Length of training, n_e (episodes of episode_steps steps)."""
    episode_steps: int = 200
    """Steps after which an episode is truncated, n_s."""
    terminate_at_coverage: float | None = None
    """Coverage of the largest map that ends an episode; None: never."""
    num_envs: int = 8
    """Arenas stepped side by side; with rollout_steps = episode_steps, episodes per update, n_b."""
    rollout_steps: int = 200
    """Steps of every arena per update."""
    clip_epsilon: float = 0.2
    """PPO's clipping range epsilon: ratios are clipped to [1 - epsilon, 1 + epsilon]."""
    ppo_epochs: int = 5
    """Epochs: passes over the batch per update of an actor or the critic."""
    num_minibatches: int = 1
    """Minibatches per pass over the batch."""
    actor_lr: float = 5e-4
    """Adam's learning rate for the actors."""
    critic_lr: float = 5e-4
    """Adam's learning rate for the critic."""
    lr_decay: bool = False
    """Whether learning rates decay linearly to 5 % of their initial value."""
    adam_eps: float = 1e-5
    """Adam's epsilon."""
    max_grad_norm: float = 10.0
    """Largest gradient norm per network; larger gradients are scaled down."""
    gamma: float = 0.99
    """Discount factor per step."""
    lmbda: float = 0.95
    """GAE's lambda."""
    entropy_coeff: float = 0.01
    """Weight of the entropy bonus."""
    value_norm: bool = True
    """Whether the critic predicts in units of running return statistics."""
    precision: Precision = "float32"
    """Precision of an update's matrix products: bfloat16 is faster on processors that have it."""
    compile: bool = False
    """Whether torch.compile compiles the networks of an update; it takes minutes at the start."""
    seed: int = 0
    """Seed of arenas, initial weights, actions and minibatches."""

    def __post_init__(self) -> None:
        """Raise an error for settings that are not allowed."""
        check_types(self)
        self._require_ranges()
        self._require_networks()
        self._require_actors()
        self._require_scenes()
        self._require_batch()

    def _require_ranges(self) -> None:
        """Check each setting on its own."""
        for name in ("episodes", "episode_steps", "num_envs", "rollout_steps", "ppo_epochs"):
            require_integer(name, getattr(self, name), 1)
        require_integer("seed", self.seed, 0)
        require(
            0 < self.clip_epsilon < 1, "clip_epsilon", self.clip_epsilon, "it must lie in (0, 1)"
        )
        for name in ("actor_lr", "critic_lr", "adam_eps"):
            require_positive(name, getattr(self, name))
        require(self.max_grad_norm > 0, "max_grad_norm", self.max_grad_norm, "it must be positive")
        require_not_negative("entropy_coeff", self.entropy_coeff)
        require_coverage("terminate_at_coverage", self.terminate_at_coverage)
        for name in ("gamma", "lmbda"):
            require_share(name, getattr(self, name))

    def _require_networks(self) -> None:
        """Check that the chosen actors and critic can read their inputs."""
        require_abilities(self.network, self.ablate)
        require(
            self.critic_input in self.network.critic_inputs,
            "critic_input",
            self.critic_input,
            f"with {self.network.name} actors the critic must read the state",
        )
        require(
            self.algorithm != "ippo" or self.critic_input == "observation",
            "critic_input",
            self.critic_input,
            "ippo's critics must read their own robot's observation",
        )

    def _require_actors(self) -> None:
        """Check that there are types of robots to have actors."""
        require(
            self.actors == "robot" or (self.algorithm == "happo" and len(self.arena.types) > 1),
            "actors",
            self.actors,
            "it needs algorithm='happo' and robots that differ",
        )
        require(
            self.update_order == "random" or self.algorithm == "happo",
            "update_order",
            self.update_order,
            "only happo updates its actors in an order",
        )

    def _require_scenes(self) -> None:
        """Check that the scenes can share an actor, and that the arenas can be shared out."""
        scenes = self.scenes
        require(len(set(scenes)) == len(scenes), "scenes", scenes, "each may appear only once")
        require(
            not scenes or (self.algorithm == "mappo" and self.network.chooses == "goals"),
            "scenes",
            scenes,
            "it needs algorithm='mappo' and a network that chooses among goals",
        )
        require(
            not scenes or self.num_envs % len(scenes) == 0,
            "num_envs",
            self.num_envs,
            f"the {len(scenes)} scenes need equal shares of the arenas",
        )
        self.scene_configs  # noqa: B018 - raises for a scene that cannot be

    @property
    def scene_configs(self) -> list[TrainConfig]:
        """The run as that of each scene with its share of the arenas."""
        if not self.scenes:
            return [self]
        share = self.num_envs // len(self.scenes)
        return [self._in_scene(scene, share) for scene in self.scenes]

    def _in_scene(self, scene: str, num_envs: int) -> TrainConfig:
        place, _, world = scene.partition("@")
        arenas, _, robots = place.rpartition("/")
        require(
            arenas != "" and robots.isdecimal() and int(robots) > 0,
            "scenes",
            scene,
            "it must be a kind of arenas and a number of robots, such as uniform/4 or uniform-16/4",
        )
        require(
            world.isdecimal() or "@" not in scene,
            "scenes",
            scene,
            "the number of a world must follow @, such as in uniform/4@7",
        )
        arena = replace(self.arena, num_agents=int(robots))
        kind, _, side = arenas.rpartition("-")
        if kind in ANY_SIZE and side.isdecimal():
            arenas, arena = kind, replace(arena, height=int(side), width=int(side))
        arena = arena if arenas in ANY_SIZE else fit(arena, arenas)
        own = arena.num_agents
        require(int(robots) == own, "scenes", scene, f"{arenas} has {own} robots of its own")
        if world:
            arena = random_world(int(world), arena)
            brings = arenas not in ANY_SIZE and fit(arena, arenas) != arena
            require(not brings, "scenes", scene, f"{arenas} has a world of its own")
        return replace(
            self,
            arena=arena,
            arenas=arenas,
            num_envs=num_envs,
            num_minibatches=1,
            scenes=(),
        )

    def _require_batch(self) -> None:
        """Check that a batch can be normalised and split, and that the run has at least one."""
        require(
            1 <= self.num_minibatches <= self.batch_frames,
            "num_minibatches",
            self.num_minibatches,
            f"it must be an integer from 1 to num_envs x rollout_steps = {self.batch_frames}",
        )
        require(
            self.batch_frames >= 2,
            "rollout_steps",
            self.rollout_steps,
            "num_envs x rollout_steps must be at least 2, to normalise advantages",
        )
        require(
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
        """Number of updates of the whole run."""
        return self.episodes * self.episode_steps // self.batch_frames
