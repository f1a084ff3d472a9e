"""Add the policies of runs to the package: the same as ``marl-explore bundle``.

marl_explore/cli/bundle.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("bundle")
