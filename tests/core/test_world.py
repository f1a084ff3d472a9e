"""Whole episodes of the fast rules against the plain-Python oracle, and their symmetries."""

from __future__ import annotations

import pytest
import torch
from hypothesis import Phase, find, given, settings
from hypothesis import strategies as st

from marl_explore.config.arena import ArenaConfig
from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS, UNKNOWN
from marl_explore.core.links import within_range
from marl_explore.core.mapping import known_cells, known_mask, known_targets
from marl_explore.core.motion import action_mask, open_moves
from marl_explore.core.rewards import REWARDS
from marl_explore.core.sensing import field_of_view
from marl_explore.core.world import NEVER, advance, num_targets, resume, start
from tests.helpers import oracle
from tests.helpers.boards import actions, arena, map_cells
from tests.helpers.strategies import repeatable, scenarios


def start_of(scenario):
    return start(scenario.config, scenario.obstacles, scenario.positions)


def steps_of(scenario):
    """(state before, actions, state after, record) of every step."""
    state = start_of(scenario)
    for action in scenario.actions:
        after, record = advance(scenario.config, state, action)
        yield state, action, after, record
        state = after


def named(name):
    """Message of a failed comparison that tells what was compared."""
    return lambda message: f"{name}: {message}"


def complete_maps(state):
    return known_targets(known_mask(state.map), state.target) == num_targets(
        state.target
    ).unsqueeze(-1)


# ---------------------------------------------------------------- against the oracle


def observed(config, state):
    """All that the package computes from a state, one arena a row."""
    near = within_range(state.position, config.communication_cells)
    return {
        "obstacles": state.obstacles,
        "position": state.position,
        "map": state.map,
        "unshared": state.unshared,
        "steps_since_merge": state.steps_since_merge,
        "step_count": state.step_count.squeeze(-1),
        "linked": state.linked,
        "action_mask": action_mask(open_moves(state.view), near),
        "field_of_view": field_of_view(state.view),
        "known_cells": known_cells(known_mask(state.map)),
        "target": state.target,
        "num_targets": num_targets(state.target),
        "known_targets": known_targets(known_mask(state.map), state.target),
        "complete": complete_maps(state),
    }


def expected(rules, world):
    """The oracle's values of one arena under the names of ``observed``."""
    targets = oracle.target_cells(world.obstacles, world.positions)
    return {
        "obstacles": world.obstacles,
        "position": [list(position) for position in world.positions],
        "map": world.maps,
        "unshared": world.unshared,
        "steps_since_merge": world.steps_since_merge,
        "step_count": world.step_count,
        "linked": oracle.in_range(rules, world),
        "action_mask": oracle.action_mask(rules, world),
        "field_of_view": [
            oracle.field_of_view(rules, world, robot) for robot in range(rules.num_agents)
        ],
        "known_cells": [oracle.known_cells(map_) for map_ in world.maps],
        "target": targets,
        "num_targets": sum(row.count(True) for row in targets),
        "known_targets": [oracle.known_targets(map_, targets) for map_ in world.maps],
        "complete": [oracle.complete(map_, targets) for map_ in world.maps],
    }


def assert_state_agrees(scenario, state, worlds):
    oracle = [expected(scenario.rules, world) for world in worlds]
    for name, value in observed(scenario.config, state).items():
        assert value.tolist() == [arena_[name] for arena_ in oracle], name


def assert_record_agrees(record, after, events, worlds):
    for name in ("dangerous", "merged", "discovered", "received"):
        assert getattr(record, name).tolist() == [getattr(event, name) for event in events], name
    assert record.known.tolist() == [
        [oracle.known_cells(map_) for map_ in world.maps] for world in worlds
    ]
    assert record.complete.tolist() == complete_maps(after).any(-1).tolist()
    for name, reward in REWARDS.items():
        judged = torch.tensor([event.rewards[name] for event in events])
        torch.testing.assert_close(reward(record), judged, rtol=1e-5, atol=1e-5, msg=named(name))


@repeatable(max_examples=300)
@given(scenario=scenarios())
def test_whole_episodes_agree_with_the_reference(scenario):
    worlds = [
        oracle.reset(scenario.rules, obstacles, positions)
        for obstacles, positions in zip(
            scenario.obstacles.tolist(), scenario.positions.tolist(), strict=True
        )
    ]
    assert_state_agrees(scenario, start_of(scenario), worlds)
    for _, action, after, record in steps_of(scenario):
        stepped = [
            oracle.step(scenario.rules, world, chosen)
            for world, chosen in zip(worlds, action.tolist(), strict=True)
        ]
        worlds = [world for world, _ in stepped]
        assert_state_agrees(scenario, after, worlds)
        assert_record_agrees(record, after, [event for _, event in stepped], worlds)


def both_refused(before, action, record, cells):
    """Pairs with equal ``cells`` refused though neither saw a danger, bool [B, N, N]."""
    moving = action < NUM_DIRECTIONS
    is_open = before.action_mask.gather(-1, action.unsqueeze(-1)).squeeze(-1)
    innocent = moving & is_open & record.dangerous
    equal = (cells.unsqueeze(-2) == cells.unsqueeze(-3)).all(-1)
    others = ~torch.eye(action.shape[-1], dtype=torch.bool)
    return equal & innocent.unsqueeze(-1) & innocent.unsqueeze(-2) & others


def targets_of(before, action):
    offsets = torch.tensor([*oracle.COMPASS, (0, 0), (0, 0)])
    return before.position + offsets[action]


def contended(config, before, action, after, record):
    return both_refused(before, action, record, targets_of(before, action))


def crossing(config, before, action, after, record):
    return both_refused(before, action, record, before.position + targets_of(before, action))


def masked_action(config, before, action, after, record):
    near = within_range(before.position, config.communication_cells)
    mask = action_mask(open_moves(before.view), near)
    return ~mask.gather(-1, action.unsqueeze(-1))


def relay(config, before, action, after, record):
    return record.network & ~within_range(after.position, config.communication_cells)


def long_relay(config, before, action, after, record):
    near = within_range(after.position, config.communication_cells).float()
    return record.network & (near @ near == 0)  # not even a common neighbour


def two_networks(config, before, action, after, record):
    return record.merged.unsqueeze(-1) & record.merged.unsqueeze(-2) & ~record.network


def enlarging_merge(config, before, action, after, record):
    return record.received > 0


def empty_merge(config, before, action, after, record):
    return record.merged & (record.received == 0)


def one_complete_map(config, before, action, after, record):
    return complete_maps(after).any(-1) & ~complete_maps(after).all(-1)


def lone_communicator(config, before, action, after, record):
    return (action == COMMUNICATE) & ~record.merged


EVENTS = (
    contended,
    crossing,
    masked_action,
    relay,
    long_relay,
    two_networks,
    enlarging_merge,
    empty_merge,
    lone_communicator,
    one_complete_map,
)


@pytest.mark.parametrize("event", EVENTS)
def test_random_episodes_hold_every_event(event):
    """Agreement with the oracle would prove little if merges or conflicts never came up."""

    def happens(scenario):
        return any(event(scenario.config, *step).any() for step in steps_of(scenario))

    # raises NoSuchExample if none is found
    find(scenarios(), happens, settings=settings(repeatable(500), phases=[Phase.generate]))


# ---------------------------------------------------------------- coverage


@repeatable(max_examples=80)
@given(
    scenario=scenarios(sensing=(1, False), connected=True, max_side=7)
    | scenarios(sensing=(2, False), connected=True, max_side=12)
)
def test_a_map_is_complete_exactly_when_it_has_no_reachable_frontier(scenario):
    for _, _, state, _ in steps_of(scenario):
        exhausted = [
            [
                oracle.trajectories(map_, position) == []
                for map_, position in zip(maps, positions, strict=True)
            ]
            for maps, positions in zip(state.map.tolist(), state.position.tolist(), strict=True)
        ]
        assert complete_maps(state).tolist() == exhausted


@pytest.mark.parametrize("complete", [False, True])
def test_random_episodes_hold_complete_and_incomplete_maps(complete):
    def happens(scenario):
        return any((complete_maps(state) == complete).any() for *_, state, _ in steps_of(scenario))

    strategy = scenarios(sensing=(1, False), connected=True, max_side=7)
    find(strategy, happens, settings=settings(repeatable(500), phases=[Phase.generate]))


# ---------------------------------------------------------------- symmetries and side effects


@repeatable(max_examples=40)
@given(scenario=scenarios(max_side=10), data=st.data())
def test_the_order_of_the_robots_does_not_matter(scenario, data):
    order = torch.tensor(data.draw(st.permutations(range(scenario.rules.num_agents))))
    state = start_of(scenario)
    mirror = start(scenario.config, scenario.obstacles, scenario.positions[:, order])
    for action in scenario.actions:
        state, record = advance(scenario.config, state, action)
        mirror, mirror_record = advance(scenario.config, mirror, action[:, order])
        assert mirror.map.equal(state.map[:, order])
        assert mirror.position.equal(state.position[:, order])
        assert mirror.unshared.equal(state.unshared[:, order][:, :, order])
        assert mirror.steps_since_merge.equal(state.steps_since_merge[:, order][:, :, order])
        for name, reward in REWARDS.items():
            torch.testing.assert_close(
                reward(mirror_record), reward(record)[:, order], msg=named(name)
            )


@repeatable(max_examples=40)
@given(scenario=scenarios(max_side=10))
def test_maps_only_grow(scenario):
    for before, _, after, _ in steps_of(scenario):
        was_known = before.map != UNKNOWN
        assert after.map[was_known].equal(before.map[was_known])


@repeatable(max_examples=40)
@given(scenario=scenarios(max_side=10))
def test_a_step_leaves_its_inputs_as_they_were(scenario):
    state = start_of(scenario)
    for action in scenario.actions:
        copies = [tensor.clone() for tensor in (*state, action)]
        after, _ = advance(scenario.config, state, action)
        for tensor, copy in zip((*state, action), copies, strict=True):
            assert tensor.equal(copy)
        state = after


@repeatable(max_examples=20)
@given(scenario=scenarios(max_side=8, batch=(6, 6)), in_order=st.booleans())
def test_more_batch_dimensions_give_the_same_as_one(scenario, in_order):
    def fold(flat):
        folded = flat.unflatten(0, (2, 3))
        return folded if in_order else folded.transpose(0, 1).contiguous().transpose(0, 1)

    flat = start_of(scenario)
    folded = start(scenario.config, fold(scenario.obstacles), fold(scenario.positions))
    for action in scenario.actions:
        flat, record = advance(scenario.config, flat, action)
        folded, folded_record = advance(scenario.config, folded, fold(action))
        for name, tensor in folded._asdict().items():
            assert tensor.equal(fold(getattr(flat, name))), name
        for name, reward in REWARDS.items():
            assert reward(folded_record).equal(fold(reward(record))), name
        for name in ("dangerous", "network", "discovered", "received", "known", "complete"):
            assert getattr(folded_record, name).equal(fold(getattr(record, name))), name


# ---------------------------------------------------------------- by hand


def test_at_reset_each_robot_has_sensed_once_and_never_merged():
    config = ArenaConfig(height=3, width=5, num_agents=2)  # 3 x 3 field of view
    state = start(
        config,
        *arena("""
            0.#..
            .#...
            ....1
        """),
    )
    first = map_cells("""
        ..???
        .#???
        ?????
    """)
    second = map_cells("""
        ?????
        ???..
        ???..
    """)
    assert state.map.equal(torch.stack((first, second)))
    assert state.unshared.tolist() == [[0, 4], [4, 0]]
    assert state.steps_since_merge.tolist() == [[0, NEVER], [NEVER, 0]]
    assert state.step_count.tolist() == [0]


def test_moving_sensing_and_merging_keep_their_books():
    """Robot 0 walks to robot 1, they merge, and robot 1 walks away."""
    config = ArenaConfig(height=1, width=9, num_agents=2, obstacle_density=0)
    state = start(config, *arena("0....1..."))  # knows 2 and 3 cells
    state, record = advance(config, state, actions("E stay"))
    assert record.discovered.tolist() == [1, 0]
    assert state.unshared.tolist() == [[0, 3], [3, 0]]
    assert state.map.equal(torch.stack((map_cells("...??????"), map_cells("????...??"))))

    state, record = advance(config, state, actions("talk talk"))
    assert record.received.tolist() == [3, 3]
    assert record.unshared.tolist() == [[0, 3], [3, 0]], "rewards need q before the merge"
    assert state.unshared.tolist() == [[0, 0], [0, 0]]
    assert state.steps_since_merge.tolist() == [[0, 0], [0, 0]]
    assert state.map.equal(map_cells("...?...??").expand(2, 1, 9))

    state, record = advance(config, state, actions("E E"))
    assert record.discovered.tolist() == [1, 1]
    assert state.unshared.tolist() == [[0, 1], [1, 0]]
    assert state.steps_since_merge.tolist() == [[0, 1], [1, 0]]
    assert state.map.equal(torch.stack((map_cells(".......??"), map_cells("...?....?"))))
    assert state.step_count.tolist() == [3]


def test_the_step_is_complete_when_one_map_is():
    config = ArenaConfig(height=1, width=8, num_agents=2, obstacle_density=0)
    state = start(config, *arena(".0..#1.."))
    state, record = advance(config, state, actions("E stay"))
    assert complete_maps(state).tolist() == [False, False]
    assert record.complete.item() is False

    knows_all = state.map.clone()
    knows_all[0] = map_cells("....#...")
    given = ("unshared", "steps_since_merge", "step_count")
    state = resume(
        config,
        state.obstacles,
        state.position,
        knows_all,
        **{name: getattr(state, name) for name in given},
    )
    state, record = advance(config, state, actions("stay stay"))
    assert complete_maps(state).tolist() == [True, False]
    assert record.complete.item() is True


def test_steps_since_the_last_merge_saturate():
    config = ArenaConfig(height=1, width=9, num_agents=2, obstacle_density=0)
    state = start(config, *arena("0....1..."))
    late = torch.tensor([[0, NEVER - 1], [NEVER - 1, 0]])
    state, _ = advance(config, state._replace(steps_since_merge=late), actions("stay stay"))
    assert state.steps_since_merge.tolist() == [[0, NEVER], [NEVER, 0]]
    state, _ = advance(config, state, actions("stay stay"))
    assert state.steps_since_merge.tolist() == [[0, NEVER], [NEVER, 0]]


def test_the_ends_of_a_relay_get_all_maps_though_out_of_range():
    config = ArenaConfig(
        height=1, width=5, num_agents=3, obstacle_density=0, communication_range=1.0
    )
    state = start(config, *arena("0.2.1"))  # 2 cells reach, 4 from end to end
    state, record = advance(config, state, actions("talk talk talk"))
    assert record.received.tolist() == [3, 3, 2]
    assert state.map.equal(map_cells(".....").expand(3, 1, 5))
    assert state.unshared.tolist() == [[0] * 3] * 3
    assert state.steps_since_merge.tolist() == [[0] * 3] * 3
