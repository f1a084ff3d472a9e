"""Settings of arenas, robots, training and runs, and what numbers in maps and actions mean.

Import its modules from anywhere; it imports nothing of the package, and no torch.
"""
