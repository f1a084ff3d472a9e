"""Train a team: the same as ``marl-explore train``.

marl_explore/cli/train.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("train")
