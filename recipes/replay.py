"""Write episodes as one page for any browser: the same as ``marl-explore replay``.

marl_explore/cli/replay.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("replay")
