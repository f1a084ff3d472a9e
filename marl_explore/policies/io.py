"""Policy files: safetensors, with metadata that describe how to build the networks.

They hold only weights; nothing in them is executed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import safe_open
from safetensors.torch import save_file

from marl_explore.policies.migrate import migrated
from marl_explore.policies.policy import Policy, PolicyConfig
from marl_explore.utils.files import atomic_write
from marl_explore.utils.tensor_files import read_tensors

FORMAT = "marl_explore.policy/1"
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
    metadata = {
        "format": FORMAT,
        "spec": json.dumps(policy.config.to_json()),
        "info": json.dumps(dict(info or {})),
    }
    weights = {name: tensor.contiguous() for name, tensor in policy.actors.state_dict().items()}
    if not path.parent.is_dir():
        raise ValueError(f"cannot save a policy to {path}: the folder does not exist")
    with atomic_write(path) as unfinished:
        save_file(weights, unfinished, metadata)
    return path


def load_policy(path_or_name: str | Path) -> Policy:
    """The policy in a file or run folder, or a bundled one by name (``list_policies``).

    Raises:
        ValueError: when there is no such policy, or the file is not a policy.
    """
    path = _find(path_or_name)
    metadata, weights = read_tensors(path, FORMAT, "policy")
    try:
        config = PolicyConfig.from_json(migrated(json.loads(metadata["spec"])))
        policy = Policy(config, config.make_actors())
        policy.actors.load_state_dict(weights)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} is not a complete policy: {error!r}") from error
    return policy.eval()


def policy_info(path_or_name: str | Path) -> dict[str, Any]:
    """The information that was saved with a policy."""
    with safe_open(_find(path_or_name), framework="pt") as file:
        info: dict[str, Any] = json.loads((file.metadata() or {}).get("info", "{}"))
    return info | {"config": migrated(info["config"])} if "config" in info else info


def policy_digest(path_or_name: str | Path) -> str:
    """SHA-256 of a policy's file."""
    return hashlib.sha256(_find(path_or_name).read_bytes()).hexdigest()


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
