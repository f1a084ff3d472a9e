"""One actor: what it reads of a batch, and the ratio of its new to its old policy."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss

from marl_explore.happo.checks import check_log_prob, read, select
from marl_explore.happo.views import View, slice_agent


def own_keys(loss: ClipPPOLoss) -> list[NestedKey]:
    """Entries that an actor's loss reads, except the advantage; action and log-prob come last."""
    keys = loss.tensor_keys
    produced = {keys.action, keys.sample_log_prob}
    needed = [key for key in loss.actor_network.in_keys if key not in produced]
    return [*needed, keys.action, keys.sample_log_prob]


def actor_entries(
    loss: ClipPPOLoss, batch: TensorDictBase, view: View | None, name: str
) -> TensorDictBase:
    """The entries of one actor: its slice of a stacked group, or its own group.

    Raises:
        ValueError: for a missing entry, one that the view does not fit, and log-probabilities of
            another shape than the actions.
    """
    keys = own_keys(loss)
    remedy = (
        f"actor {name!r} reads it; collect with return_log_prob=True, or name another entry by "
        f"loss.actor_losses[{name!r}].set_keys(action=..., sample_log_prob=...)"
    )
    if view is None:
        own = select(batch, keys, remedy)
    else:
        own = slice_agent(batch, {key: read(batch, key, remedy) for key in keys}, view, name)
    action, log_prob = (own.get(key) for key in keys[-2:])
    check_log_prob(own, action, log_prob, keys[-1])
    return own


def actor_log_ratio(loss: ClipPPOLoss, own: TensorDictBase, name: str) -> Tensor:
    """Log of the ratios [*B] or [*B, k] of an actor's new to its old policy.

    Raises:
        ValueError: for log-probabilities of another shape than the actor's, and for an action that
            has no probability.
    """
    action, log_prob = own_keys(loss)[-2:]
    old: Tensor = own.get(log_prob)
    with set_recurrent_mode(True):  # as TorchRL does around every loss
        new = loss.actor_network.get_dist(own).log_prob(own.get(action))
    if new.shape != old.shape:
        raise ValueError(
            f"the log-probability {log_prob!r} has shape {[*old.shape]}, but actor {name!r} gives "
            f"{[*new.shape]}"
        )
    difference = new - old
    lost = ~difference.isfinite()
    if lost.any():
        raise ValueError(
            f"actor {name!r} has no probability for {int(lost.sum())} of {lost.numel()} actions "
            f"{action!r}, for instance where its mask forbids them: the ratio to their "
            f"log-probability {log_prob!r} is not finite"
        )
    return difference
