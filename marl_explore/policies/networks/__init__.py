"""Kinds of networks, each with one file and one row of ``NETWORKS``.

Networks are plain modules on parts of the observation, which an actor names in ``inputs``. For the
paper's networks these are float [*B, 2k+1, 2k+1], [*B, 8, 3] and [*B, N] (FOV, FPR, NET); a critic
reads the same with a robot axis after ``*B``. Outputs are float32, also under autocast, so that
losses are computed in full precision.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from marl_explore.config.arena import ArenaConfig
from marl_explore.policies.networks.base import CriticInput, Network
from marl_explore.policies.networks.cnn import CNN
from marl_explore.policies.networks.deepset import DeepSet
from marl_explore.policies.networks.inputs import OBSERVATION_KEYS, PAPER_INPUTS
from marl_explore.policies.networks.mlp import MLP

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "CNN",
    "MLP",
    "NETWORKS",
    "OBSERVATION_KEYS",
    "PAPER_INPUTS",
    "CriticInput",
    "DeepSet",
    "Network",
    "NetworkSettings",
    "network_from_json",
]

NETWORKS: dict[str, type[Network]] = {kind.name: kind for kind in (MLP, CNN, DeepSet)}
"""Every kind of network by name."""


def network_from_json(name: str, options: Mapping[str, Any]) -> Network:
    """The network with this name and these options, the inverse of ``Network.to_json``.

    Raises:
        ValueError: for an unknown name or option, and for options out of range.
    """
    if name not in NETWORKS:
        raise ValueError(f"network={name!r} is not allowed: use one of {sorted(NETWORKS)}")
    kind = NETWORKS[name]
    unknown = set(options) - set(kind.option_names())
    if unknown:
        raise ValueError(
            f"network={name!r} has no option {min(unknown)!r}: it has {kind.option_names()}"
        )
    values: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in options.items()
    }
    return kind(**values)


class NetworkSettings:
    """Dataclasses of settings with an arena and a network, which can be written as JSON."""

    network: Network

    def to_json(self) -> dict[str, Any]:
        """The settings as JSON values, the network as its name and its options."""
        return asdict(self) | self.network.to_json()  # type: ignore[call-overload]

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Self:
        """The inverse of ``to_json``.

        Raises:
            KeyError, TypeError, ValueError: when the fields are not such settings.
        """
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in fields.items()
        }
        network = network_from_json(values["network"], values.pop("options"))
        return cls(**values | {"arena": ArenaConfig(**values["arena"]), "network": network})
