"""Compare four policies with the paper's claims: the same as ``marl-explore paper``.

marl_explore/cli/paper.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("paper")
