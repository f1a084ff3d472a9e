"""Run the parts that are named, or all."""

from __future__ import annotations

import sys

from benchmarks.faults import disks, kills, lines, mutants

PARTS = {
    "kills": lambda: kills.kill_runs(100),
    "sweeps": lambda: kills.kill_sweeps(20),
    "disks": disks.fill_disks,
    "mutants": lambda: mutants.mutate_files(300),
    "lines": lambda: lines.refuse_lines(400),
}


def main() -> None:
    wanted = sys.argv[1:] or [*PARTS]
    if unknown := set(wanted) - set(PARTS):
        sys.exit(f"error: {sorted(unknown)} are no parts: use {[*PARTS]}")
    faults = [fault for part in wanted for fault in PARTS[part]()]
    print(*faults, sep="\n")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
