"""Compare training runs with a baseline, over seeds: the same as ``marl-explore variants``.

marl_explore/cli/variants.py is what runs.
"""

from marl_explore import run_command

if __name__ == "__main__":
    run_command("variants")
