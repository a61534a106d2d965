"""``python -m figures --same-as COMMIT``: keep figures whose code was moved or renamed, if both states compute the same, bit for bit.

Each sample is a few commands that both states of the code run; they stand for the families of figures that rest on what they compute.
A family is kept if all its samples are equal, and a figure of it if it was kept at that commit. Nothing else is: where numbers change,
measure.
"""

import csv
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from safetensors.numpy import load_file

from figures.jobs import FIGURES, JOBS, ROOT, FiguresError, _write, key_of, read, real_folder

TWIN = "from twin.cli import main; main()"
ROLLOUT = """
import sys, numpy as np, gymnasium
import training.environments
rows = []
for task in ("SurfaceFollow", "ObjectRoll"):
    env = gymnasium.make(f"tactip/{task}-v0", disable_env_checker=True)
    seen, _ = env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(12):
        rows.append(np.concatenate([np.ravel(part) for part in seen.values()])[:300])
        seen, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
np.savez(sys.argv[1] + "/rollout.npz", seen=np.array(rows))
"""
KEPT = """
import sys, json
sys.path[:0] = ["tests", "tests/helpers", "tests/bench"]
import figures.__main__
from figures.jobs import JOBS, is_kept
print(json.dumps([name for name, job in JOBS.items() if is_kept(job)]))
"""
CLOCKS = ("ms", "seconds", "time")
"""Beginnings and ends of the names of columns that hold times."""
CHARTS = ("panel.png", "errors.png", "skin.png")
"""Pictures that are drawn to be looked at. No figure is measured on them."""


@dataclass(frozen=True)
class Sample:
    """Commands, of which OUT, REAL and MADE (what the samples before made) stand for folders, and the families that rest on them."""

    families: tuple[str, ...]
    commands: tuple[tuple[str, ...], ...]


PICTURES, PINS, LEARNT = ("render", "robustness"), ("pins", "audit"), ("training", "intervals", "kinds")
TWINS = ("sim_to_real", "objects", "forces", "load_cell", "slip", "labels", "studio", "data", "servo")
SAMPLES = {
    **{
        f"contacts {sensor}": Sample(
            ("mechanics", "surrogate", *TWINS, *PICTURES),
            (
                ("dataset", "--experiment", "surface-2d", "--sensor", sensor, "--count", "3", "--seed", "1", "--images", "raw")
                + ("--workers", "1", "--randomise", "contact", "--out", "OUT"),
            ),
        )
        for sensor in ("mg400-331", "mg400-127", "ur5-331")
    },
    "path-traced": Sample(
        PICTURES, (("render", "--sensor", "ur5-331", "--object", "edge", "--indent-mm", "2", "--quality", "preview", "--out", "OUT"),)
    ),
    **{
        f"pins {name}": Sample((*PINS, *LEARNT, *TWINS, *PICTURES), (("preprocess", f"REAL/{name}", "--sensor", sensor, "--out", "OUT"),))
        for name, sensor in (("tac-vgnn-331", "mg400-331"), ("tac-vgnn-127", "mg400-127"), ("ur5-331-edge-2d-tap", "ur5-331"))
    },
    **{
        f"poses {name}": Sample(
            (*LEARNT, "servo", "sim_to_real", "sure"), (("evaluate", sensor, "--data", f"REAL/{name}", "--rows", "all", "--out", "OUT"),)
        )
        for name, sensor in (("tac-vgnn-331", "mg400-331"), ("tac-vgnn-127", "mg400-127"))
    },
    "learning": Sample(
        ("training", "labels", "sim_to_real", "objects"),
        (
            ("train", "--model", "vgnn", "--sensor", "mg400-127", "--data", "REAL/tac-vgnn-127", "--target", "surface-2d", "--epochs", "1")
            + ("--out", "OUT"),
        ),
    ),
    "rollout": Sample(("environments", "policies", "baselines"), (("-c", ROLLOUT, "OUT"),)),
}
FRAMES = 40
"""Frames of a recording that a sample takes."""


@contextmanager
def _checkout(commit: str) -> Iterator[Path]:
    """A folder with the files of a commit."""
    folder = Path(tempfile.mkdtemp(prefix="same-"))
    git = ["git", "-C", str(ROOT), "worktree"]
    made = subprocess.run([*git, "add", "--detach", str(folder / "tree"), commit], capture_output=True, text=True)
    if made.returncode:
        raise FiguresError(f"{commit}: {made.stderr.strip().splitlines()[-1]}")
    try:
        yield folder / "tree"
    finally:
        subprocess.run([*git, "remove", "--force", str(folder / "tree")], capture_output=True)
        shutil.rmtree(folder, ignore_errors=True)


def _few_frames(folder: Path) -> Path:
    """Copies of the recordings with some of their frames, evenly spread."""
    for name in {part.removeprefix("REAL/") for sample in SAMPLES.values() for line in sample.commands for part in line if "REAL/" in part}:
        source, small = real_folder(name), folder / name
        small.mkdir(parents=True)
        if (source / "meta.json").is_file():
            shutil.copy(source / "meta.json", small)
        with (source / "targets.csv").open(newline="") as file:
            rows = list(csv.reader(file))
        column = next(k for k, title in enumerate(rows[0]) if "image" in title)
        chosen = rows[1 :: max(1, len(rows) // FRAMES)][:FRAMES]
        with (small / "targets.csv").open("w", newline="") as file:
            csv.writer(file).writerows([rows[0], *chosen])
        for picture in [Path(row[column]).name for row in chosen] + [path.name for path in source.rglob("init_0*")]:
            for found in source.rglob(picture):
                (small / found.relative_to(source).parent).mkdir(parents=True, exist_ok=True)
                shutil.copy(found, small / found.relative_to(source))
    return folder


def _run(tree: Path, sample: Sample, out: Path, real: Path) -> str:
    """Run a sample in a checkout; "" or what failed."""
    for line in sample.commands:
        arguments = [part.replace("OUT", str(out)).replace("REAL", str(real)) for part in line]
        out.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, *([] if line[0] == "-c" else ["-c", TWIN]), *arguments]
        environment = os.environ | {"PYTHONPATH": str(tree), "TACTIP_CACHE": str(out.parent / "cache")}
        done = subprocess.run(command, cwd=tree, capture_output=True, text=True, env=environment)
        if done.returncode:
            return (done.stderr.strip().splitlines() or ["no message"])[-1]
    return ""


def contents(path: Path) -> dict[str, np.ndarray]:
    """Arrays and columns of one file, without those that hold times."""
    if path.suffix in (".npz", ".npy"):
        found = np.load(path)
        return dict(found) if path.suffix == ".npz" else {"": found}
    if path.suffix == ".safetensors":
        return load_file(path)
    if path.suffix == ".png":
        return {"": cv2.imread(str(path), cv2.IMREAD_UNCHANGED)}
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    return {
        title: np.array(values) for title, *values in zip(*rows, strict=True) if not title.startswith(CLOCKS) and not title.endswith(CLOCKS)
    }


def differences(old: Path, new: Path) -> list[str]:
    """Files and arrays that both folders hold but that differ, and results that one of them lacks."""
    kinds = (".npz", ".npy", ".csv", ".png", ".safetensors")
    before, after = (
        {str(path.relative_to(side)) for path in side.rglob("*") if path.suffix in kinds and path.name not in CHARTS} for side in (old, new)
    )
    found = [f"{name}: not there" for name in sorted(before - after)]
    for name in sorted(before & after):
        first, second = contents(old / name), contents(new / name)
        found += [f"{name} {key}".rstrip() for key in first if key not in second or not _equal(first[key], second[key])]
    return found if before else ["nothing was written"]


def _equal(first: np.ndarray, second: np.ndarray) -> bool:
    return first.shape == second.shape and bool((first == second).all() or np.array_equal(first, second, equal_nan=first.dtype.kind == "f"))


def keep_same(commit: str, say: Callable[[str], object] = print) -> list[str]:
    """Compare the samples of a commit and of this tree, and keep the figures of families that are equal; their names."""
    changed: set[str] = set()
    with _checkout(commit) as tree, tempfile.TemporaryDirectory(prefix="same-") as folder:
        real = _few_frames(Path(folder) / "real")
        for name, sample in SAMPLES.items():
            sides = {side: Path(folder) / side / name.replace(" ", "-") for side in ("before", "after")}
            failed = [_run(at, sample, sides[side], real) for side, at in (("before", tree), ("after", ROOT))]
            apart = [text for text in failed if text] or differences(*sides.values())
            say(f"{name}: " + ("equal" if not apart else f"not equal: {', '.join(apart[:3])}"))
            if apart:
                changed.update(sample.families)
        environment = os.environ | {"PYTHONPATH": str(tree)}
        listed = subprocess.run([sys.executable, "-c", KEPT], cwd=tree, capture_output=True, text=True, env=environment)
        if listed.returncode:
            raise FiguresError(f"{commit}: {listed.stderr[-500:]}")
        kept_then, then = json.loads(listed.stdout), read(tree / "figures.json")
    tried, now = {family for sample in SAMPLES.values() for family in sample.families}, read()
    same = [
        name
        for name in kept_then
        if name in JOBS and JOBS[name].family in tried - changed and now.get(name, {}).get("figures") == then[name]["figures"]
    ]
    _write(FIGURES, now | {name: now[name] | key_of(JOBS[name]) | {"same_as": commit} for name in same})
    return same
