"""Memory and candidate goals in TensorDicts: on environments, in policies, in collectors."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ParallelEnv, RewardSum, check_env_specs, step_mdp

from marl_explore import ArenaConfig, ExplorationEnv, make_env
from marl_explore.config.constants import CONTEXT_COLUMNS
from marl_explore.core import native
from marl_explore.core.memory import blank_memory, remember
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.training.collectors import ResumableCollector
from marl_explore.transforms.goals import Candidates, GoalCandidates, find_candidates
from marl_explore.transforms.memory import (
    ALL_COVERED,
    GOAL,
    MEMORY,
    REFUSED,
    RememberTeam,
    from_tensordict,
    observation_of,
    to_tensordict,
)
from tests.helpers.configs import NETWORKS

WIDE = ArenaConfig(
    10,
    11,
    num_agents=4,
    sensing_range=(0.8, 1.5, 3.0, 3.0),
    sensing_shape="disc",
    line_of_sight=True,
    communication_range=(2.0, 2.0, 4.0, 4.0),
    wall_loss_db=6.0,
    shadowing_db=4.0,
    message_loss=0.2,
    move_period=(1, 1, 2, 2),
    failure_rate=0.02,
    num_walkers=3,
)
FEATURES = ("fov", *Candidates._fields)
ARENA = ArenaConfig(height=7, width=8, num_agents=3, communication_range=1.6)


def goal_env(num_envs=4, config=ARENA, **task):
    return make_env(config, num_envs=num_envs, features=FEATURES, **task)


def a_policy(config=ARENA, shared=True):
    torch.manual_seed(0)
    spec = PolicyConfig(config, NETWORKS["goals"], shared=shared)
    return Policy(spec, spec.make_actors())


def same(one, two):
    """Whether two groups have the same entries."""
    assert set(one.keys()) == set(two.keys())
    return all(torch.equal(one[key], two[key]) for key in set(one.keys()))


@pytest.mark.parametrize(
    "config", [ArenaConfig(height=6, width=7), ArenaConfig(6, 7, num_agents=1), WIDE]
)
def test_environments_with_memory_keep_torchrls_contract(config):
    check_env_specs(goal_env(2, config, max_steps=5))


def test_on_an_environment_memory_is_that_of_each_episode():
    """Episodes of 6 steps that follow each other: every row as by ``core.memory``."""
    env = goal_env(max_steps=6)
    history = env.rollout(20, a_policy(), break_when_any_done=False)
    memory = None
    for step in history.unbind(1):
        observed = observation_of(step)
        begun = step["step_count"].squeeze(-1) == 0
        if begun.all():
            before = blank_memory(observed.grid, observed.position)
            covered = torch.zeros_like(before.stuck, dtype=torch.bool)
        else:
            assert not begun.any()
            before, covered = from_tensordict(memory), memory["all_covered"]
        expected = to_tensordict(
            remember(before, observed, covered, ARENA.sight),
            step[ALL_COVERED],
            step["agents", "dangerous"],
            torch.zeros_like(covered),  # robots beside each other are linked
        )
        now = step[MEMORY]
        assert same(now.exclude("goal"), expected.exclude("goal"))  # a policy has set the goal
        memory = now
    assert history["next", "done"].sum() == 3 * 4
    assert history[MEMORY]["known_by"].any()
    assert (history[GOAL] >= 0).any()


def test_a_policy_writes_the_goal_that_the_next_memory_holds():
    env = goal_env()
    acted = a_policy()(env.reset())
    assert (acted[GOAL] >= 0).any()
    assert step_mdp(env.step(acted))[GOAL].equal(acted[GOAL])


@pytest.mark.parametrize("shared", [True, False])
def test_a_policy_remembers_by_itself_what_an_environment_would(shared):
    """The same actions, over episodes that end at different times."""
    task = {"max_steps": 25, "terminate_at_coverage": 0.9}
    with_memory, bare = goal_env(**task), ExplorationEnv(ARENA, num_envs=4, **task)
    policy, other = a_policy(shared=shared), a_policy(shared=shared)
    one, two = with_memory.reset(), bare.reset()
    for seed in range(60):
        torch.manual_seed(seed)
        one = policy(one)
        torch.manual_seed(seed)
        two = other(two)
        assert two["agents", "action"].equal(one["agents", "action"])
        assert two.get(MEMORY, None) is None
        one, two = (
            env.step_and_maybe_reset(td)[1] for env, td in ((with_memory, one), (bare, two))
        )


@pytest.mark.skipif(native.missing() is not None, reason=str(native.missing()))
def test_both_backends_find_the_same_candidates():
    for step in goal_env().rollout(20, a_policy()).unbind(1):
        one, two = (find_candidates(step, ARENA.sight, backend) for backend in ("torch", "native"))
        for name, entry in one._asdict().items():
            assert entry.equal(getattr(two, name)), name


def test_a_step_goes_on_from_the_state_and_memory_it_is_given():
    env, policy = goal_env(), a_policy()
    history = env.rollout(12, policy)
    later = history[:, 8].clone()
    other = goal_env(seed=5)
    other.reset()
    state = later.select(*other.state_spec.keys(True, True))
    observed = other.reset(state, set_state=True)
    assert same(observed[MEMORY], later[MEMORY])
    assert observed["agents", "observation", "rivals"].equal(
        later["agents", "observation", "rivals"]
    )
    after = step_mdp(other.step(observed.set(("agents", "action"), later["agents", "action"])))
    assert same(after[MEMORY].exclude("goal"), history[:, 9][MEMORY].exclude("goal"))


def test_a_reset_to_the_middle_of_an_episode_without_memory_starts_a_new_one():
    env = goal_env()
    later = env.rollout(9, a_policy())[:, 8]
    state = later.select(*ExplorationEnv(ARENA, num_envs=4).full_state_spec.keys(True, True))
    observed = env.reset(state, set_state=True)
    fresh = blank_memory(later["agents", "map"], later["agents", "position"])
    never = torch.zeros_like(fresh.stuck, dtype=torch.bool)
    expected = to_tensordict(
        remember(fresh, observation_of(later), never, ARENA.sight),
        observed[ALL_COVERED],
        later["agents", "dangerous"],
        never,
    )
    assert same(observed[MEMORY], expected)


def test_a_plain_reset_forgets_a_memory_that_lies_in_the_tensordict():
    env = goal_env()
    last = env.rollout(9, a_policy())[:, -1]
    observed = env.reset(last.select(MEMORY), set_state=False)
    assert (observed[MEMORY, "step"] <= 0).all()
    assert not observed[MEMORY, "stuck"].any()


def test_environments_in_worker_processes_remember_alike():
    """Memory is an input of a step, so that it reaches workers."""
    alone = goal_env(2, max_steps=4)
    workers = ParallelEnv(1, partial(goal_env, 2, max_steps=4))
    try:
        assert set(alone.state_spec.keys(True, True)) == set(workers.state_spec.keys(True, True))
        policy = a_policy()
        one, two = alone.reset(), workers.reset()
        for seed in range(9):
            torch.manual_seed(seed)
            one = policy(one)
            torch.manual_seed(seed)
            two = policy(two)
            assert two["agents", "action"][0].equal(one["agents", "action"])
            one, two = (
                env.step_and_maybe_reset(td)[1] for env, td in ((alone, one), (workers, two))
            )
    finally:
        workers.close()


def test_a_collectors_state_holds_the_memory():
    """A new collector that loads it continues exactly, in the middle of episodes."""

    def collector():
        policy = a_policy()
        env = goal_env(max_steps=17)
        env.append_transform(RewardSum())
        return ResumableCollector(
            env,
            policy.team,
            frames_per_batch=4 * 10,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )

    torch.manual_seed(3)
    first = collector()
    first.rollout()
    state = first.state_dict()
    expected = [first.rollout().clone() for _ in range(2)]  # it reuses its memory
    second = collector()
    second.load_state_dict(state)
    for batch in expected:
        again = second.rollout()
        for key in (("agents", "action"), ("agents", "choice"), (*MEMORY, "known_by")):
            assert again[key].equal(batch[key]), key
    first.shutdown()
    second.shutdown()


def test_the_module_keeps_what_others_write_into_its_memory():
    env, keeper = ExplorationEnv(ARENA, num_envs=2), RememberTeam()
    first = keeper(env.reset())
    first[GOAL] = torch.full_like(first[GOAL], 3)
    stepped = env.step(first.set(("agents", "action"), torch.full((2, 3), 8)))
    second = keeper(step_mdp(stepped).exclude(MEMORY))
    assert (second[GOAL] == 3).all()
    anew = keeper(env.reset())
    assert (anew[GOAL] == -1).all()
    assert keeper(TensorDict(anew, batch_size=[2]))[MEMORY] is anew[MEMORY]


# ---------------------------------------------------------------- the wider world


@pytest.mark.parametrize("set_state", [False, True])
def test_a_refusal_is_forgotten_where_an_episode_begins(set_state):
    """Of four arenas two are reset, with a memory in which everything was refused and covered."""
    env = goal_env(4, replace(ARENA, move_period=2))
    last = env.rollout(5)[:, -1].select(*env.full_state_spec.keys(True, True), "done")
    last[REFUSED].fill_(True)
    last[ALL_COVERED].fill_(True)
    two = torch.tensor([[True], [False], [True], [False]])
    last["step_count"][two] = 0
    begun = env.reset(last.set("_reset", two), set_state=set_state)
    assert begun[REFUSED].any(-1).tolist() == [False, True, False, True]
    assert not begun[ALL_COVERED][two.squeeze(-1)].any()


def test_memories_of_before_there_were_some_entries_go_on():
    keeper = RememberTeam(sight=ARENA.sight, move_period=2)
    steps = ExplorationEnv(ARENA, num_envs=2).rollout(6).unbind(1)
    for step in steps[:3]:
        keeper(step)
    for name in ("refused", "crowded", "known", "stalled"):
        del keeper._kept[name]
    after = keeper(steps[3].exclude(("agents", "dangerous")))
    assert not after[REFUSED].any()
    assert not after[MEMORY]["stalled"].any()  # its map grew by all that it knows
    assert (after[MEMORY]["step"] >= 0).any()


@pytest.mark.parametrize("alone", [False, True])
def test_a_refusal_is_remembered_until_the_robot_may_move(alone):
    """Over episodes of 9 steps, in an environment with the memory and by the module alone."""
    torch.manual_seed(0)
    periods = (1, 2, 3)
    config = replace(ARENA, move_period=periods)
    keeper = RememberTeam(sight=config.sight, move_period=periods)
    env = (
        ExplorationEnv(config, num_envs=48, max_steps=9)
        if alone
        else goal_env(48, config, max_steps=9)
    )
    history = env.rollout(40, break_when_any_done=False)
    kept = np.zeros((48, 3), bool)
    longer = 0
    for step in history.unbind(1):
        known = keeper(step.exclude(MEMORY)) if alone else step
        now, refused = int(step["step_count"][0]), step["agents", "dangerous"].numpy()
        expected = refused | (kept & (now > 0))
        assert known[REFUSED].numpy().tolist() == expected.tolist()
        longer += int((expected & ~refused).sum())
        kept = expected & (now % np.array(periods) > 0)
    assert longer > 20


def otherwise(step, robot, config):
    """An observation of teams in which everything that one robot cannot know is drawn anew."""
    changed = step.clone()
    agents, robots = changed["agents"], config.num_agents
    others = torch.arange(robots) != robot
    changed["obstacles"] = ~changed["obstacles"]
    changed["draw_key"] = torch.randint_like(changed["draw_key"], 2**62)
    changed["walkers"] = torch.randint_like(changed["walkers"], config.height)
    agents["alive"][:, others] ^= True
    agents["linked"][:, others] ^= True
    agents["map"][:, others] = torch.randint_like(agents["map"][:, others], -1, 2)
    for key in ("unshared", "steps_since_merge"):
        agents[key][:, others] = torch.randint_like(agents[key][:, others], 3)
    for key in ("dangerous", "action_mask"):
        agents[key][:, others] ^= True
    agents["observation", "fov"][:, others] = 1.0
    hidden = ~agents["linked"][:, robot]
    agents["position"][hidden] = torch.randint_like(agents["position"][hidden], config.height)
    return changed


def test_memory_and_candidates_depend_on_nothing_that_a_robot_does_not_observe():
    """In the wider world, where who is alive, walkers and draws are beyond its knowledge too."""
    torch.manual_seed(0)
    env = ExplorationEnv(WIDE, num_envs=6)
    robots = range(WIDE.num_agents)
    keepers = [RememberTeam(sight=WIDE.sight) for _ in (*robots, None)]
    now, heard, mixed = env.reset(), 0, 0
    for _ in range(40):
        known = keepers[-1](now.clone())
        found = find_candidates(known, WIDE.sight)
        heard += int((known[MEMORY]["step"] >= 0).sum())
        for robot in robots:
            other = keepers[robot](otherwise(now, robot, WIDE))
            other_found = find_candidates(other, WIDE.sight)
            assert same(other[MEMORY][:, robot], known[MEMORY][:, robot])
            for name, entry in found._asdict().items():
                assert entry[:, robot].equal(getattr(other_found, name)[:, robot]), name
            mixed += int((other[MEMORY]["known_by"] != known[MEMORY]["known_by"]).sum())
        mask = now["agents", "action_mask"].float()
        action = torch.multinomial(mask.flatten(0, 1), 1).view(mask.shape[:2])
        now = step_mdp(env.step(now.set(("agents", "action"), action)))
    assert not now["agents", "alive"].all()
    assert heard > 0
    assert mixed > 0


def test_the_context_tells_each_robots_own_sensor():
    found = goal_env(2, WIDE).reset()["agents", "observation", "context"]
    own = {name: found[0, :, CONTEXT_COLUMNS.index(name)] for name in ("radius", "shape_cells")}
    assert own["radius"].tolist() == [1, 3, 6, 6]
    assert own["shape_cells"].tolist() == [9, 29, 113, 113]


def test_without_a_sight_robots_see_their_whole_field_of_view():
    config = ArenaConfig(height=9, width=9, sensing_range=1.8)
    step = RememberTeam(2)(ExplorationEnv(config, num_envs=2).reset())
    found = GoalCandidates()(step)["agents", "observation"]
    for name, entry in find_candidates(step, config.sight)._asdict().items():
        assert found[name].equal(entry), name
