"""Faults on purpose: killed processes, full disks, damaged files and wrong command lines.

python -m benchmarks.faults [kills] [sweeps] [disks] [mutants] [lines]   (all; half an hour)

Disks take root, and damaged recordings the extra "ros".

Every part prints what it did and what broke, and the program ends with status 1 if anything did.
"""
