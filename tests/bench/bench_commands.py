"""Time commands of this release beside those of an earlier commit, cold and warm, and data sets by two processes beside one.

Run: PYTHONPATH=. python tests/bench/bench_commands.py [--against ec452a2] [--repeats 3]. Both run in this environment,
each from its own tree of files, one command after the other. *Cold*: no compiled function lies anywhere; *warm*: the best of the
repeats.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).parents[2]
DATA = "--experiment surface-2d --sensor mg400-127 --images none"
COMMANDS = {
    "render": "render --sensor mg400-127 --object sphere --indent-mm 3 --quality {fast} --out {out}",
    "preprocess": "preprocess {frames} --sensor mg400-127 --out {out}",
}
FAST = {True: "rasterised", False: "drawn"}
"""Name of the quality in this release, and in the earlier."""
START = "from twin.cli import main; main()"
CONTACTS, FRAMES = 40, 100
AGAINST, REPEATS = "ec452a2", 3
"""Version 1.0.0, and runs of each warm command."""


def seconds(tree, line, *, caches):
    """Wall time of a command that runs in a tree of files, s."""
    variables = os.environ | {"PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(caches), "PYTHONDONTWRITEBYTECODE": "1"}
    start = perf_counter()
    subprocess.run([sys.executable, "-c", START, *line.split()], cwd=tree, env=variables, check=True, capture_output=True)
    return perf_counter() - start


def compare(trees, work, repeats):
    """Seconds of each command, cold and warm, by tree: dict of (name, how) to [present, earlier]."""
    frames, found = work / "frames", {}
    seconds(
        trees[0], f"dataset {DATA.replace('none', 'processed')} --count {FRAMES} --quality rasterised --out {frames}", caches=work / "any"
    )
    for name, line in COMMANDS.items():
        told = {"cold": [], "warm": []}
        for tree, present in zip(trees, (True, False), strict=True):
            caches, out = work / f"caches-{name}-{present}", work / "out"
            shutil.rmtree(caches, ignore_errors=True)
            times = []
            for _ in range(1 + repeats):
                shutil.rmtree(out, ignore_errors=True)
                times.append(seconds(tree, line.format(fast=FAST[present], out=out, frames=frames), caches=caches))
            told["cold"].append(times[0])
            told["warm"].append(min(times[1:]))
        found |= {(name, how): pair for how, pair in told.items()}
    return found


def share_work(trees, work):
    """Seconds of a data set by one process and by two, warm: dict of (name, how) to [present, earlier]."""
    found = {}
    for count, name in ((1, "first"), (1, "1 worker"), (2, "2 workers")):
        pair = []
        for tree in trees:
            out = work / "shared"
            shutil.rmtree(out, ignore_errors=True)
            line = f"dataset {DATA} --count {CONTACTS} --workers {count} --out {out}"
            pair.append(seconds(tree, line, caches=work / f"caches-{tree.name}"))
        found["dataset", name] = pair
    return {key: pair for key, pair in found.items() if key[1] != "first"}


def measure(against, repeats):
    """The table of all commands, beside those of a commit: dict of (name, how) to [present, earlier], s."""
    with tempfile.TemporaryDirectory() as folder:
        earlier = Path(folder) / "earlier"
        subprocess.run(["git", "-C", str(ROOT), "worktree", "add", "--quiet", "--detach", str(earlier), against], check=True)
        try:
            trees = (ROOT, earlier)
            return compare(trees, Path(folder), repeats) | share_work(trees, Path(folder))
        finally:
            subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(earlier)], check=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", default=AGAINST, help="commit of the earlier release")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    given = parser.parse_args()
    for (name, how), (present, before) in measure(given.against, given.repeats).items():
        print(f"{name:12}{how:12}{present:7.2f} s, earlier {before:7.2f} s, ratio {present / before:.2f}")
