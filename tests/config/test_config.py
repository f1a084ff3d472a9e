"""Settings: the paper's derived numbers, and what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace

import pytest

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.fields import read_fields
from marl_explore.config.shapes import SHAPES
from marl_explore.envs.exploration import ExplorationEnv
from marl_explore.policies.networks import DeepSet, Goals
from marl_explore.robot import RobotCore
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
        ({"sensing_range": (1.1, 2.0)}, r"sensing_range=\(1.1, 2.0\) .* num_agents=4"),
        ({"sensing_range": (1.1, 1.1, 0.9, 1.1)}, "sensing_range=.*0.9.* at least 1.061 m"),
        ({"sensing_range": (1.1, 1.1, -1.0, 1.1)}, "sensing_range=.* positive"),
        ({"sensing_range": 0.7, "sensing_shape": "disc"}, "sensing_range=0.7 .* at least 0.7072 m"),
        ({"sensing_range": math.inf}, "sensing_range=inf .* finite"),
        ({"sensing_range": 600.0}, "sensing_range=600.0 .* less than 1000 cells"),
        ({"sensing_shape": "cone"}, r"sensing_shape='cone' .* \['disc', 'square'\]"),
        ({"occlusion": True, "sensing_shape": "disc"}, "occlusion=True .* use line_of_sight"),
        (
            {"sensing_range": (1.1, 2.0, 2.0, math.nan)},
            "sensing_range=.*number, not NaN; or a list",
        ),
        ({"line_of_sight": 1}, "line_of_sight=1 .* true or false"),
        ({"communication_range": (3.2, 3.2, 3.2, -1.0)}, "communication_range=.* at least 0"),
        ({"communication_range": (3.2, 3.2)}, "communication_range=.* one entry per robot"),
        ({"communication_range": math.nan}, "communication_range=nan"),
        ({"wall_loss_db": -1.0}, "wall_loss_db=-1.0 .* at least 0"),
        ({"wall_loss_db": math.nan}, "wall_loss_db=nan"),
        ({"path_loss_exponent": 0.0}, "path_loss_exponent=0.0 .* positive"),
        ({"path_loss_exponent": math.inf}, "path_loss_exponent=inf .* finite"),
        ({"shadowing_db": math.inf}, "shadowing_db=inf .* finite"),
        ({"shadowing_db": -1.0}, "shadowing_db=-1.0 .* at least 0"),
        ({"message_loss": 1.5}, r"message_loss=1.5 .* \[0, 1\]"),
        ({"failure_rate": -0.1}, r"failure_rate=-0.1 .* \[0, 1\]"),
        ({"move_period": 0}, "move_period=0 .* at least 1"),
        ({"move_period": 1.5}, "move_period=1.5 .* integer"),
        ({"move_period": (1, 2, 0, 1)}, r"move_period=\(1, 2, 0, 1\) .* at least 1"),
        ({"move_period": (1, 2, True, 1)}, "move_period=.* integer"),
        ({"num_walkers": -1}, "num_walkers=-1 .* at least 0"),
        ({"num_walkers": 127}, "num_walkers=127 .* at most 130"),
        ({"num_walkers": 1.0}, "num_walkers=1.0 .* integer"),
    ],
)
def test_arenas_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ArenaConfig(**settings)


def test_settings_of_equal_robots_are_numbers():
    config = ArenaConfig(sensing_range=(2.0,) * 4, move_period=[2, 2, 2, 2])
    assert (config.sensing_range, config.move_period) == (2.0, 2)
    assert config == ArenaConfig(sensing_range=2.0, move_period=2)


def test_lists_become_tuples():
    config = ArenaConfig(sensing_range=[1.1, 2.0, 2.0, 4.0], communication_range=[1, 2, 3, 4])
    assert config.sensing_range == (1.1, 2.0, 2.0, 4.0)
    assert config.communication_cells == (2.0, 4.0, 6.0, 8.0)
    assert hash(config) == hash(replace(config))
    again = read_fields(ArenaConfig, json.loads(json.dumps(asdict(config))), "settings")
    assert again == config


def test_another_number_of_robots_beneath_a_tuple_is_refused():
    config = ArenaConfig(move_period=(1, 1, 2, 2))
    with pytest.raises(ValueError, match=r"move_period=\(1, 1, 2, 2\) .* num_agents=5"):
        replace(config, num_agents=5)


def test_occlusion_is_line_of_sight():
    assert ArenaConfig(occlusion=True) == ArenaConfig(line_of_sight=True)
    disc = {"sensing_shape": "disc", "sensing_range": 0.8}
    assert ArenaConfig(occlusion=True, **disc) == ArenaConfig(line_of_sight=True, **disc)


@pytest.mark.parametrize("shape", ["square", "disc"])
def test_the_shortest_range_that_an_error_names_is_allowed(shape):
    with pytest.raises(ValueError, match="it must be at least") as caught:
        ArenaConfig(sensing_shape=shape, sensing_range=0.1)
    shortest = float(str(caught.value).split("at least ")[1].split()[0])
    assert ArenaConfig(sensing_shape=shape, sensing_range=shortest).fov_radius == 1
    with pytest.raises(ValueError, match="sensing_range"):
        ArenaConfig(sensing_shape=shape, sensing_range=0.998 * shortest)


def test_a_shape_that_never_holds_3_x_3_cells_is_refused(monkeypatch):
    monkeypatch.setitem(SHAPES, "dot", lambda _: [1])
    with pytest.raises(ValueError, match="sensing_shape='dot' is not allowed: .* 3 x 3"):
        ArenaConfig(sensing_shape="dot")


def test_a_shape_may_be_replaced(monkeypatch):
    for width in (1, 2):
        monkeypatch.setitem(SHAPES, "mine", lambda _, width=width: [width] * (width + 1))
        assert ArenaConfig(sensing_shape="mine").fov_radius == width


def test_robots_take_the_papers_world_only():
    config = ArenaConfig(failure_rate=0.1)
    with pytest.raises(ValueError, match="failure_rate=0.1 is not allowed: .* for a robot"):
        RobotCore(0, config, None, None)


def test_robots_that_differ_have_a_window_and_a_most_of_their_own():
    config = ArenaConfig(sensing_range=(1.1, 1.8, 2.5, 2.5))
    assert (config.fov_radius, config.fov_size) == (3, 7)
    assert config.max_discovery == (5, 9, 13, 13)
    assert ArenaConfig().max_discovery == 5


def test_an_unknown_radio_is_refused():
    with pytest.raises(ValueError, match=r"radio='smoke' is not allowed: .*\['path-loss'\]"):
        ExplorationEnv(ArenaConfig(radio="smoke"))


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
