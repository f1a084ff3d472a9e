"""Compare policies on test arenas: the same as ``marl-explore evaluate``.

marl_explore/cli/evaluate.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("evaluate")
