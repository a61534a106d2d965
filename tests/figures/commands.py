"""Wall times of commands, beside those of version 1.0.0 in the same run."""

from pathlib import Path

import bench_commands

from figures.jobs import Measured, Value, job


@job("commands.times", "python tests/bench/bench_commands.py", code=("bench_commands", "twin.cli"), minutes=10)
def command_times(work: Path) -> Measured:
    """Seconds of each command, and its ratio to the earlier release."""
    found = {}
    for (name, how), (present, earlier) in bench_commands.measure(bench_commands.AGAINST, bench_commands.REPEATS).items():
        key = f"{name}_{how.replace(' ', '_')}"
        found |= {f"{key}_s": Value(present, "s"), f"{key}_earlier_s": Value(earlier, "s"), f"{key}_ratio": Value(present / earlier)}
    return found
