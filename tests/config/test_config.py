"""Settings: the paper's derived numbers, and what is refused."""

from __future__ import annotations

import math

import pytest

from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.networks import DeepSet, Goals
from marl_explore.training.config import TrainConfig


def test_the_papers_arena_has_37_actor_inputs_and_148_critic_inputs():
    config = ArenaConfig()
    assert config.observation_size == 37 == 9 + 24 + 4
    assert config.num_agents * config.observation_size == 148


def test_the_papers_arena_discovers_at_most_5_cells_per_move():
    assert ArenaConfig().max_discovery == 5


def test_the_papers_communication_range_is_6_4_cells():
    assert ArenaConfig().communication_cells == pytest.approx(6.4)


def test_the_papers_arena_has_14_obstacles():
    assert ArenaConfig().num_obstacles == 14  # Python's round(14.4)


@pytest.mark.parametrize(
    ("sensing_range", "cell_size", "radius"),
    [(1.1, 0.5, 1), (1.06066017178, 0.5, 1), (1.7, 0.5, 1), (1.8, 0.5, 2), (2.5, 0.5, 3)],
)
def test_fov_square_lies_inside_the_sensing_disc(sensing_range, cell_size, radius):
    config = ArenaConfig(sensing_range=sensing_range, cell_size=cell_size)
    assert config.fov_radius == radius
    corner = (radius + 0.5) * math.sqrt(2) * cell_size
    assert corner <= sensing_range + 1e-9 < corner + math.sqrt(2) * cell_size


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"height": 0}, "height=0 .* at least 1"),
        ({"width": 2.5}, "width=2.5 .* integer"),
        ({"num_agents": True}, "num_agents=True"),
        ({"obstacle_density": 1.0}, r"obstacle_density=1.0 .* \[0, 1\)"),
        ({"obstacle_density": math.nan}, "obstacle_density=nan"),
        ({"cell_size": 0.0}, "cell_size=0.0 .* positive"),
        ({"cell_size": math.inf}, "cell_size=inf"),
        ({"communication_range": -0.1}, "communication_range=-0.1 .* at least 0"),
        ({"sensing_range": 1.0}, "sensing_range=1.0 .* at least 1.061 m"),
        ({"sensing_range": 2.0, "occlusion": True}, "occlusion=True .* 3 x 3"),
        ({"height": 2, "width": 2, "num_agents": 5}, "num_agents=5 .* at most 4"),
        ({"obstacle_density": 0.99, "num_agents": 4}, "num_agents=4 .* at most 1"),
    ],
)
def test_arenas_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ArenaConfig(**settings)


def test_an_infinite_communication_range_is_allowed():
    assert ArenaConfig(communication_range=math.inf).communication_cells == math.inf


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episodes": 0}, "episodes=0"),
        ({"episodes": 1}, "episodes=1 .* one update takes 1600 steps"),
        ({"gamma": 1.1}, "gamma=1.1"),
        ({"lmbda": -0.1}, "lmbda=-0.1"),
        ({"num_minibatches": 1601}, "num_minibatches=1601 .* 1600"),
        ({"actor_lr": 0.0}, "actor_lr=0.0"),
        ({"entropy_coeff": -1.0}, "entropy_coeff=-1.0"),
        ({"seed": -1}, "seed=-1"),
        ({"num_envs": 1, "rollout_steps": 1}, "rollout_steps=1"),
        ({"critic_input": "everything"}, "critic_input='everything'"),
        ({"fpr": "max"}, "fpr='max'"),
        ({"terminate_at_coverage": 0.0}, "terminate_at_coverage=0.0"),
        (
            {"network": DeepSet(), "critic_input": "state", "ablate": ("net",)},
            r"ablate=\('net',\) .*deepset actors do not read net",
        ),
        (
            {"network": Goals(), "algorithm": "mappo", "ablate": ("communication",)},
            r"ablate=\('communication',\) .*goals actors .* cannot do without communication",
        ),
    ],
)
def test_runs_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        TrainConfig(**settings)
