"""Small helpers: atomic file writes, tables, records of runs, signals.

Any module may import them; they import nothing else from the package.
"""
