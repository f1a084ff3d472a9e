"""Faults on purpose: killed processes, full disks, damaged files and wrong command lines.

python -m benchmarks.faults [kills] [sweeps] [disks] [mutants] [lines]   (all; half an hour)

Every part prints what it did and what broke, and the program ends with status 1 if anything did.
"""
