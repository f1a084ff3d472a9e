"""Train for two minutes, compare with planners, draw: the same as ``marl-explore demo``.

marl_explore/cli/demo.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("demo")
