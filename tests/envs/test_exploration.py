"""The environment: specs, resets, reproducible arenas, given states, masks."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torchrl.envs import check_env_specs

from marl_explore import ArenaConfig, ExplorationEnv, make_env
from marl_explore.core import mapping
from marl_explore.core.grid import COMMUNICATE, STAY
from marl_explore.core.world import NEVER
from tests.helpers import oracle
from tests.helpers.boards import arena

STATE_KEYS = [
    "obstacles",
    "step_count",
    ("agents", "map"),
    ("agents", "position"),
    ("agents", "unshared"),
    ("agents", "steps_since_merge"),
]


def act(td, action):
    return td.set(
        ("agents", "action"), torch.as_tensor(action).expand(td["agents", "merged"].shape)
    )


def given(*boards):
    """A reset TensorDict of hand-drawn arenas."""
    from tensordict import TensorDict

    obstacles, positions = zip(*(arena(board) for board in boards), strict=True)
    td = TensorDict({"obstacles": torch.stack(obstacles)}, batch_size=[len(boards)])
    return td.set(("agents", "position"), torch.stack(positions))


# ------------------------------------------------------------------------ specs


@pytest.mark.parametrize("make", [ExplorationEnv, make_env], ids=["env", "with transforms"])
@pytest.mark.parametrize("num_envs", [1, 8, 512])
def test_specs_of_the_papers_arena(make, num_envs):
    check_env_specs(make(num_envs=num_envs))


@pytest.mark.parametrize("make", [ExplorationEnv, make_env], ids=["env", "with transforms"])
@pytest.mark.parametrize("robots", range(1, 9))
@pytest.mark.parametrize("size", [(10, 10), (6, 17)], ids=["square", "oblong"])
def test_specs_of_other_teams_and_arenas(make, robots, size):
    config = ArenaConfig(height=size[0], width=size[1], num_agents=robots, sensing_range=1.8)
    check_env_specs(make(config, num_envs=3, max_steps=4))


def test_entries_are_those_of_the_design():
    td = make_env(num_envs=2).rollout(1)[:, 0]
    shapes = {
        "obstacles": (2, 12, 12),
        "step_count": (2, 1),
        ("agents", "map"): (2, 4, 12, 12),
        ("agents", "position"): (2, 4, 2),
        ("agents", "action_mask"): (2, 4, 10),
        ("agents", "action"): (2, 4),
        ("agents", "unshared"): (2, 4, 4),
        ("agents", "steps_since_merge"): (2, 4, 4),
        ("agents", "observation", "fov"): (2, 4, 3, 3),
        ("agents", "observation", "fpr"): (2, 4, 8, 3),
        ("agents", "observation", "net"): (2, 4, 4),
        ("agents", "dangerous"): (2, 4),
        ("agents", "merged"): (2, 4),
        ("agents", "discovered"): (2, 4),
        ("agents", "received"): (2, 4),
        ("agents", "individual_reward"): (2, 4, 1),
        ("next", "reward"): (2, 1),
        ("next", "done"): (2, 1),
        ("next", "terminated"): (2, 1),
        ("next", "truncated"): (2, 1),
    }
    assert {key: tuple(td[key].shape) for key in shapes} == shapes


def test_the_team_reward_is_the_mean_of_the_robots_rewards():
    td = ExplorationEnv(num_envs=16, reward="case2").rollout(30)
    own = td["next", "agents", "individual_reward"]
    torch.testing.assert_close(td["next", "reward"], own.mean(-2))


def test_a_callable_reward_is_used():
    env = ExplorationEnv(num_envs=3, reward=lambda step: step.known.float())
    td = env.rollout(5)
    known = mapping.known_cells(mapping.known_mask(td["next", "agents", "map"])).float()
    torch.testing.assert_close(td["next", "agents", "individual_reward"].squeeze(-1), known)


# ------------------------------------------------------------- reproducible arenas


def starts(env, episodes=2):
    """Obstacles and positions of the first episodes."""
    drawn = [env.reset().select("obstacles", ("agents", "position")) for _ in range(episodes)]
    return torch.stack(drawn, 1)


def test_an_arena_is_the_same_for_any_batch_size():
    small, large = starts(ExplorationEnv(num_envs=3)), starts(ExplorationEnv(num_envs=17))
    assert (small == large[:3]).all()


def test_first_arena_continues_the_numbering():
    whole = starts(ExplorationEnv(num_envs=8))
    parts = [starts(ExplorationEnv(num_envs=4, first_arena=first)) for first in (0, 4)]
    assert (torch.cat(parts) == whole).all()


@pytest.mark.parametrize("change", [{"seed": 1}, {"stream": "test"}, {"first_arena": 1}])
def test_seed_stream_and_index_change_the_arena(change):
    one, other = starts(ExplorationEnv()), starts(ExplorationEnv(**change))
    assert not torch.equal(one["obstacles"], other["obstacles"])


def test_every_reset_draws_the_next_episode():
    drawn = starts(ExplorationEnv(num_envs=1), episodes=5)["obstacles"]
    assert len({tuple(o.flatten().tolist()) for o in drawn[0]}) == 5


def test_set_seed_starts_the_numbering_again():
    env = ExplorationEnv(num_envs=2, seed=3)
    first = starts(env)
    env.set_seed(3)
    assert (starts(env) == first).all()


def test_an_arena_does_not_depend_on_when_others_reset():
    env = ExplorationEnv(num_envs=3, max_steps=50)
    expected = starts(ExplorationEnv(num_envs=3), episodes=3)
    td = env.reset()
    for episode, row in ((1, 2), (2, 2), (1, 0)):
        td.set("_reset", torch.arange(3).unsqueeze(-1) == row)
        td = env.reset(td, set_state=False)
        assert torch.equal(td["obstacles"][row], expected[row, episode]["obstacles"])


# --------------------------------------------------------------- resets and ends


def test_a_partial_reset_leaves_the_other_arenas_alone():
    env = make_env(num_envs=4)
    td = env.rollout(3)[:, -1]["next"]
    before = td.clone()
    td.set("_reset", torch.tensor([[True], [False], [True], [False]]))
    after = env.reset(td, set_state=False)
    for key in [*STATE_KEYS, ("agents", "observation", "fpr"), ("agents", "action_mask")]:
        assert torch.equal(after[key][1::2], before[key][1::2])
    assert (after["step_count"].squeeze(-1) == torch.tensor([0, 3, 0, 3])).all()
    stepped = env.rand_step(after)["next"]
    assert (stepped["step_count"].squeeze(-1) == torch.tensor([1, 4, 1, 4])).all()


def test_tensors_handed_out_are_never_written_to():
    env = make_env(num_envs=4, max_steps=6)
    td, kept = env.reset(), []
    for _ in range(15):
        td = env.rand_action(td)
        stepped, td = env.step_and_maybe_reset(td)
        kept.append((stepped, stepped.clone()))
    for seen, as_it_was in kept:
        assert (seen == as_it_was).all()


def test_episodes_are_truncated_at_max_steps_and_go_on_with_the_next_arena():
    td = ExplorationEnv(num_envs=2, max_steps=5).rollout(12, break_when_any_done=False)
    assert td["next", "truncated"].squeeze(-1)[0].tolist() == [(t + 1) % 5 == 0 for t in range(12)]
    assert not td["next", "terminated"].any()
    assert td["step_count"].squeeze(-1)[0].tolist() == [t % 5 for t in range(12)]
    assert not torch.equal(td["obstacles"][:, 0], td["obstacles"][:, 5])


@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
def test_episodes_terminate_when_the_largest_map_covers_the_share(share):
    config = ArenaConfig(height=7, width=7)
    env = ExplorationEnv(config, num_envs=16, terminate_at_coverage=share, max_steps=400)
    td = env.rollout(150, break_when_any_done=False)
    assert td["next", "terminated"].any()
    for episode in td:
        target = None
        for step in episode:
            if target is None or step["step_count"] == 0:
                target = mapping.target_cells(step["obstacles"], step["agents", "position"])
            known = mapping.known_mask(step["next", "agents", "map"])
            known = mapping.known_targets(known, target).max()
            assert bool(step["next", "terminated"]) == (known >= share * target.sum() - 1e-9)


def test_terminated_and_truncated_may_come_together():
    env = ExplorationEnv(ArenaConfig(height=3, width=3), terminate_at_coverage=1.0, max_steps=1)
    td = env.rollout(1)
    assert td["next", "terminated"].all()
    assert td["next", "truncated"].all()


def test_an_arena_known_at_reset_is_not_done_yet():
    env = ExplorationEnv(ArenaConfig(height=2, width=2, num_agents=1), terminate_at_coverage=1.0)
    assert not env.reset()["done"].any()


# ------------------------------------------------------------------ given states


BOARD = """
    0.#...
    ..#.1.
    ......
"""


def test_given_starts_are_used_and_sensed_once():
    env = ExplorationEnv(ArenaConfig(height=3, width=6, num_agents=2), num_envs=1)
    td = env.reset(given(BOARD), set_state=True)
    rules = oracle.Rules(height=3, width=6, num_agents=2)
    obstacles, positions = arena(BOARD)
    state = oracle.reset(rules, obstacles.tolist(), positions.tolist())
    assert td["agents", "map"][0].tolist() == state.maps
    assert td["agents", "unshared"][0].tolist() == state.unshared
    assert td["agents", "discovered"][0].tolist() == [4, 9]
    assert (td["agents", "steps_since_merge"][0] == NEVER * (1 - torch.eye(2))).all()


def test_an_unconnected_start_is_allowed_and_its_targets_are_what_can_be_reached():
    env = ExplorationEnv(
        ArenaConfig(height=3, width=5, num_agents=1), num_envs=1, terminate_at_coverage=1.0
    )
    td = env.reset(given("0.#..\n..#..\n..#.."), set_state=True)
    for direction in (4, 2):  # S, E: from there it sees all of its side
        td = env.step(act(td, direction))["next"]
    assert td["terminated"].all()


def test_later_auto_resets_draw_fresh_arenas():
    env = ExplorationEnv(ArenaConfig(height=3, width=6, num_agents=2), num_envs=1, max_steps=2)
    td = env.reset(given(BOARD), set_state=True)
    rollout = env.rollout(4, auto_reset=False, tensordict=td, break_when_any_done=False)
    drawn = env.reset()
    assert torch.equal(rollout["obstacles"][0, 0], rollout["obstacles"][0, 1])
    assert not torch.equal(rollout["obstacles"][0, 2], rollout["obstacles"][0, 0])
    assert not torch.equal(rollout["obstacles"][0, 2], drawn["obstacles"][0])


@pytest.mark.parametrize("transformed", [False, True])
def test_an_episode_goes_on_from_its_whole_state(transformed):
    make = make_env if transformed else ExplorationEnv
    env, other = make(num_envs=5, seed=1), make(num_envs=5, seed=2)
    rollout = env.rollout(20)
    middle = rollout[:, 10]
    td = other.reset(middle.select(*STATE_KEYS), set_state=True)
    for t in range(10, 20):
        expected = rollout[:, t]
        for key in STATE_KEYS:
            assert torch.equal(td[key], expected[key])
        td = other.step(td.set(("agents", "action"), expected["agents", "action"]))
        assert torch.equal(td["next", "reward"], expected["next", "reward"])
        td = td["next"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda td: td.exclude("obstacles"), "missing.*obstacles"),
        (lambda td: td.exclude(("agents", "position")), "missing.*position"),
        (lambda td: td.set("obstacles", td["obstacles"].int()), "obstacles.*torch.bool.*int32"),
        (lambda td: td.set("obstacles", td["obstacles"][:, :2]), r"obstacles.*\(1, 3, 6\)"),
        (
            lambda td: td.set(("agents", "position"), td["agents", "position"].float()),
            "position.*int64.*float32",
        ),
        (
            lambda td: td.set(("agents", "position"), torch.tensor([[[0, 0], [0, 0]]])),
            r"robot 0 in arena 0: cell \(0, 0\) holds more than one robot",
        ),
        (
            lambda td: td.set(("agents", "position"), torch.tensor([[[0, 0], [3, 0]]])),
            r"robot 1 in arena 0: cell \(3, 0\) is outside the arena of 3 x 6",
        ),
        (
            lambda td: td.set(("agents", "position"), torch.tensor([[[-1, 0], [2, 0]]])),
            r"robot 0 .* \(-1, 0\) is outside",
        ),
        (
            lambda td: td.set(("agents", "position"), torch.tensor([[[0, 0], [0, 2]]])),
            r"robot 1 in arena 0: cell \(0, 2\) is an obstacle",
        ),
    ],
)
def test_given_starts_that_cannot_be_are_refused(change, message):
    env = ExplorationEnv(ArenaConfig(height=3, width=6, num_agents=2), num_envs=1)
    before = env.reset()
    with pytest.raises(ValueError, match=message):
        env.reset(change(given(BOARD)), set_state=True)
    assert torch.equal(env.rand_step(before)["next", "obstacles"], before["obstacles"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda td: td.exclude("step_count"), "missing: .*step_count"),
        (lambda td: td.exclude(("agents", "unshared")), "missing: .*unshared"),
        (
            lambda td: td.set("obstacles", torch.arange(18).view(1, 3, 6) == 1),
            r"map of robot 0 in arena 0: cell \(0, 1\) contradicts the obstacles",
        ),
        (
            lambda td: td.set(("agents", "map"), torch.full_like(td["agents", "map"], -1)),
            r"map of robot 0 in arena 0: cell \(0, 0\) holds the robot but is unknown",
        ),
    ],
)
def test_episodes_under_way_that_cannot_be_are_refused(change, message):
    env = ExplorationEnv(ArenaConfig(height=3, width=6, num_agents=2), num_envs=1)
    underway = env.reset(given(BOARD), set_state=True).select(*STATE_KEYS)
    with pytest.raises(ValueError, match=message):
        env.reset(change(underway), set_state=True)


def test_a_state_must_be_given_to_be_set():
    with pytest.raises(ValueError, match="needs"):
        ExplorationEnv().reset(set_state=True)


# ------------------------------------------------------------------- state_dict


def test_state_dict_restores_everything():
    env = ExplorationEnv(num_envs=3, max_steps=7, seed=5)
    env.rollout(10, break_when_any_done=False)
    saved = pickle.loads(pickle.dumps(env.state_dict()))
    other = ExplorationEnv(num_envs=3, max_steps=7, seed=0)
    other.load_state_dict(saved)
    torch.manual_seed(0)
    td = env.rand_action()
    one = env.rollout(
        12, auto_reset=False, tensordict=env.step(td)["next"], break_when_any_done=False
    )
    torch.manual_seed(0)
    restored = other.reset()
    two = other.rollout(
        12,
        auto_reset=False,
        tensordict=other.step(restored.update(other.rand_action()))["next"],
        break_when_any_done=False,
    )
    assert (one == two).all()


def test_a_restored_state_is_returned_by_the_next_reset_only():
    env = ExplorationEnv(num_envs=2)
    env.rollout(3)
    saved = env.state_dict()
    env.load_state_dict(saved)
    assert (env.reset()["step_count"] == 3).all()
    assert (env.reset()["step_count"] == 0).all()
    env.load_state_dict(saved)
    env.step(env.rand_action())
    assert (env.reset()["step_count"] == 0).all()
    env.load_state_dict(saved)
    env.set_seed(5)
    assert (env.reset()["step_count"] == 0).all()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_environments_can_be_copied_and_pickled(copied):
    env = make_env(num_envs=2)
    env.rollout(3)
    other = copied(env)
    assert (other.reset() == env.reset()).all()


def test_a_refused_state_changes_nothing():
    env = ExplorationEnv(ArenaConfig(height=6, width=6), num_envs=2, seed=5)
    env.rollout(2)
    before = env.state_dict()
    other = ExplorationEnv(num_envs=2)
    other.rollout(3)
    broken = {**before, "known": before["known"][:1]}
    for state, name in ((other.state_dict(), "obstacles"), (broken, "known")):
        with pytest.raises(ValueError, match=f"state_dict: '{name}' must be"):
            env.load_state_dict(state)
    after = env.state_dict()
    assert after["seed"] == 5
    assert all(after[name] is before[name] for name in before if name != "seed")


def test_a_state_before_the_first_reset_can_be_loaded():
    fresh = ExplorationEnv(num_envs=2).state_dict()
    env = ExplorationEnv(num_envs=2)
    env.rollout(3)
    env.load_state_dict(env.state_dict())
    env.load_state_dict(fresh)
    assert (env.reset() == ExplorationEnv(num_envs=2).reset()).all()


@pytest.mark.parametrize("make", [ExplorationEnv, make_env], ids=["env", "with transforms"])
def test_a_reset_of_no_arena_changes_nothing(make):
    env = make(num_envs=2)
    td = env.rollout(3)[:, -1]["next"]
    before = td.clone()
    td.set("_reset", torch.zeros(2, 1, dtype=torch.bool))
    assert (env.reset(td, set_state=False) == before).all()


def test_a_foreign_state_dict_is_refused():
    env = ExplorationEnv(num_envs=3)
    with pytest.raises(ValueError, match="state_dict holds"):
        env.load_state_dict({"weights": torch.zeros(3)})
    with pytest.raises(ValueError, match="state_dict is of 4 arenas, this environment has 3"):
        env.load_state_dict(ExplorationEnv(num_envs=4).state_dict())


# ------------------------------------------------------------------------- masks


@pytest.mark.parametrize("make", [ExplorationEnv, make_env], ids=["env", "with transforms"])
def test_random_actions_obey_the_mask_and_use_all_of_it(make):
    td = make(num_envs=64).rollout(20)
    mask, action = td["agents", "action_mask"], td["agents", "action"]
    assert mask.gather(-1, action.unsqueeze(-1)).all()
    taken = torch.nn.functional.one_hot(action, 10).flatten(0, -2).sum(0)
    allowed = mask.flatten(0, -2).sum(0)
    assert (taken > 0).all()
    assert not mask.all(-1).any() or (taken < allowed).all()


def test_masked_actions_have_their_effect_and_do_not_crash():
    env = ExplorationEnv(ArenaConfig(height=3, width=6, num_agents=2), num_envs=1)
    td = env.reset(given(BOARD), set_state=True)
    for action in range(10):
        td = env.step(act(td, action))["next"]
        assert td["agents", "dangerous"].shape == (1, 2)
    td = env.step(act(env.reset(given(BOARD), set_state=True), 0))["next"]
    assert td["agents", "dangerous"][0].tolist() == [True, False]


def test_merging_is_reported_to_the_robots_in_the_network():
    env = ExplorationEnv(ArenaConfig(height=3, width=6, num_agents=2), num_envs=1)
    td = env.step(act(env.reset(given(BOARD), set_state=True), [COMMUNICATE, COMMUNICATE]))["next"]
    assert td["agents", "merged"].all()
    assert td["agents", "received"][0].tolist() == [9, 4]
    assert (td["agents", "steps_since_merge"] == 0).all()
    td = env.step(act(td, [COMMUNICATE, STAY]))["next"]
    assert not td["agents", "merged"].any()


# --------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 0}, "num_envs=0"),
        ({"max_steps": 0}, "max_steps=0"),
        ({"first_arena": -1}, "first_arena=-1"),
        ({"terminate_at_coverage": 1.5}, "terminate_at_coverage=1.5"),
        ({"reward": "case3"}, "reward='case3' is unknown.*case2-lone-idle"),
        ({"arenas": "caves"}, "arenas='caves' is not a suite.*uniform"),
        ({"seed": 1.5}, "seed=1.5"),
        ({"stream": 3}, "stream=3"),
    ],
)
def test_arguments_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        ExplorationEnv(**settings)


@pytest.mark.parametrize(
    "reward", [lambda step: step.gain, lambda step: step.gain.float().mean(-1)], ids=["int", "[B]"]
)
def test_a_reward_of_another_kind_is_refused(reward):
    env = ExplorationEnv(num_envs=2, reward=reward)
    with pytest.raises(ValueError, match=r"reward must return a float tensor of shape \(2, 4\)"):
        env.rollout(1)


@pytest.mark.parametrize(
    ("drawn", "message"),
    [
        ((torch.zeros(1, 5, 5).bool(), torch.zeros(1, 4, 2).long()), r"obstacles .*\(1, 12, 12\)"),
        ((torch.zeros(1, 12, 12), torch.zeros(1, 4, 2).long()), "obstacles torch.bool"),
        ((torch.zeros(1, 12, 12).bool(), torch.zeros(1, 3, 2).long()), r"positions .*\(1, 4, 2\)"),
        ((torch.zeros(1, 12, 12).bool(), torch.zeros(1, 4, 2).long()), "more than one robot"),
    ],
)
def test_generators_that_draw_no_arenas_are_refused(drawn, message):
    env = ExplorationEnv(arenas=lambda seed, arenas, episodes: drawn)
    with pytest.raises(ValueError, match=message):
        env.reset()


def test_a_generator_is_given_arena_and_episode_numbers():
    asked = []

    def generate(seed, arenas, episodes):
        asked.append((arenas.tolist(), episodes.tolist()))
        positions = torch.tensor([[[0, 0], [0, 1], [0, 2], [0, 3]]]).expand(len(arenas), 4, 2)
        return torch.zeros(len(arenas), 12, 12, dtype=torch.bool), positions

    env = ExplorationEnv(arenas=generate, num_envs=2, first_arena=5, max_steps=3)
    env.rollout(4, break_when_any_done=False)
    assert asked == [([5, 6], [0, 0]), ([5, 6], [1, 1])]


def test_stepping_before_reset_says_so():
    env = ExplorationEnv(num_envs=2)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(env.rand_action())
