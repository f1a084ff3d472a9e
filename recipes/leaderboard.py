"""Compare policies on suites of test arenas: the same as ``marl-explore leaderboard``.

marl_explore/cli/leaderboard.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("leaderboard")
