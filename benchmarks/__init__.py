"""Speed measurements: ratios within one run, printed as tables."""
