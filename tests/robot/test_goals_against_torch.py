"""A robot that chooses among goals decides in numpy as in torch, over whole episodes."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from marl_explore import Caves, ExplorationEnv, Mazes, Rooms
from marl_explore.config.constants import FORBIDDEN_LOGIT, MAX_FRONTIERS, NUM_DIRECTIONS, STAY
from marl_explore.config.goals import COMPUTED, PLACE
from marl_explore.planners import goal_moves
from marl_explore.policies.export import export_npz, robot_observation
from marl_explore.robot import ExportedPolicy
from marl_explore.transforms.goals import Candidates, find_candidates
from marl_explore.transforms.memory import CROWDED, GOAL, MEMORY, RememberTeam
from tests.helpers.goal_policies import goal_policy

CLOSE = {"rtol": 1e-5, "atol": 1e-5}
MEMORIES = ("known_by", "covered", "waited", "stuck", "known", "stalled")
MEMORIES += ("position", "heading", "goal", "all_covered")
PLACES = [COMPUTED.index(name) for name in PLACE]


def assert_same_memory(memory, expected, robot):
    assert np.array_equal(memory.seen_step, expected["step"][0, robot])
    assert np.array_equal(memory.seen_cell, expected["cell"][0, robot])
    for name in MEMORIES:
        assert np.array_equal(getattr(memory, name), expected[name][0, robot]), (name, robot)


def assert_same_candidates(found, expected, robot):
    for name in ("frontiers", "rivals", "mates", "context"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)[0, robot]), name


def assert_same_features(ours, theirs, robot):
    """Those of choices that there are, and of teammates that were seen."""
    places = theirs.row == robot
    frontier = theirs.frontier[places]
    valid = theirs.valid[robot].nonzero().flatten()
    assert ours.choices == valid.tolist()
    close = {
        "frontier": (ours.frontier[PLACES].T, frontier),
        "context": (ours.context, theirs.context[robot]),
        "prior": (ours.prior, theirs.prior[robot, valid]),
    }
    if len(frontier):
        pair = theirs.pair[places][:, theirs.known_mate[places][0]]
        close["beside"] = ours.pairs.beside.transpose(2, 1, 0), pair[..., [4, 7, 5, 6]]
        close["about"] = ours.pairs.about.T, pair[0, :, :4]
    mates = valid[(valid >= MAX_FRONTIERS) & (valid < theirs.valid.shape[-1] - 2)]
    close["mate"] = ours.mate.T, theirs.mate[robot, mates - MAX_FRONTIERS]
    still = valid[valid >= theirs.valid.shape[-1] - 2] - theirs.valid.shape[-1] + 2
    close["still"] = ours.still.T, theirs.still[robot, still]
    for name, (own, expected) in close.items():
        np.testing.assert_allclose(own, expected, err_msg=name, **CLOSE)


class Comparison:
    """A team's episode, decided by torch; every robot decides in numpy beside it."""

    def __init__(self, policy, env, tmp_path):
        self.policy, self.env = policy, env
        path = export_npz(policy, tmp_path / "policy.npz")
        robots = range(env.config.num_agents)
        self.robots = [ExportedPolicy(path, robot, sample=False) for robot in robots]
        self.memory = RememberTeam(sight=env.config.sight)
        self.counts = Counter()

    def run(self, steps):
        now = self.env.reset()
        for _ in range(steps):
            action = self._decide(now)
            now = self.env.step(now.set(("agents", "action"), action))["next"].exclude("reward")
        return self.counts

    def _decide(self, now):
        """The actions in torch, int64 [1, N], with which every robot's are compared."""
        known = self.memory(now.clone())
        found = find_candidates(known, self.env.config.sight)
        memory = known[MEMORY].clone()
        for name, entry in found._asdict().items():
            known["agents", "observation", name] = entry
        rows = Candidates(*(entry.squeeze(0).float() for entry in found))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            features = self.policy.actors[0].encoder.features(rows)
            logits = self.policy.team.stacked(*(entry.unsqueeze(0) for entry in rows))[0]
            acted = self.policy.team(known)
        for robot, policy in enumerate(self.robots):
            seen = robot_observation(now, 0, robot)
            options = policy._goals.look(seen)
            assert_same_memory(policy._goals._episode.memory, memory, robot)
            assert_same_candidates(options.found, found, robot)
            assert_same_features(policy._goals.network.features(options.found), features, robot)
            self._compare(policy._goals, options, seen, logits[robot], acted)
        return acted["agents", "action"]

    def _compare(self, goals, options, seen, logits, acted):
        """Logits, choice and move of one robot."""
        np.testing.assert_allclose(options.logits, logits[options.choices], **CLOSE)
        assert (logits == FORBIDDEN_LOGIT).sum() == len(logits) - len(options.choices)
        ours = options.choices[int(options.logits.argmax())]
        choice = int(acted["agents", "choice"][0, goals.robot])
        if ours != choice:  # equal but for rounding
            np.testing.assert_allclose(logits[ours], logits[choice], **CLOSE)
            self.counts["ties"] += 1
        move = goals.go(options.found, choice)
        assert np.array_equal(goals._episode.memory.goal, acted[GOAL][0, goals.robot])
        crowded = goals._room.is_wanted(seen)
        assert crowded == acted[CROWDED][0, goals.robot]
        to_and_fro = goals.goes_to_and_fro(move)
        moves = torch.full(acted[CROWDED].shape, move)
        assert goal_moves.goes_to_and_fro(acted, moves)[0, goals.robot] == to_and_fro
        yields = seen.refused or to_and_fro
        blocked = move < NUM_DIRECTIONS and (yields or not seen.action_mask[move])
        blocked |= move == STAY and crowded
        if not blocked:
            assert move == acted["agents", "action"][0, goals.robot]
        kinds = ["place"] * MAX_FRONTIERS + ["mate"] * len(self.robots) + ["talk", "stay"]
        self.counts[kinds[choice]] += 1
        self.counts["yields"] += blocked
        self.counts["first"] += choice == 0


def compared(policy, arenas, num_agents, side, steps, tmp_path, first_arena=0):
    config = replace(policy.config.arena, num_agents=num_agents, height=side, width=side)
    arenas = arenas if isinstance(arenas, str) else arenas(config)
    env = ExplorationEnv(config, arenas=arenas, max_steps=steps + 1, first_arena=first_arena)
    return Comparison(policy, env, tmp_path).run(steps)


@pytest.mark.parametrize(
    ("arenas", "num_agents", "side", "options"),
    [
        ("uniform", 2, 12, {"prior": 8.0, "strength": 0.0}),
        ("uniform", 8, 12, {"communication_range": 1.5}),
        ("mixed", 4, 12, {"strength": 0.3}),
        (Mazes, 4, 24, {}),
        (Rooms, 8, 24, {"strength": 0.3}),
        (Caves, 2, 24, {"prior": -1.0}),
    ],
)
def test_episodes_are_those_of_torch(arenas, num_agents, side, options, tmp_path):
    policy = goal_policy(seed=side + num_agents, **options)
    counts = compared(policy, arenas, num_agents, side, 60, tmp_path)
    assert counts["place"] > 30
    assert counts["ties"] <= 2


def test_every_kind_of_choice_is_compared(tmp_path):
    """Robots run out of places, look for each other, and are in each other's way."""
    counts = Counter()
    for arena, arenas in enumerate((Mazes, "uniform")):
        policy = goal_policy(seed=arena, communication_range=1.5)
        counts += compared(policy, arenas, 6, 11, 50, tmp_path, arena)
    assert min(counts[kind] for kind in ("place", "mate", "talk", "stay", "yields")) >= 5
    assert counts["first"] < 0.7 * counts["place"]


def test_a_wide_field_of_view_and_an_actor_for_every_robot(tmp_path):
    policy = goal_policy(3, shared=False, sensing_range=2.0)
    assert policy.config.arena.fov_radius == 2
    counts = compared(policy, "mixed", 3, 16, 40, tmp_path)
    assert counts["place"] > 30


LIDAR = {"sensing_shape": "disc", "sensing_range": 3.5, "line_of_sight": True}
SCOUTS_AND_MAPPERS = {
    "sensing_range": (1.5, 1.5, 4.0, 4.0),
    "communication_range": (4.0, 4.0, 8.0, 8.0),
    "move_period": (1, 1, 2, 2),
}


@pytest.mark.parametrize(
    ("arenas", "options"),
    [
        ("uniform", {"sensing_shape": "disc", "sensing_range": 1.6}),
        (Rooms, {**LIDAR, "wall_loss_db": math.inf}),
        (Caves, {**LIDAR, "shared": False, "failure_rate": 0.01, "num_walkers": 3}),
        (Mazes, {"sensing_range": 1.8, "line_of_sight": True}),
        ("uniform", SCOUTS_AND_MAPPERS),
        (Rooms, {**LIDAR, **SCOUTS_AND_MAPPERS, "wall_loss_db": 6.0}),
        (Caves, {**LIDAR, **SCOUTS_AND_MAPPERS, "shared": False}),
        (Caves, {**LIDAR, **SCOUTS_AND_MAPPERS, "reads_sensor": True}),
    ],
)
def test_sensors_of_all_kinds(arenas, options, tmp_path):
    """Shapes, walls that end sight, and robots that differ."""
    policy = goal_policy(**options)
    counts = compared(policy, arenas, 4, 24, 40, tmp_path)
    assert counts["place"] > 30
    assert counts["ties"] <= 2
