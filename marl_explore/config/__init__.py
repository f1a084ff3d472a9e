"""Settings of arenas, robots and runs, and the constants of maps and actions.

Any module may import it; it imports nothing else from the package, and not torch.
"""
