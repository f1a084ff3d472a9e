"""Simulate robots with wheels and lidars: the same as ``marl-explore lab``.

marl_explore/cli/lab.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("lab")
