"""Ray clusters: joined by address, or started on this machine."""

from __future__ import annotations

import socket
from importlib.util import find_spec
from typing import Any

from marl_explore.config.run import RunConfig
from marl_explore.training.workers import WorkerError

CONNECT_SECONDS = 10.0
"""How long a cluster's port may take to answer."""
TOKENS = (
    "if the cluster asks for a token, as Ray does by default since 2.60, set RAY_AUTH_MODE=token "
    "here too, with the cluster's token in ~/.ray/auth_token or RAY_AUTH_TOKEN; or start the "
    "cluster with RAY_AUTH_MODE=disabled"
)


def require_cluster(run: RunConfig) -> None:
    """Join a run's cluster by its address, if it has one, so that a run without it is not begun.

    Raises:
        ValueError: naming the package to install, or an address at which nothing answers.
        WorkerError: as for ``connect``.
    """
    if find_spec("ray") is None:
        raise ValueError("collector='ray' needs the package ray: pip install ray")
    if run.ray_address is not None:
        _require_answer(run.ray_address)
        connect(run)


def _require_answer(address: str) -> None:
    if address in ("auto", "local") or "://" in address:
        return  # Ray itself finds out
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(f"ray_address={address!r} is not allowed: use auto or host:port")
    try:
        socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
    except (OSError, UnicodeError) as error:
        raise ValueError(
            f"ray_address={address!r} cannot be reached: {error}; is it what `ray start --head` "
            "printed?"
        ) from error


def connect(run: RunConfig) -> None:
    """Join a run's cluster, or start one on this machine, unless this process has joined one.

    Raises:
        WorkerError: when the cluster refuses, or has too few CPUs for the workers.
    """
    import ray

    if not ray.is_initialized():
        cluster: dict[str, Any] = {"num_cpus": run.workers, "include_dashboard": False}
        if run.ray_address is not None:
            cluster = {"address": run.ray_address}
        try:
            ray.init(log_to_driver=False, **cluster)
        except (OSError, RuntimeError, ValueError) as error:
            if run.ray_address is None:
                raise WorkerError(f"Ray does not start: {error}") from error
            raise WorkerError(
                f"ray_address={run.ray_address!r} cannot be joined: {error}; {TOKENS}"
            ) from error
    cpus = ray.cluster_resources().get("CPU", 0)
    if cpus < run.workers:
        raise WorkerError(f"Ray has {cpus:g} CPUs, too few for workers={run.workers}")
