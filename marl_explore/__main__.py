"""``python -m marl_explore``: the same as ``marl-explore``."""

from marl_explore.cli.main import main

if __name__ == "__main__":
    main()
