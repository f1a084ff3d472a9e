"""A cluster that ``ray start --head`` starts, joined by its address as users do."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from marl_explore.config.run import RunConfig
from marl_explore.training.clusters import require_cluster
from marl_explore.utils.locks import LOCK_FILE

OPTIONS = (
    "paper-mlp-case2 --height 6 --width 6 --num-agents 2 --hidden 8 8 --episodes 8 --num-envs 4 "
    "--episode-steps 10 --rollout-steps 10 --validate-every 0 --collector ray --workers 2"
).split()


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    folder = tmp_path_factory.mktemp("home")
    (folder / ".ray").mkdir()
    (folder / ".ray" / "auth_token").write_text("0123456789abcdef" * 4)
    return folder


@pytest.fixture(scope="module")
def address(home):
    port = free_port()
    words = f"start --head --port {port} --num-cpus 2 --include-dashboard false --block".split()
    command = [Path(sys.executable).with_name("ray"), *words, "--disable-usage-stats"]
    head = subprocess.Popen(
        command,
        env=environment(home, RAY_AUTH_MODE="token"),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    for line in head.stdout:
        if "Ray runtime started" in line:
            break
    yield f"127.0.0.1:{port}"
    head.send_signal(signal.SIGTERM)
    head.communicate(timeout=60)


def environment(home, **more):
    """This process's, without what it says of Ray, and with another home for the token."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    return kept | {"HOME": str(home)} | more


def train(folder, address, env):
    words = [sys.executable, "-m", "marl_explore", "train", *OPTIONS]
    words += ["--ray-address", address, "--out", str(folder)]
    return subprocess.run(words, env=env, capture_output=True, text=True, timeout=120)


def test_a_run_joins_the_cluster_with_its_token(home, address, tmp_path):
    done = train(tmp_path / "run", address, environment(home, RAY_AUTH_MODE="token"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "policy.safetensors").is_file()
    assert (tmp_path / "run" / LOCK_FILE).is_file()


def test_without_the_token_one_message_says_what_to_do(address, tmp_path):
    start = time.monotonic()
    refused = train(tmp_path / "run", address, environment(tmp_path))
    assert refused.returncode == 1
    last = refused.stderr.strip().splitlines()[-1]
    assert last.startswith(f"error: ray_address='{address}' cannot be joined")
    assert "RAY_AUTH_MODE=token" in last
    assert "Traceback" not in refused.stderr
    assert not (tmp_path / "run").exists()
    assert time.monotonic() - start < 110  # it waits for Ray, not forever


@pytest.mark.parametrize("address", ["127.0.0.1:{port}", "nowhere.invalid:6379", "here", "x:0"])
def test_an_address_where_nothing_answers_is_refused(address):
    named = address.format(port=free_port())
    with pytest.raises(ValueError, match=f"ray_address='{named}' (cannot be reached|is not allow)"):
        require_cluster(RunConfig(collector="ray", workers=1, ray_address=named))
