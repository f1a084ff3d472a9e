"""Exported policies that choose among goals: files, memory, chance, and any team."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from marl_explore import ArenaConfig, ExplorationEnv
from marl_explore.cli import export
from marl_explore.config.constants import CONTEXT_COLUMNS, MATE_COLUMNS, MAX_FRONTIERS, STAY
from marl_explore.core import native
from marl_explore.core.mapping import target_cells
from marl_explore.policies.export import export_npz, robot_observation
from marl_explore.policies.io import save_policy
from marl_explore.robot import ExportedPolicy
from marl_explore.robot.candidates import Context
from marl_explore.robot.geometry import Frame
from marl_explore.robot.goal_features import _Mates
from marl_explore.robot.goals import uses_kernel
from marl_explore.robot.knowledge import Knowledge
from marl_explore.robot.observation import observe
from marl_explore.robot.policy import save_arrays
from marl_explore.ros2.parameters import RobotParameters, replaced
from tests.helpers.goal_policies import goal_policy
from tests.helpers.robot_world import PATIENT, World
from tests.robot.test_policy import arrays_of


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return export_npz(goal_policy(), tmp_path_factory.mktemp("goals") / "policy.npz")


def observations(robots=4, steps=6, robot=0, side=12):
    """What a robot of a team that acts at random observes, from the start of an episode."""
    torch.manual_seed(0)
    env = ExplorationEnv(ArenaConfig(side, side, num_agents=robots))
    history = env.rollout(steps)
    return [robot_observation(history[:, step], 0, robot) for step in range(steps)]


def actions(policy, seen):
    return [policy(one) for one in seen]


def test_columns_have_the_same_names():
    assert _Mates._fields == MATE_COLUMNS
    assert Context._fields == CONTEXT_COLUMNS


@pytest.mark.parametrize("robots", [1, 2, 16])
def test_a_shared_actor_decides_in_any_team(path, robots):
    seen = observations(robots, robot=robots - 1, side=15)
    policy = ExportedPolicy(path, robots - 1)
    assert policy.any_team
    for one in seen:
        assert one.action_mask[policy(one)]


def test_actors_of_their_own_are_for_their_team(tmp_path):
    path = export_npz(goal_policy(2, shared=False), tmp_path / "policy.npz")
    assert not ExportedPolicy(path, 1).any_team
    with pytest.raises(ValueError, match="robot=2 is not allowed: .* of 2"):
        ExportedPolicy(path, 2)
    with pytest.raises(ValueError, match="trained for num_agents=2, not 3"):
        ExportedPolicy(path, 1)(observations(3)[0])


def test_another_field_of_view_is_refused(tmp_path):
    path = export_npz(goal_policy(sensing_range=2.0), tmp_path / "policy.npz")
    with pytest.raises(ValueError, match="fov_radius=2, and the field of view is 3 x 3 cells"):
        ExportedPolicy(path, 0)(observations()[0])


def test_the_memory_is_reset(path):
    """By ``reset``, at step 0, when steps go back, and in other arenas or teams."""
    seen = observations(steps=8)
    policy = ExportedPolicy(path, 0, sample=False)

    def known():
        return int(policy._goals._episode.memory.known_by.sum())

    policy(seen[4])
    fresh = known()
    actions(policy, seen)
    assert known() > fresh
    policy(seen[4])
    assert known() == fresh
    actions(policy, seen[5:])
    policy.reset()
    policy(seen[4])
    assert known() == fresh
    policy(seen[0])
    begun = policy._goals._episode
    policy(seen[0])
    assert policy._goals._episode is not begun
    policy(observations(2)[5])
    assert len(policy._goals._episode.memory.known_by) == 2
    policy(observations(2, side=9)[5])
    assert policy._goals._episode.memory.covered.shape == (9, 9)


def test_copies_with_a_seed_have_memories_of_their_own(path):
    seen = observations()
    policy = ExportedPolicy(path, 0, sample=False)
    alone = actions(policy, seen)
    one, other = policy.with_seed(1), policy.with_seed(2)
    assert one._goals._episode is None
    for step, expected in zip(seen, alone, strict=True):
        assert one(step) == expected
        other(seen[0])


def test_choices_are_drawn_with_the_policys_probabilities(path):
    start = observations(8, steps=1)[0]
    policy = ExportedPolicy(path, 0, seed=3)
    options = policy._goals.look(start)
    moves = np.array([policy._goals.go(options.found, choice) for choice in options.choices])
    chances = np.exp(options.logits - options.logits.max())
    chances /= chances.sum()
    expected = 3000 * np.bincount(moves, chances, minlength=10)
    counts = np.bincount([policy(start) for _ in range(3000)], minlength=10)
    assert (expected > 30).sum() > 1
    assert (np.abs(counts - expected) <= 4 * np.sqrt(expected) + 1).all()
    again = [ExportedPolicy(path, 0, seed=3) for _ in range(2)]
    assert [again[0](start) for _ in range(20)] == [again[1](start) for _ in range(20)]


def test_a_robot_yields_after_a_refused_move(path):
    start = observations()[0]
    policy = ExportedPolicy(path, 0, sample=False)
    assert len({policy(start) for _ in range(30)}) == 1
    yielding = {policy(start._replace(refused=True)) for _ in range(200)}
    assert yielding == set(start.action_mask[: STAY + 1].nonzero()[0].tolist())


def test_a_move_that_is_not_allowed_is_not_made(path):
    start = observations()[0]
    policy = ExportedPolicy(path, 0, sample=False)
    mask = np.zeros_like(start.action_mask)
    mask[[2, STAY]] = True
    assert {policy(start._replace(action_mask=mask)) for _ in range(50)} <= {2, STAY}


def test_robots_with_wheels_explore_and_give_each_other_their_maps(path):
    """Four of them, without torch: their maps are whole, and none of them touches another."""
    config = ArenaConfig(8, 8, num_agents=3, occlusion=True)
    start = ExplorationEnv(config, stream="test").reset()
    obstacles, cells = start["obstacles"][0], start["agents", "position"][0]
    policies = [ExportedPolicy(path, robot, sample=False) for robot in range(3)]
    world = World(config, obstacles.numpy(), cells.tolist(), policies, settings=PATIENT)
    world.run(45)
    target = target_cells(obstacles.unsqueeze(0), cells.unsqueeze(0))[0].numpy()
    whole = [(core.knowledge.map >= 0)[target].all() for core in world.cores]
    assert all(whole)
    for core in world.cores:
        memory = core.policy._goals._episode.memory
        assert memory.position.tolist() == list(core.observation.position)
        assert (memory.seen_step > 0).sum() == 2


# ---------------------------------------------------------------- files


def changed(path, folder, spec=None, arrays=None):
    """The file with other entries of its spec and other arrays; None: without them."""
    told, old = arrays_of(path)
    new = {name: array for name, array in (old | (arrays or {})).items() if array is not None}
    to = folder / "changed.npz"
    with to.open("wb") as file:
        save_arrays(file, json.dumps(json.loads(told) | (spec or {})), new)
    return to


OPTIONS = {
    "code_width": 48,
    "pair_width": 16,
    "refinement": 4.0,
    "communicate_every": 3,
    "communicate_after": 4,
    "home_cells": 144,
}


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ({"options": None}, "options=None is not allowed"),
        ({"options": {}}, "code_width"),
        ({"options": OPTIONS | {"communicate_every": 0}}, "communicate_every=0 is not allowed"),
        ({"options": OPTIONS | {"communicate_after": "4"}}, "communicate_after='4'"),
        ({"options": OPTIONS | {"refinement": 0.0}}, "refinement=0.0 is not allowed"),
        ({"options": OPTIONS | {"refinement": "4"}}, "refinement='4' is not allowed"),
        ({"options": OPTIONS | {"reads_sensor": 1}}, "reads_sensor=1 is not allowed"),
        (
            {"options": OPTIONS | {"reads_sensor": True}},
            r"of shape \(48, 60\) must have \(48, 62\)",
        ),
        ({"options": OPTIONS | {"code_width": 32}}, r"of shape \(48, 60\) must have \(32, 60\)"),
        ({"ablate": ["communication"]}, "ablate=.* is not allowed"),
        ({"shared": False}, "robot 1 does not fit its spec"),
    ],
)
def test_a_spec_that_does_not_fit_is_refused(path, tmp_path, spec, message):
    with pytest.raises(ValueError, match=f"changed.npz is not an exported policy: .*{message}"):
        ExportedPolicy(changed(path, tmp_path, spec), 1)


ONES = np.ones((48, 48), np.float32)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"0.encoder.code.0.weight": None}, r"encoder.code.0.weight of shape None .* \(48, 48\)"),
        ({"0.encoder.code.0.weight": ONES[:1]}, r"of shape \(1, 48\) must have \(48, 48\)"),
        ({"0.encoder.code.0.weight": np.nan * ONES}, "encoder.code.0.weight must be finite"),
        ({"0.encoder.code.0.weight": ONES.astype(str)}, "encoder.code.0.weight"),
        ({"0.prior": ONES[0]}, r"prior of shape \(48,\) must have \(\)"),
        ({"0.encoder.features.weights": ONES[0]}, r"features.weights of shape \(48,\)"),
        ({"0.encoder.features.weights": np.zeros(22, np.float32)}, "rival_scale"),
        ({"0.more": ONES}, "more, which is not known"),
    ],
)
def test_weights_that_do_not_fit_are_refused(path, tmp_path, arrays, message):
    with pytest.raises(ValueError, match=f"changed.npz is not an exported policy: .*{message}"):
        ExportedPolicy(changed(path, tmp_path, arrays=arrays), 0)


def test_a_damaged_file_is_refused(path, tmp_path):
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (tmp_path / "damaged.npz").write_bytes(damaged)
    with pytest.raises(ValueError, match="damaged.npz is not an exported policy"):
        ExportedPolicy(tmp_path / "damaged.npz", 0)


def test_there_are_no_logits_of_actions(path):
    start = observations()[0]
    with pytest.raises(ValueError, match="chooses among goals"):
        ExportedPolicy(path, 0).masked_logits(*start[:4])


def test_without_the_kernel_it_does_the_same(path, monkeypatch):
    seen = observations(steps=30)
    expected = actions(ExportedPolicy(path, 0), seen)
    monkeypatch.setattr(native, "_load", lambda name: OSError("no compiler"))
    assert not uses_kernel()
    assert actions(ExportedPolicy(path, 0), seen) == expected


def test_the_command_writes_what_there_can_be(tmp_path):
    policy = save_policy(goal_policy(), tmp_path / "team.safetensors")
    export.run(export.parse([str(policy), "--kinds", "npz", "--out", str(tmp_path / "out")]))
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [
        "export.json",
        "policy.npz",
    ]
    assert ExportedPolicy(tmp_path / "out" / "policy.npz", 5).any_team


def test_a_ros_team_may_have_any_size(path):
    team = [f"robot_{number}" for number in range(6)]
    core = replaced(RobotParameters(), {"policy": str(path), "team": team, "robot": 5}).make_core()
    assert (core.robot, core.config.num_agents) == (5, 6)


def test_a_teammate_measured_outside_is_at_the_border():
    knowledge = Knowledge(0, 3, Frame(12, 12, 0.5))
    cells = {0: (0, 2), 1: (-1, 3), 2: (11, 11)}
    seen = observe(knowledge, cells, ArenaConfig(num_agents=3), None, step=7)
    assert (seen.mates, seen.step, seen.refused) == ({1: (0, 3)}, 7, False)


def test_there_are_always_choices(path):
    """Also alone, with everything known, and with nothing allowed."""
    start = observations(1)[0]
    done = start._replace(map=np.zeros_like(start.map))
    policy = ExportedPolicy(path, 0, sample=False)
    assert policy._goals.look(done).choices == [MAX_FRONTIERS + 2]
    assert policy(done) == STAY
