"""Export a policy for robots: the same as ``marl-explore export``.

marl_explore/cli/export.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("export")
