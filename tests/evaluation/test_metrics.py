"""Every measure against an episode small enough to work out by hand, and against plain loops."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

from marl_explore import ArenaConfig
from marl_explore.evaluation import metrics
from marl_explore.evaluation.episodes import record
from marl_explore.evaluation.metrics import Episodes, Snapshot
from marl_explore.evaluation.registry import find_policy

MOVE_N, MOVE_NE, STAY, TALK = 0, 1, 8, 9


def hand_made():
    """One arena of 10 cells, 8 of them targets; two robots; three steps.

    Robot 0 moves north (finds 2), talks (receives 3), stays. Robot 1 moves north-east (finds 1),
    talks (receives 2), then moves north and is refused.
    """
    return Episodes(
        maps=Snapshot(
            known_targets=torch.tensor([[[2, 3], [4, 4], [7, 6], [8, 6]]]),
            union_targets=torch.tensor([[4, 7, 7, 8]]),
            known_cells=torch.tensor([[[3, 3], [5, 4], [8, 6], [9, 6]]]),
            union_cells=torch.tensor([[5, 8, 8, 9]]),
        ),
        action=torch.tensor([[[MOVE_N, MOVE_NE], [TALK, TALK], [STAY, MOVE_N]]]),
        dangerous=torch.tensor([[[0, 0], [0, 0], [0, 0], [0, 1]]]).bool(),
        merged=torch.tensor([[[0, 0], [0, 0], [1, 1], [0, 0]]]).bool(),
        discovered=torch.tensor([[[3, 3], [2, 1], [0, 0], [1, 0]]]),
        received=torch.tensor([[[0, 0], [0, 0], [3, 2], [0, 0]]]),
        position=torch.tensor(
            [[[[3, 3], [4, 0]], [[2, 3], [3, 1]], [[2, 3], [3, 1]], [[2, 3], [3, 1]]]]
        ),
        alive=torch.ones(1, 4, 2, dtype=torch.bool),
        linked=torch.tensor([[[0, 0], [1, 1], [1, 1], [0, 0]]]).bool(),
        num_targets=torch.tensor([8]),
        ended=torch.tensor([3]),
        finishable=torch.tensor([True]),
        lost_targets=torch.tensor([0]),
        num_cells=10,
        cell_size=0.5,
        max_discovery=2,
    )


def test_coverage_curves():
    curves = metrics.coverage(hand_made())
    assert curves["largest"][0].tolist() == [3 / 8, 4 / 8, 7 / 8, 1]
    assert curves["smallest"][0].tolist() == [2 / 8, 4 / 8, 6 / 8, 6 / 8]
    assert curves["mean"][0].tolist() == [2.5 / 8, 4 / 8, 6.5 / 8, 7 / 8]
    assert curves["merged"][0].tolist() == [4 / 8, 7 / 8, 7 / 8, 1]
    assert metrics.known_ratio(hand_made())[0].tolist() == [0.3, 0.5, 0.8, 0.9]


@pytest.mark.parametrize(
    ("share", "first"), [(0.3, 0), (0.375, 0), (0.5, 1), (0.51, 2), (0.875, 2), (0.9, 3), (1.0, 3)]
)
def test_steps_to_a_coverage_compare_whole_cells(share, first):
    known = torch.tensor([[3, 4, 7, 8]])
    assert metrics.steps_to(known, torch.tensor([8]), share).tolist() == [first]


def test_a_coverage_never_reached_counts_one_step_more_than_the_horizon():
    known = torch.tensor([[3, 4, 7, 7], [8, 8, 8, 8]])
    assert metrics.steps_to(known, torch.tensor([8, 8]), 1.0).tolist() == [4, 0]


def two_episodes():
    """The hand-made episode, and one in which everybody stays."""
    one = hand_made()
    silent = torch.full((1, 3, 2), STAY)
    return Episodes(
        maps=Snapshot(*(torch.cat((counts, counts)) for counts in one.maps)),
        action=torch.cat((one.action, silent)),
        dangerous=torch.cat((one.dangerous, torch.zeros_like(one.dangerous))),
        merged=torch.cat((one.merged, torch.zeros_like(one.merged))),
        discovered=torch.cat((one.discovered, one.discovered)),
        received=torch.cat((one.received, 0 * one.received)),
        position=torch.cat((one.position, one.position[:, :1].expand(-1, 4, -1, -1))),
        alive=torch.cat((one.alive, one.alive)),
        linked=torch.cat((one.linked, one.linked)),
        num_targets=torch.tensor([8, 8]),
        ended=torch.tensor([3, 3]),
        finishable=torch.tensor([True, True]),
        lost_targets=torch.tensor([0, 0]),
        num_cells=10,
        cell_size=0.5,
        max_discovery=2,
    )


def test_communication_shares():
    episodes = hand_made()
    assert metrics.communication_share(episodes).pooled == 2 / 6
    assert metrics.useful_share(episodes).pooled == 1.0
    lone = episodes._replace(received=torch.zeros_like(episodes.received))
    assert metrics.useful_share(lone).pooled == 0.0
    silent = episodes._replace(action=torch.full((1, 3, 2), STAY))
    assert math.isnan(metrics.useful_share(silent).pooled)


def test_shares_are_of_each_episode_and_of_the_events_of_all():
    communicating, useful = (
        metrics.shares(two_episodes())[name] for name in ("communication_share", "useful_share")
    )
    assert communicating.each.tolist() == [2 / 6, 0]
    assert communicating.pooled == 2 / 12
    assert useful.each[0] == 1
    assert useful.each[1].isnan()
    assert useful.pooled == 1.0


def test_steps_after_completion_can_be_left_out():
    episodes = hand_made()
    early = episodes._replace(num_targets=torch.tensor([7]))  # complete after the second step
    assert metrics.before_completion(early).tolist() == [[True, True, False]]
    assert metrics.before_completion(episodes).tolist() == [[True, True, True]]
    assert metrics.shares(early)["communication_share_before_completion"].pooled == 2 / 4
    earlier = episodes._replace(num_targets=torch.tensor([4]))  # complete after the first step
    shares = metrics.shares(earlier)
    assert shares["communication_share_before_completion"].pooled == 0
    assert math.isnan(shares["useful_share_before_completion"].pooled)


def test_enlargements_and_cells_on_the_air():
    episodes = hand_made()
    assert metrics.enlargements(episodes).tolist() == [3, 2]
    assert metrics.large_enlargement_share(episodes).pooled == 0.5  # 3 > e_max = 2
    assert metrics.enlarging_share(episodes).pooled == 1
    assert metrics.cells_sent(episodes).tolist() == [[0, 0, (8 - 3) + (6 - 2), 9]]
    assert metrics.cells_received(episodes).tolist() == [5]


def test_enlargements_by_nothing_count_as_zeros():
    episodes = hand_made()
    received = episodes.received * torch.tensor([1, 0])  # robot 1 hears nothing new
    episodes = episodes._replace(received=received)
    assert metrics.enlargements(episodes).tolist() == [3, 0]
    assert metrics.enlarging_share(episodes).pooled == 0.5
    assert metrics.large_enlargement_share(episodes).pooled == 1  # of those that added something


def test_motion_and_overlap():
    episodes = hand_made()
    assert metrics.dangerous_share(episodes).pooled == 1 / 3
    assert metrics.distance_travelled(episodes).item() == pytest.approx(0.5 * (1 + math.sqrt(2)))
    assert metrics.overlap(episodes).item() == pytest.approx((3 + 3 + 2 + 1 + 1) / 9 - 1)


def test_snapshots_count_cells():
    grid = torch.tensor([[[[0, -1, 1]], [[-1, -1, 0]]]], dtype=torch.int8)
    target = torch.tensor([[[True, True, False]]])
    counts = metrics.snapshot(grid, target)
    assert counts.known_cells.tolist() == [[2, 1]]
    assert counts.union_cells.tolist() == [2]
    assert counts.known_targets.tolist() == [[1, 0]]
    assert counts.union_targets.tolist() == [1]


def test_recorded_episodes_are_consistent():
    config = ArenaConfig(height=7, width=9, num_agents=3)
    episodes = record(find_policy("random", config), config, num_arenas=12, steps=80)
    known = episodes.maps.known_cells
    gained = (episodes.discovered + episodes.received).cumsum(1)
    assert torch.equal(known, gained)  # every known cell was discovered or received once
    assert (known.diff(dim=1) >= 0).all()
    assert (episodes.maps.union_cells >= known.amax(-1)).all()
    assert episodes.merged.any()
    assert (episodes.received[~episodes.merged] == 0).all()
    curves = metrics.coverage(episodes)
    assert (curves["smallest"] <= curves["mean"] + 1e-12).all()
    assert (curves["largest"] <= curves["merged"]).all()
    assert (metrics.overlap(episodes) >= 0).all()


def test_every_episode_has_every_score():
    scores = metrics.per_episode(two_episodes()._replace(num_targets=torch.tensor([8, 10])))
    assert scores["steps_to_80"].tolist() == [2, 3]  # 7 of 8 targets, 8 of 10
    assert scores["steps_to_100"].tolist() == [3, 4]  # the second never: one more than 3 steps
    assert scores["merged_steps_to_80"].tolist() == [1, 3]
    assert scores["steps_to_all_complete"].tolist() == [4, 4]
    assert scores["complete"].tolist() == [1, 0]
    assert scores["coverage_at_3"].tolist() == [1, 0.8]
    assert scores["final_known_ratio"].tolist() == [0.9, 0.9]
    assert scores["cells_sent"].tolist() == [9, 0]


def test_the_summary_weighs_every_arena_the_same_and_has_every_measure():
    episodes = two_episodes()._replace(num_targets=torch.tensor([8, 10]))
    summary = metrics.summarize(episodes)
    assert summary["steps_to_100"] == (3 + 4) / 2
    assert summary["coverage_at_3"] == 0.9
    assert "coverage_at_20" not in summary  # the episode is shorter
    assert summary["communication_share"] == 2 / 12
    assert summary.keys() == metrics.per_episode(episodes).keys() | metrics.shares(episodes).keys()
    assert all(isinstance(value, float) for value in summary.values())


def test_the_docs_have_every_measure():
    documented = (Path(__file__).parents[2] / "docs" / "metrics.md").read_text()
    for name in metrics.summarize(hand_made()):
        name = re.sub(r"steps_to_\d+", "steps_to_P", name)
        name = re.sub(r"coverage_at_\d+", "coverage_at_t", name)
        assert f"`{name}`" in documented, name


# ---------------------------------------------------------------- robots that fail


def with_a_failure():
    """The hand-made episode, in which robot 0 fails in the last step."""
    one = hand_made()
    alive = one.alive.clone()
    alive[0, 3, 0] = False
    return one._replace(
        alive=alive, finishable=torch.tensor([False]), lost_targets=torch.tensor([2])
    )


def test_coverage_is_that_of_the_living():
    curves = metrics.coverage(with_a_failure())
    assert curves["largest"][0].tolist() == [3 / 8, 4 / 8, 7 / 8, 6 / 8]
    assert curves["mean"][0].tolist() == [2.5 / 8, 4 / 8, 6.5 / 8, 6 / 8]
    assert curves["smallest"][0].tolist() == [2 / 8, 4 / 8, 6 / 8, 6 / 8]
    scores = metrics.per_episode(with_a_failure())
    assert scores["steps_to_100"].item() == 4
    assert scores["complete"].item() == 0
    assert scores["failed_robots"].item() == 1
    assert scores["knowledge_lost"].item() == 2 / 8
    assert scores["finishable"].item() == 0


def test_a_map_that_was_complete_counts_even_if_its_robot_failed_later():
    one = with_a_failure()
    known = one.maps.known_targets.clone()
    known[0, 2, 0] = 8
    scores = metrics.per_episode(one._replace(maps=one.maps._replace(known_targets=known)))
    assert (scores["complete"].item(), scores["steps_to_100"].item()) == (1, 2)


def test_nobody_left_covers_nothing():
    one = hand_made()
    alive = one.alive.clone()
    alive[0, 3] = False
    curves = metrics.coverage(one._replace(alive=alive))
    assert [curve[0, 3].item() for name, curve in curves.items() if name != "merged"] == [0, 0, 0]


def test_actions_of_failed_robots_do_not_count():
    one = hand_made()
    alive = one.alive.clone()
    alive[0, 2:, 0] = False
    shares = metrics.shares(one._replace(alive=alive))
    assert shares["communication_share"].part.tolist() == [2]
    assert shares["communication_share"].whole.tolist() == [5]
    assert shares["unlinked_share"].part.tolist() == [1]
    assert shares["unlinked_share"].whole.tolist() == [4]


def test_every_communicate_action_sends_a_map_of_two_bits_per_cell():
    assert metrics.bytes_sent(hand_made()).tolist() == [2 * 3]


# ---------------------------------------------------------------- until some map is complete


def slow_ways(episodes):
    """Moves, metres and bytes of each robot up to the step that completed a map, by plain loops."""
    for b in range(len(episodes.num_targets)):
        targets, moves, ways, sent = int(episodes.num_targets[b]), [], [], 0
        robots = range(episodes.position.shape[2])
        counts = episodes.maps.known_targets[b].tolist()
        alive = episodes.alive[b].tolist()
        done = [
            any(counts[t][i] == targets and alive[t][i] for i in robots) for t in range(len(counts))
        ]
        last = done.index(True) if True in done else episodes.horizon
        for i in robots:
            way, count = 0.0, 0
            for t in range(last):
                before, after = episodes.position[b, t : t + 2, i].tolist()
                if before != after:
                    count += 1
                    way += math.dist(before, after) * episodes.cell_size
                if episodes.action[b, t, i] == TALK and alive[t][i]:
                    sent += math.ceil(episodes.num_cells / 4)
            moves.append(count)
            ways.append(way)
        yield moves, ways, sent


@pytest.mark.parametrize("failure_rate", [0.0, 0.02])
@pytest.mark.parametrize("policy", ["random", "goal-utility"])
def test_what_is_measured_until_completion_is_what_plain_loops_find(policy, failure_rate):
    config = ArenaConfig(height=7, width=9, num_agents=3, failure_rate=failure_rate)
    episodes = record(find_policy(policy, config), config, num_arenas=8, steps=60)
    scores = metrics.per_episode(episodes)
    assert policy == "random" or scores["complete"].any()
    for b, (moves, ways, sent) in enumerate(slow_ways(episodes)):
        assert metrics.moves_of_robots(episodes)[b].tolist() == moves
        assert metrics.distance_of_robots(episodes)[b].tolist() == pytest.approx(ways)
        assert scores["distance_mean_m"][b] == pytest.approx(sum(ways) / 3)
        assert scores["distance_longest_m"][b] == pytest.approx(max(ways))
        assert scores["moves_longest"][b] == max(moves)
        assert scores["bytes_until_complete"][b] == sent
    assert (scores["distance_mean_m"] * 3 <= scores["distance_m"] + 1e-9).all()


def test_ways_and_bytes_end_when_a_map_is_complete():
    episodes = hand_made()
    assert metrics.until_completion(episodes).tolist() == [[True, True, True]]
    early = episodes._replace(num_targets=torch.tensor([4]))  # complete after the first step
    assert metrics.until_completion(early).tolist() == [[True, False, False]]
    never = episodes._replace(num_targets=torch.tensor([9]))
    assert metrics.until_completion(never).tolist() == [[True, True, True]]
    at_once = episodes._replace(num_targets=torch.tensor([3]))  # known at the reset
    assert metrics.moves_of_robots(at_once).tolist() == [[0, 0]]
    for one, sent in ((episodes, 6), (early, 0), (at_once, 0)):
        assert metrics.per_episode(one)["bytes_until_complete"].tolist() == [sent]
    assert metrics.distance_of_robots(episodes)[0].tolist() == pytest.approx([0.5, 0.5 * 2**0.5])
    assert metrics.moves_of_robots(episodes).tolist() == [[1, 1]]
