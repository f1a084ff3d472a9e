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

from marl_explore.config.fields import read_fields
from marl_explore.policies.networks.base import CriticInput, Network
from marl_explore.policies.networks.cnn import CNN
from marl_explore.policies.networks.deepset import DeepSet
from marl_explore.policies.networks.goals import Goals
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
    "Goals",
    "Network",
    "NetworkSettings",
    "network_from_json",
]

NETWORKS: dict[str, type[Network]] = {kind.name: kind for kind in (MLP, CNN, DeepSet, Goals)}
"""Every kind of network by name."""


def network_from_json(name: object, options: object, where: str = "settings") -> Network:
    """The network with this name and these options, the inverse of ``Network.to_json``.

    Args:
        name: one of ``NETWORKS``.
        options: a JSON object.
        where: what holds them, such as a file, for error messages.

    Raises:
        ValueError: for an unknown name or option, and for options of a wrong type or out of range.
    """
    if not isinstance(name, str) or name not in NETWORKS:
        raise ValueError(f"{where}: network={name!r} is not allowed: use one of {sorted(NETWORKS)}")
    return read_fields(NETWORKS[name], options, f"{where}, options of {name}")


class NetworkSettings:
    """Dataclasses of settings with an arena and a network, which can be written as JSON."""

    network: Network

    def to_json(self) -> dict[str, Any]:
        """The settings as JSON values, the network as its name and its options."""
        return asdict(self) | self.network.to_json()  # type: ignore[call-overload]

    @classmethod
    def from_json(cls, values: Mapping[str, Any], where: str = "settings") -> Self:
        """The inverse of ``to_json``.

        Raises:
            ValueError: naming ``where`` and the field, when the values are not such settings.
        """
        rest = dict(values)
        network = network_from_json(rest.pop("network", None), rest.pop("options", None), where)
        return read_fields(cls, {**rest, "network": network}, where)
