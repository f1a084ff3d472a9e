"""Packages that not everybody installs: where one is missing, the error says how to install it."""

from __future__ import annotations

from importlib.util import find_spec

_INSTALL = {
    "benchmarl": 'docs/happo.md ("In BenchMARL") says how to install it',
    "onnx": 'pip install "marl-explore[export]"',
    "onnxscript": 'pip install "marl-explore[export]"',
    "rosbags": 'pip install "marl-explore[ros]"',
    "vmas": 'pip install "marl-explore[lab]"',
}


def require_extra(*packages: str) -> None:
    """Raise an error if an optional package is missing; nothing is imported.

    Raises:
        ModuleNotFoundError: saying how to install it.
    """
    for package in packages:
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"this needs {package}: {_INSTALL[package]}", name=package)
