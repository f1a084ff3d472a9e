"""Statistics of HAPPO's factor: known answers, and a warning that comes once per run."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from marl_explore.happo.diagnostics import ESS_WARNING, FactorWatch, factor_statistics
from marl_explore.training.trainer import Trainer
from tests.helpers.configs import tiny

RUN = tiny(num_agents=3, episodes=16)


@pytest.mark.parametrize(
    ("factor", "mean", "smallest", "largest", "share"),
    [
        ([1.0, 3.0], 2.0, 1.0, 3.0, 16 / 10 / 2),
        ([0.5] * 4, 0.5, 0.5, 0.5, 1.0),
        ([0.0, 0.0, 0.0, 8.0], 2.0, 0.0, 8.0, 1 / 4),
        ([1.0], 1.0, 1.0, 1.0, 1.0),
    ],
)
def test_known_answers(factor, mean, smallest, largest, share):
    assert factor_statistics(torch.tensor(factor).unsqueeze(-1)) == {
        "factor_mean": mean,
        "factor_min": smallest,
        "factor_max": largest,
        "factor_ess": pytest.approx(share),
    }


@given(
    st.lists(st.floats(0.01, 100), min_size=1, max_size=20),
    st.integers(1, 5),
    st.floats(0.1, 10),
)
def test_the_effective_share_depends_on_neither_scale_nor_number(values, times, scale):
    factor = torch.tensor(values, dtype=torch.float64)
    share = factor_statistics(factor)["factor_ess"]
    assert 1 / len(values) <= share * (1 + 1e-9)
    assert share <= 1 + 1e-9
    assert factor_statistics(scale * factor.repeat(times))["factor_ess"] == pytest.approx(share)


def test_it_warns_below_the_threshold_and_once(caplog):
    watch = FactorWatch()
    watch(ESS_WARNING, 1)
    assert caplog.messages == []
    watch(0.312, 2)
    watch(0.1, 3)
    (message,) = caplog.messages
    assert message.startswith("update 2: ")
    assert "31 % of the batch, less than 50 %" in message
    FactorWatch()(0.1, 1)  # another run
    assert len(caplog.messages) == 2


def test_a_run_with_giant_steps_is_warned_once(caplog):
    low = [m["factor_ess"] < ESS_WARNING for m in Trainer(replace(RUN, actor_lr=0.5)).run()]
    assert low.count(True) >= 2
    (message,) = caplog.messages
    assert message.startswith(f"update {low.index(True) + 1}: ")


def test_a_run_with_small_steps_is_not_warned(caplog):
    shares = [m["factor_ess"] for m in Trainer(RUN).run()]
    assert min(shares) >= ESS_WARNING
    assert caplog.messages == []


def test_a_lone_robot_has_a_factor_of_one():
    run = replace(RUN, arena=replace(RUN.arena, num_agents=1))
    for metrics in Trainer(run).run():
        assert all(metrics[f"factor_{name}"] == 1 for name in ("mean", "min", "max", "ess"))
