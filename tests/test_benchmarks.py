"""The benchmarks' baselines compute what we compute, and the benchmarks run."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from torch import nn

from benchmarks import (
    completion,
    curves,
    environment,
    explorers,
    frontier,
    harl,
    locks,
    messages,
    on_board,
    peers,
    planners,
    robustness,
    scaling,
    training,
    worlds,
)
from benchmarks.baselines import astar_table, bfs_table
from benchmarks.faults import lines, mutants
from benchmarks.timing import conditions
from marl_explore import ArenaConfig, ExplorationEnv, find_policy, record
from marl_explore.core import native
from marl_explore.core.frontier import feature_table
from marl_explore.evaluation import metrics
from marl_explore.policies.networks import MLP
from marl_explore.robot.agreement import Way, agree
from marl_explore.robot.messages import Intent
from marl_explore.training.config import TrainConfig
from tests.helpers.programs import here


def test_baselines_count_the_same_trajectories():
    maps, positions = frontier.observations(num_envs=10, steps=10)
    ours = feature_table(maps, positions, normalize=None)
    for grid, cell, table in zip(maps.tolist(), positions.tolist(), ours, strict=True):
        for baseline in (astar_table, bfs_table):
            theirs = torch.tensor(baseline(grid, tuple(cell)))
            # which first move ties go to is left to each; numbers and lengths are not
            assert theirs[:, 0].sum() == table[:, 0].sum()
            total = (theirs[:, 0] * theirs[:, 1]).sum()
            torch.testing.assert_close(total, (table[:, 0] * table[:, 1]).sum())
        torch.testing.assert_close(theirs, table)  # BFS in direction order breaks ties as we do


def test_the_frontier_benchmark_runs():
    times = frontier.measure(num_envs=4, repeats=1, sample=4)
    assert {"torch", "A* per frontier", "BFS per robot"} <= set(times)
    assert all(value > 0 for value in times.values())


def test_the_environment_benchmark_runs():
    rates = environment.measure(num_envs=2, repeats=1)
    assert {"ours, auto", "ours, torch", "collector", "PettingZoo-style Python"} <= set(rates)
    assert all(rate > 0 for rate in rates.values())


def test_the_benchmark_of_peers_measures_ours_and_names_who_is_absent(monkeypatch):
    for module in ("jaxmarl", "jumanji"):  # nobody waits for their compilation
        monkeypatch.setitem(sys.modules, module, None)
    head, ours, *others = peers.report(batches=(1, 2), repeats=1)
    assert head.split() == ["arenas:", "1", "2"]
    name, rates = ours.split(": ")
    assert name.strip() == "ours, FPR and NET"
    assert len(rates.split()) == 2
    assert all(float(rate) > 0 for rate in rates.split())
    for library in ("VMAS", "JaxMARL", "Jumanji", "POGEMA", "mpe2"):
        lines = [line for line in others if line.strip().startswith(library)]
        assert len(lines) == 1
        if find_spec(library.lower()) is None:
            assert lines[0].endswith(": not installed")
    assert "JaxMARL: not installed" in others


def test_the_cost_curves_are_measured_and_drawn(tmp_path):
    points = {4: (2, 2, 4), 6: (2, 2, 6)}
    measured = {"side of the arena (cells)": curves.measure(points, repeats=1)}
    measured["robots"] = measured["side of the arena (cells)"]
    curves.draw(measured, tmp_path / "cost.png")
    assert (tmp_path / "cost.png").stat().st_size > 5000
    assert all(cost > 0 for cost in measured["robots"]["torch"].values())


def test_the_benchmark_of_planners_runs():
    milliseconds = planners.measure("16 robots, 12 x 12", repeats=1)
    assert {"nearest", "hungarian", "rendezvous", "central"} <= set(milliseconds)
    assert all(value > 0 for value in milliseconds.values())


def test_the_benchmark_of_explorers_runs():
    assert set(explorers.office()) == {*"#.1234\n"}
    room = "#############\n#...........#\n#....1.2....#\n#...........#\n#############"
    explored, driven, *times = explorers.measure(2, coordinated=False, plan=room)
    assert 0 <= explored < 60
    assert driven >= 0
    assert all(time > 0 for time in times)


def test_the_benchmark_of_completion_agrees_with_a_record():
    count = completion.measure("nearest-timer,nearest-timer", "paper-12/3:4", seed=5)
    config = ArenaConfig(num_agents=3)
    recorded = record(find_policy("nearest-timer", config), config, 4, 300, seed=5)
    known = recorded.maps.known_targets.amax(-1)
    assert count.steps == [metrics.steps_to(known, recorded.num_targets, 1.0).tolist()] * 2
    assert count.incomplete == 0
    share = metrics.summarize(recorded)["communication_share_before_completion"]
    assert count.communications / count.actions == pytest.approx(share)
    line = completion.row("paper-12/3:4", "again", count, count)
    assert line.endswith("+0.00 [+0.00, +0.00], +0.0 %")


def test_the_price_of_faults_is_measured_on_the_same_arenas(tmp_path):
    lost, assumed = robustness.FAULTS[0], robustness.FAULTS[-1]
    faults = (replace(lost, levels=(0.0, 0.5)), replace(assumed, levels=(1.0, 0.5, 1.5)))
    results = robustness.measure(["goal-utility"], num_arenas=3, seed=1, faults=faults)
    base, lossy = results["goal-utility"][lost.name]
    assert results["goal-utility"][assumed.name][0] is base
    again = record(
        find_policy("goal-utility", robustness.BASE),
        robustness.BASE,
        3,
        600,
        seed=1,
        arenas="mixed",
    )
    expected = metrics.steps_to(again.maps.known_targets.amax(-1), again.num_targets, 1.0)
    assert base.to_100.tolist() == expected.tolist()
    assert not np.array_equal(lossy.to_100, base.to_100)
    assert all(one.finished == 1 for one in results["goal-utility"][assumed.name])
    lines = robustness.table(results, faults).splitlines()
    assert len(lines) == 2 + 1 + 1 + 2
    assert lines[3].startswith(f"| {lost.name} | 0.5 | {lossy.to_100.mean():.1f} (")
    robustness.figure(results, tmp_path / "faults.png", faults)
    assert (tmp_path / "faults.png").stat().st_size > 10_000


class Looking(nn.Module):
    """Does nothing but note what robots see."""

    def __init__(self, seen):
        super().__init__()
        self.seen = seen

    def forward(self, tensordict):
        self.seen.append(tensordict["agents", "observation", "fov"])
        return tensordict


def test_robots_with_a_wrong_idea_of_their_sensors_get_a_view_of_that_size():
    """Wider than it is, the margin is never seen; narrower, it is cut off."""
    seen = []
    for factor in (0.5, 2.0):
        policy = robustness.Assuming("goal-utility", robustness.BASE, factor)
        policy.policy = Looking(seen)
        now = ExplorationEnv(robustness.BASE).reset()
        whole = now["agents", "observation", "fov"]
        policy(now)
        assert now["agents", "observation", "fov"] is whole
    narrow, wide = seen
    assert narrow.equal(whole[..., 4:-4, 4:-4])
    assert wide[..., 7:-7, 7:-7].equal(whole)
    assert wide.sum() - whole.sum() == 4 * (29 * 29 - 15 * 15)


def slow_delta_bytes(episodes, arena):
    """Message by message: 10 bits for a cell and its number, at most 2 for each of 144 cells."""
    total = 0
    complete = int(episodes.num_targets[arena])
    for robot in range(4):
        told = 0
        for step in range(episodes.horizon):
            if int(episodes.maps.known_targets[arena, step].max()) == complete:
                break
            if episodes.action[arena, step, robot] == 9:
                known = int(episodes.maps.known_cells[arena, step, robot])
                total += min(36, math.ceil((known - told) * 10 / 8))
                told = known
    return total


def test_what_communication_brings_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(messages, "TIMERS", (4, 64))
    results = messages.measure(["nearest-timer", "best:argmax"], "paper-12/4:12", seed=1)
    for cases in results.values():
        silent, radio, free = (
            cases[case] for case in (messages.NEVER, messages.RADIO, messages.UNLIMITED)
        )
        assert silent.whole.sum() == silent.delta.sum() == 0
        assert silent.to_100.mean() > radio.to_100.mean() > free.to_100.mean()
        often, seldom = (cases[f"every {timer} steps"] for timer in (4, 64))
        assert often.whole.mean() >= seldom.whole.mean() > 0
        assert (radio.delta <= radio.whole).all()
    config = ArenaConfig()
    policy = find_policy("nearest-timer", config)
    one = record(policy, config, 12, 300, seed=1, until_mapped=True)
    known = results["nearest-timer"][messages.RADIO]
    expected = metrics.bytes_sent(one, metrics.before_completion(one)) / 4
    assert known.whole.tolist() == expected.tolist()
    assert known.delta.tolist() == [slow_delta_bytes(one, arena) / 4 for arena in range(12)]
    assert len(messages.table({"here": results}).splitlines()) == 2 + 2 * 5
    messages.figure({"here": results}, tmp_path / "messages.png")
    assert (tmp_path / "messages.png").stat().st_size > 10_000


def test_the_benchmark_of_wider_worlds_runs():
    seconds = worlds.lidar_and_plain(num_envs=4, repeats=1)
    assert all(value > 0 for value in seconds.values())
    points = {n: (2, replace(worlds.LIDAR, num_agents=n)) for n in (2, 3)}
    assert set(worlds.curve(points, repeats=1)) == {2, 3}


def test_the_training_benchmark_runs():
    seconds = training.measure(
        "paper-mlp-case2", repeats=2, network=MLP(hidden=(8, 4)), rollout_steps=5
    )
    parts = seconds["collection"] + seconds["update"]
    assert seconds["bare products"] > 0
    assert 0.5 < parts / seconds["iteration"] < 2


def test_the_bare_products_are_those_of_an_iteration():
    """Against the numbers of multiplications worked out by hand for a small case."""
    config = TrainConfig(
        network=MLP(hidden=(3, 2)),
        num_envs=2,
        rollout_steps=2,
        episode_steps=2,
        episodes=2,
        ppo_epochs=1,
    )
    actor = 37 * 3 + 3 * 2 + 2 * 10
    critic = 148 * 3 + 3 * 2 + 2 * 1
    batch, robots = 4, 4
    acting = robots * batch * actor
    values = (batch + 2) * critic  # of all observations, and of the last of each arena
    factors = (robots - 1) * batch * actor
    actors = robots * batch * (3 * actor - 37 * 3)  # no gradient of the observation
    critics = batch * (3 * critic - 148 * 3)
    expected = acting + values + factors + actors + critics
    assert sum(n * k * m for n, k, m in training.iteration_products(config)) == expected


def test_the_benchmark_of_harl_refuses_a_folder_without_it(tmp_path):
    with pytest.raises(SystemExit, match="it must be a clone of HARL, with harl/runners") as stop:
        harl.main([str(tmp_path)])
    assert str(stop.value).startswith(f"error: path={str(tmp_path)!r} is not allowed: ")


def test_the_model_of_scaling_finds_its_constants():
    batch = {w: 0.1 + 0.8 / w + 0.02 + 0.05 * w for w in (1, 2, 4)}
    model = scaling.Model.fit(update=1.0, alone=0.9, half=0.5, collections=batch)
    assert [model.fixed, model.divisible] == pytest.approx([0.1, 0.8])
    assert [model.ask, model.per_worker] == pytest.approx([0.02, 0.05])
    assert model.best_workers == 4
    assert model.seconds(2) == pytest.approx(1 + batch[2])


def test_the_scaling_benchmark_runs():
    words = "--arenas lidar-32 --num-envs 4 --rollout-steps 4 --repeats 1 --workers".split()
    done = here("benchmarks/scaling.py", *words)
    assert done.returncode == 0, done.stderr
    asked, _, alone = done.stdout.splitlines()
    assert "arenas='lidar-32'" in asked
    assert alone.split()[:2] == ["in", "process"]


def test_noise_larger_than_what_is_measured_has_no_best_number_of_workers():
    assert scaling.Model(1.0, 0.5, -0.1, 0.0, 0.1).best_workers == 0
    assert scaling.Model(1.0, 0.5, 0.1, 0.0, -0.1).best_workers == 0


@pytest.mark.parametrize(
    "name", ["completion", "harl", "messages", "peers", "robustness", "scaling"]
)
def test_command_lines_say_what_they_take(name):
    done = here(f"benchmarks/{name}.py", "--help")
    assert done.returncode == 0, done.stderr
    assert "usage:" in done.stdout


def test_everything_on_board_decides_with_and_without_kernels():
    times = on_board.measure("mazes", side=15, repeats=1)
    assert times.keys() == {"goal actor", "goal-utility", "utility-cost", "nearest-timer"}
    assert all(row.keys() == {"kernels", "numpy alone"} for row in times.values())


def test_without_locks_a_diagonal_is_driven_by_a_cell_that_is_held():
    north_east = Intent(0, 0, (1, 1), 1, upright=True)
    beside, contenders = (
        Intent(1, 0, (0, 1), 8),
        {2: Intent(2, 0, (5, 5), 2), 3: Intent(3, 0, (5, 7), 6)},
    )
    intents = {0: north_east, 1: beside, **contenders}
    assert set(agree(intents).values()) == {Way(())}
    assert locks.unlocked(intents) == agree(intents) | {0: Way(((0, 1), (0, 2)))}


def test_faults_on_purpose_find_nothing(capsys):
    assert mutants.mutate_files(4) == []
    assert lines.refuse_lines(8) == []
    assert len(lines.wrong_lines()) > 400
    assert "command lines: 8, 0 faults" in capsys.readouterr().out


def test_a_wrong_line_that_is_accepted_is_a_fault(monkeypatch):
    monkeypatch.setattr(lines, "GIANT", (("--version",),))
    (fault,) = lines.refuse_lines(1)
    assert fault.startswith("'--version': 0")


def test_times_say_whether_there_were_kernels(monkeypatch):
    assert f"{torch.__version__}, native" in conditions()
    monkeypatch.setattr(native, "_load", lambda name: OSError("it was not built"))
    assert conditions().endswith("torch: the native kernel is missing, it was not built")
