"""The command ``marl-explore``: one module per subcommand, each with ``parse`` and ``run``.

No lower layer imports it; recipes use ``marl_explore.run_command`` and ``run_program``.
"""
