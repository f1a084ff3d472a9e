"""What HAPPOLoss refuses: parts that do not fit together, and batches without what it reads."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictModule
from torch import Tensor, nn
from torchrl.modules import GRUModule, LSTMModule

from marl_explore.happo.views import View, agents_of, in_group

ACTOR_OPTIONS = (
    "device",
    "entropy_bonus",
    "max_importance_ratio",
    "reduction",
    "samples_mc_entropy",
)
"""Options of ``ClipPPOLoss`` that apply to an actor of HAPPO."""

_NORMALIZED = "estimate_advantage normalises over the batch; see make_value_estimator(average_gae=)"
_ESTIMATOR = "it belongs to loss.make_value_estimator"
_MSE = "the critic's loss is the mean squared error"
_APART = "actors and critic share no parameters"
_OTHERWISE = {
    "advantage_norm": _NORMALIZED,
    "average_gae": _ESTIMATOR,
    "clip_value": _MSE,
    "critic_coeff": "the critic has a loss of its own, so scale that",
    "delay_actor": "the ratio is to the policy that collected the batch",
    "functional": _APART,
    "gamma": _ESTIMATOR,
    "lmbda": _ESTIMATOR,
    "loss_critic_type": _MSE,
    "normalize_advantage": _NORMALIZED,
    "normalize_advantage_exclude_dims": _NORMALIZED,
    "separate_losses": _APART,
}

_CALLS_OF_GAE = (
    "deactivate_vmap",
    "num_chunk",
    "num_chunks",
    "skip_existing",
    "value_chunk_size",
    "vmap_randomness",
)
"""Options of how TorchRL's GAE calls the critic."""

# ----------------------------------------------------------------------- construction


def check_options(clip_epsilon: Any, entropy_coeff: Any, options: Mapping[str, Any]) -> None:
    """Refuse options that ``ClipPPOLoss`` would ignore or misread, or that HAPPO has no use for."""
    bounds = clip_epsilon if isinstance(clip_epsilon, (tuple, list)) else (clip_epsilon,)
    if not all(_is_number(bound) and bound > 0 for bound in bounds):
        raise ValueError(f"clip_epsilon={clip_epsilon!r} is not allowed: it must be positive")
    if not _is_number(entropy_coeff) or not 0 <= entropy_coeff < math.inf:
        raise ValueError(
            f"entropy_coeff={entropy_coeff!r} is not allowed: it must be at least 0, and finite"
        )
    for name, value in options.items():
        if name not in ACTOR_OPTIONS:
            reason = _OTHERWISE.get(name, f"those of an actor are {list(ACTOR_OPTIONS)}")
            raise ValueError(f"{name}={value!r} is not an option of HAPPOLoss: {reason}")


def _is_number(value: Any) -> bool:
    """Whether it is a number or a tensor of one."""
    one = isinstance(value, Tensor) and value.numel() == 1
    return one or (isinstance(value, (int, float)) and not isinstance(value, bool))


def state_keys(actor: nn.Module) -> list[NestedKey]:
    """Entries that a recurrent actor carries from step to step; none for other actors."""
    memories = [part for part in actor.modules() if isinstance(part, (LSTMModule, GRUModule))]
    return [key for part in memories for key in part.in_keys[1:-1]]  # input, states, "is_init"


def check_reuse(critic: nn.Module, options: Iterable[str]) -> None:
    """Refuse critics whose values cannot be reused, and options of how GAE calls the critic."""
    if state_keys(critic):
        raise ValueError(
            "reuse_values=True is not allowed: the critic is recurrent, so the value of an "
            "observation depends on the steps before"
        )
    for option in options:
        if option in _CALLS_OF_GAE:
            raise ValueError(
                f"{option} is not allowed with reuse_values=True: it is for values that GAE "
                "evaluates itself"
            )


def check_parts(actors: Mapping[str, Any], critic: Any | None, views: Mapping[str, View]) -> None:
    """Refuse actors, critics and views that do not fit together."""
    if not actors:
        raise ValueError("actors={} is empty: HAPPOLoss needs at least one actor")
    for name, actor in actors.items():
        if not isinstance(name, str) or not name or "." in name or hasattr(nn.ModuleDict, name):
            raise ValueError(
                f"actors: the name {name!r} is not allowed: it becomes part of the keys of "
                "state_dict, so it must be a string without dots that no nn.ModuleDict has a "
                "method of"
            )
        _check_actor(name, actor)
    for name, view in views.items():
        if name not in actors:
            raise ValueError(f"views[{name!r}] belongs to no actor: they are {list(actors)}")
        _check_view(name, view, actors[name].in_keys)
    if critic is not None and not (hasattr(critic, "in_keys") and hasattr(critic, "out_keys")):
        raise ValueError(
            f"critic is a {type(critic).__name__}, which reads no TensorDict: wrap it, as in "
            "TensorDictModule(critic, in_keys=['state'], out_keys=['state_value'])"
        )
    _check_one_actor_per_agent(actors, views)
    _check_parameters([*actors.items(), ("critic", critic)])


def _check_actor(name: str, actor: Any) -> None:
    if not (hasattr(actor, "get_dist") and hasattr(actor, "in_keys")):
        raise ValueError(
            f"actors[{name!r}] is a {type(actor).__name__}, which has no distribution of actions: "
            "HAPPOLoss needs a ProbabilisticActor or a ProbabilisticTensorDictSequential"
        )
    heads = [part for part in actor.modules() if isinstance(part, ProbabilisticTensorDictModule)]
    actions = [key for head in heads for key in head.dist_sample_keys]
    if len(actions) > 1:
        raise ValueError(
            f"actors[{name!r}] writes the actions {actions}: HAPPOLoss needs one entry per actor, "
            "so concatenate them, or make an actor for each"
        )
    if heads and not heads[-1].return_log_prob:
        raise ValueError(
            f"actors[{name!r}] writes no log-probability of its action {actions[0]!r}, which the "
            "ratio is made of: build it with return_log_prob=True"
        )


def _check_view(name: str, view: Any, keys: Iterable[NestedKey]) -> None:
    fits = isinstance(view, tuple) and len(view) == 2
    agents = agents_of(view) if fits else ()
    valid = all(isinstance(i, int) and not isinstance(i, bool) and i >= 0 for i in agents)
    if not agents or not valid or len(set(agents)) < len(agents):
        raise ValueError(
            f"views[{name!r}]={view!r} is not allowed: it must be (group, index), with an index "
            "of 0 or more, or a tuple of different ones"
        )
    if not any(in_group(key, view[0]) for key in keys):
        raise ValueError(f"views[{name!r}] is of the group {view[0]!r}, but it reads {keys}")


def _check_one_actor_per_agent(actors: Mapping[str, Any], views: Mapping[str, View]) -> None:
    """An agent's ratio must not enter the factor twice."""
    owners: list[tuple[str, Any, View | None]] = []
    for name, actor in actors.items():
        actions = getattr(actor, "dist_sample_keys", None)
        view = views.get(name)
        for other, theirs, seen in owners:
            if actions is not None and actions == theirs and _meet(view, seen):
                raise ValueError(
                    f"{other!r} and {name!r} both act for {actions[0]!r}: give each actor its own "
                    "agent, by views={actor: (group, index)} or group_map=env.group_map"
                )
        owners.append((name, actions, view))


def _meet(one: View | None, other: View | None) -> bool:
    """Whether two views of the same entry have an agent in common; None has all."""
    if one is None or other is None:
        return True
    return unravel_key(one[0]) == unravel_key(other[0]) and bool(
        {*agents_of(one)} & {*agents_of(other)}
    )


def _check_parameters(parts: Iterable[tuple[str, Any]]) -> None:
    owners: dict[int, tuple[str, Any]] = {}
    for name, part in parts:
        for parameter in part.parameters() if part is not None else ():
            owner, first = owners.setdefault(id(parameter), (name, part))
            if (owner, first) != (name, part):
                raise ValueError(
                    f"{owner!r} and {name!r} share parameters: an update of one would move the "
                    "other"
                )


# ---------------------------------------------------------------------------- batches


def check_batch(batch: TensorDictBase) -> None:
    """Refuse batches without samples, and with padding, which the losses would include."""
    if 0 in batch.batch_size:
        raise ValueError(f"the batch of shape {[*batch.batch_size]} has no samples")
    if batch.get(("collector", "mask"), None) is not None:
        raise ValueError(
            "the batch holds ('collector', 'mask'): padded trajectories are not supported, "
            "collect with split_trajs=False"
        )


def check_rows(own: TensorDictBase, states: Iterable[NestedKey], name: str) -> None:
    """Refuse entries over which a recurrent actor would not be unrolled in time."""
    for key in states:
        if own.ndim < 2:
            raise ValueError(
                f"actor {name!r} is recurrent and the batch has the shape {[*own.shape]}: it needs "
                "whole rows [*B, T] of a rollout, so do not flatten it"
            )
        state = own.get(key)
        if state.ndim != own.ndim + 2:
            raise ValueError(
                f"actor {name!r} is recurrent and its state {key!r} has shape {[*state.shape]}, "
                "not [*B, layers, numbers]: it must act for one agent, so give it a view"
            )


def read(batch: TensorDictBase, key: NestedKey, remedy: str) -> Tensor:
    """An entry of a batch; an error says what to do if it is missing."""
    value: Tensor | None = batch.get(key, None)
    if value is None:
        raise ValueError(f"the batch has no entry {key!r}: {remedy}{_elsewhere(batch, key)}")
    return value


def select(batch: TensorDictBase, keys: list[NestedKey], remedy: str) -> TensorDictBase:
    """Entries of a batch, as they are nested; an error says what to do if one is missing."""
    try:
        return batch.select(*keys)
    except KeyError:
        for key in keys:
            read(batch, key, remedy)
        raise


def read_column(batch: TensorDictBase, key: NestedKey, remedy: str) -> Tensor:
    """An entry of shape [*B, 1]: other shapes would be broadcast."""
    value = read(batch, key, remedy)
    require_column(value, batch, key)
    return value


def require_column(value: Tensor, batch: TensorDictBase, key: NestedKey) -> None:
    """Refuse a tensor that is not [*B, 1]."""
    if value.shape != (*batch.batch_size, 1):
        raise ValueError(
            f"{key!r} has shape {[*value.shape]}, but must have {[*batch.batch_size, 1]}: one "
            "number of the team for each sample"
        )


def require_finite(value: Tensor, what: str) -> None:
    """Refuse a tensor with NaN or infinity."""
    finite = value.isfinite()
    if not finite.all():
        raise FloatingPointError(
            f"{what} is not finite in {int((~finite).sum())} of {value.numel()} samples"
        )


def check_log_prob(batch: TensorDictBase, action: Tensor, log_prob: Tensor, key: NestedKey) -> None:
    """Refuse log-probabilities [*B, ...] with axes that the action does not have."""
    dims = log_prob.ndim
    if dims < batch.ndim or log_prob.shape != action.shape[:dims]:
        raise ValueError(
            f"the log-probability {key!r} has shape {[*log_prob.shape]}, which does not fit the "
            f"action's {[*action.shape]} in a batch of shape {[*batch.batch_size]}"
        )


def _elsewhere(batch: TensorDictBase, key: NestedKey) -> str:
    """Where the batch has entries of the same name."""

    def last(other: NestedKey) -> str:
        return other if isinstance(other, str) else str(other[-1])

    found = {k: [*batch.get(k).shape] for k in batch.keys(True, True) if last(k) == last(key)}
    listed = ", ".join(f"{k!r} {shape}" for k, shape in found.items())
    return f" (the batch has {listed})" if found else ""
