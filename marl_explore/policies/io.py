"""Policy files: safetensors, with metadata that describe how to build the networks.

They hold only weights, and a SHA-256 of their contents; nothing in them is executed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from marl_explore.policies.migrate import migrated
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.utils.files import file_digest
from marl_explore.utils.json_files import parse_object
from marl_explore.utils.memory import require_memory
from marl_explore.utils.tensor_files import read_tensors, write_tensors

FORMAT = "marl_explore.policy/2"
FORMAT_0_1 = "marl_explore.policy/1"
"""That of version 0.1, without SHA-256."""
POLICY_FILE = "policy.safetensors"
BUNDLED = Path(__file__).parent / "pretrained"


def save_policy(policy: Policy, path: str | Path, info: Mapping[str, Any] | None = None) -> Path:
    """Write a policy to a file, or to ``policy.safetensors`` in a folder.

    Args:
        policy: the team.
        path: a file ending in .safetensors, or an existing folder.
        info: where the policy comes from (seed, command, scores); kept with the weights.
    """
    path = _file_of(Path(path))
    texts = {"spec": json.dumps(policy.config.to_json()), "info": json.dumps(dict(info or {}))}
    if not path.parent.is_dir():
        raise ValueError(f"cannot save a policy to {path}: the folder does not exist")
    write_tensors(path, FORMAT, texts, policy.actors.state_dict())
    return path


def load_policy(path_or_name: str | Path) -> Policy:
    """The policy in a file or run folder, or a bundled one by name (``list_policies``).

    Raises:
        ValueError: when there is no such policy, or the file is not a policy, is damaged, or holds
            weights that are not finite floating-point numbers.
    """
    path = _find(path_or_name)
    texts, weights = _read(path)
    spec = migrated(parse_object(texts["spec"], f"the spec of {path}"))
    config = PolicyConfig.from_json(spec, f"the spec of {path}")
    require_memory(f"the policy {path}", config.weights_memory)
    require_weights(weights, str(path))
    policy = Policy(config, config.make_actors())
    try:
        policy.actors.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(f"the weights of {path} do not fit its spec: {error}") from error
    return policy.eval()


def policy_info(path_or_name: str | Path) -> dict[str, Any]:
    """The information that was saved with a policy.

    Raises:
        ValueError: as for ``load_policy``.
    """
    path = _find(path_or_name)
    info = parse_object(_read(path)[0]["info"], f"the info of {path}")
    if "config" not in info:
        return info
    if not isinstance(info["config"], dict):
        raise ValueError(f"the info of {path} has a config that is not a JSON object")
    return info | {"config": migrated(info["config"])}


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    texts, weights = read_tensors(path, (FORMAT, FORMAT_0_1), "policy", unsigned=(FORMAT_0_1,))
    for name in ("spec", "info"):
        if name not in texts:
            raise ValueError(f"{path} is not a complete policy: it has no {name}")
    return texts, weights


def require_weights(weights: Mapping[str, Tensor], where: str) -> None:
    """Raise an error for weights that are not finite floating-point numbers.

    Args:
        weights: tensors by name.
        where: the file or policy that has them.

    Raises:
        ValueError: naming ``where`` and the tensor.
    """
    for name, tensor in weights.items():
        if not tensor.is_floating_point():
            raise ValueError(f"{name} of {where} has the type {tensor.dtype}, not floating-point")
        if not torch.isfinite(tensor.float()).all():
            raise ValueError(f"{name} of {where} is not finite: it has NaN or infinite weights")


def policy_digest(path_or_name: str | Path) -> str:
    """SHA-256 of a policy's file."""
    return file_digest(_find(path_or_name))


def list_policies() -> list[str]:
    """Names of the policies that come with the package."""
    return sorted(file.name.removesuffix(".safetensors") for file in BUNDLED.glob("*.safetensors"))


def _file_of(path: Path) -> Path:
    return path / POLICY_FILE if path.is_dir() else path


def _find(path_or_name: str | Path) -> Path:
    bundled = BUNDLED / f"{path_or_name}.safetensors"
    path = bundled if bundled.is_file() else _file_of(Path(path_or_name))
    if not path.is_file():
        raise ValueError(
            f"no policy {str(path_or_name)!r}: it is neither a file, nor a run folder with "
            f"{POLICY_FILE}, nor one of the bundled policies {list_policies()}"
        )
    return path
