"""The sequential update of a team's actors, in which HAPPO differs from clipped PPO."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal, get_args

import torch
from tensordict import NestedKey, TensorDictBase

from marl_explore.happo.diagnostics import factor_statistics
from marl_explore.happo.loss import HAPPOLoss

REPORTED = ("loss_objective", "entropy", "kl_approx", "clip_fraction")
"""Diagnostics of an actor's loss that an update reports."""

UpdateOrder = Literal["random", "fixed", "simultaneous"]
"""A new order of the actors for every batch, as in HAPPO; that of their names; or all from the same
batch, none weighted by others."""

Passes = Callable[[TensorDictBase, list[NestedKey]], Iterable[TensorDictBase]]
Step = Callable[[str, TensorDictBase], object]


def sequential_update(
    loss: HAPPOLoss,
    batch: TensorDictBase,
    passes: Passes,
    step: Step,
    generator: torch.Generator | None = None,
    order: UpdateOrder = "random",
) -> dict[str, float]:
    """Update every actor in turn, each weighted by the ratios of those before it (Zhong et al.).

    The last actor's ratios are not multiplied in, since no actor comes after it.

    Args:
        loss: of the team.
        batch: of any shape, with the advantage; the factor is written into it. Recurrent actors
            need whole rows [B, T] of a rollout, in ``passes`` too.
        passes: returns the minibatches of all epochs, from the batch and the entries that an
            actor's loss reads.
        step: takes the actor's name and its losses, "loss_objective" and "loss_entropy", and
            minimises their sum.
        generator: of the order of actors.
        order: "fixed" and "simultaneous" are for ablations.

    Returns:
        ``REPORTED`` on the last minibatches, means over actors, and
        ``diagnostics.factor_statistics``.

    Raises:
        ValueError: for an unknown order.
    """
    if order not in get_args(UpdateOrder):
        raise ValueError(f"order={order!r} is not one of {get_args(UpdateOrder)}")
    reports: dict[str, list[float]] = {key: [] for key in REPORTED}
    names = loss.update_order(generator) if order == "random" else loss.names
    for previous, name in zip([None, *names], names, strict=False):
        if previous is not None and order != "simultaneous":
            loss.update_factor(batch, previous)
        for part in passes(batch, loss.actor_keys(name)):
            output = loss.actor_loss(part, name)
            step(name, output.select("loss_objective", "loss_entropy"))
        for key, values in reports.items():
            values.append(output[key].item())
    single = torch.ones(1, device=batch.device)  # an actor alone leaves no factor
    factor = batch.get(loss.tensor_keys.factor, single)
    means = {key: sum(values) / len(values) for key, values in reports.items()}
    return means | factor_statistics(factor)
