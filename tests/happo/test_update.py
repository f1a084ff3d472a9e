"""One sequential update, as every user of the loss runs it, against the loop written out."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict

from marl_explore.happo.diagnostics import factor_statistics
from marl_explore.happo.update import REPORTED, sequential_update
from tests.helpers.happo import all_equal, descend, make_team, parameters_of

EPOCHS = 3


def optimizers(team):
    return {
        name: torch.optim.Adam(actor.parameters(), 1e-2)
        for name, actor in team.loss.actor_losses.items()
    }


def test_it_is_the_loop_over_actors_written_out():
    ours = make_team()
    by_hand = copy.deepcopy(ours)
    generator = torch.Generator().manual_seed(5)
    order = by_hand.loss.update_order(torch.Generator().manual_seed(5))

    batch, steps, reports = by_hand.batch.reshape(-1), optimizers(by_hand), []
    for name in order:
        for _ in range(EPOCHS):
            losses = by_hand.loss.actor_loss(batch, name)
            descend(steps[name], losses.select("loss_objective", "loss_entropy"))
        reports.append(losses)
        if name != order[-1]:
            by_hand.loss.update_factor(batch, name)

    flat, seen, steps = ours.batch.reshape(-1), [], optimizers(ours)

    def passes(data, keys):
        return [data.select(*keys, strict=False)] * EPOCHS

    def step(name, losses):
        seen.append(name)
        descend(steps[name], losses)

    reported = sequential_update(ours.loss, flat, passes, step, generator)
    assert seen == [name for name in order for _ in range(EPOCHS)]
    assert all_equal(parameters_of(ours.loss), parameters_of(by_hand.loss))
    assert torch.equal(flat["factor"], batch["factor"])
    expected = factor_statistics(batch["factor"])
    for key in REPORTED:
        expected[key] = sum(one[key].item() for one in reports) / len(reports)
    assert reported == expected


def test_a_single_actor_needs_no_factor():
    team = make_team()
    name = team.loss.names[0]
    team.loss.update_order = lambda generator: [name]
    batch = team.batch.reshape(-1)
    reported = sequential_update(team.loss, batch, lambda data, _: [data], lambda *_: None)
    assert "factor" not in batch
    assert reported["factor_ess"] == 1
    assert isinstance(batch, TensorDict)


@pytest.mark.parametrize("order", ["fixed", "simultaneous"])
def test_actors_are_updated_in_the_order_of_their_names_or_all_from_the_same_batch(order):
    ours = make_team()
    by_hand = copy.deepcopy(ours)
    batch, steps = by_hand.batch.reshape(-1), optimizers(by_hand)
    for name in by_hand.loss.names:
        losses = by_hand.loss.actor_loss(batch, name)
        descend(steps[name], losses.select("loss_objective", "loss_entropy"))
        if order == "fixed" and name != by_hand.loss.names[-1]:
            by_hand.loss.update_factor(batch, name)

    flat, steps, seen = ours.batch.reshape(-1), optimizers(ours), []

    def step(name, losses):
        seen.append(name)
        descend(steps[name], losses)

    reported = sequential_update(ours.loss, flat, lambda data, _: [data], step, order=order)
    assert seen == ours.loss.names
    assert all_equal(parameters_of(ours.loss), parameters_of(by_hand.loss))
    assert ("factor" in flat) == (order == "fixed")
    assert (reported["factor_ess"] == 1) == (order == "simultaneous")


def test_an_unknown_order_is_refused():
    team = make_team()
    with pytest.raises(ValueError, match="order='backwards' is not one of"):
        sequential_update(
            team.loss, team.batch.reshape(-1), lambda *_: [], lambda *_: None, order="backwards"
        )
