"""The complete comparison of a folder of real frames with their renders, with its results in one folder."""

from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scenes.sensor import SensorSpec
from twin.camera.projection import lens_disc
from twin.evaluation.pictures import report
from twin.evaluation.pictures.compare import fixed_residual, pin_aligned, pose_aligned, statistics
from twin.evaluation.pictures.frames import FEW_LOST, read_real
from twin.optics.relief import without as plain_of
from twin.progress import Progress, Step, silent, stage
from twin.store import made_by, write_json
from twin.types import Quality

# Two-sample tests: ``test(real images, rendered images, inside, progress)`` gives their results by name, each with the fraction
# of correctly classified patches as ``accuracy``, and the ends of its 95 % interval as ``low`` and ``high``.
Test = Callable[[list[np.ndarray], list[np.ndarray], np.ndarray, Step], Mapping[str, Any]]


def run_realism(
    folder: Path,
    spec: SensorSpec,
    out: Path,
    *,
    with_poses: bool = False,
    limit: int | None = None,
    fitted: int = 0,
    without: Collection[str] = (),
    quality: Quality = "standard",
    test: Test | None = None,
    progress: Progress = silent,
) -> tuple[dict[str, Any], list[Path]]:
    """Compare real frames with their renders, and write all results.

    Parameters
    ----------
    folder : Path
        Raw frames, with ``targets.csv`` if the labels are needed.
    spec : SensorSpec
    out : Path
    with_poses : bool
        Whether frames are also rendered from the labels alone.
    limit : int, optional
        Largest number of frames; they are evenly distributed over the folder.
    fitted : int
        Limit with which ``calibrate_optics`` was run. The frames to which it fitted are omitted.
    without : collection of str
        Details that are not rendered (`twin.optics.relief.without`).
    quality : {"rasterised", "preview", "standard", "high"}
    test : callable, optional
        The two-sample tests.
    progress : Progress

    Returns
    -------
    metrics : dict
        Content of metrics.json.
    written : list of Path
        The files, the page first.

    Raises
    ------
    FrameError
        No frame can be used, or the labels are missing.
    RenderError
        The renderer does not work on this machine.
    """
    spec = plain_of(spec, without)
    disc, bar = lens_disc(spec.view, spec.housing), partial(stage, progress)
    with bar("read the real frames, find their pins") as step:
        real = read_real(folder, spec, disc, limit=limit, fitted=fitted, lost=0.0 if with_poses else FEW_LOST, progress=step)
    with bar("fit the skin to the pins, render") as step:
        pairs = pin_aligned(spec, real.frames, disc, quality=quality, progress=step)
    poses = pose_aligned(spec, real.frames, disc, quality=quality, bar=bar) if with_poses else None
    with bar("measure caps, skin, noise, spectra") as step:
        found = statistics(pairs, disc, spec.pipeline.raw.polarity, progress=step)
    outcome: Mapping[str, Any] = {}
    if test is not None and len(pairs) > 1:
        with bar("train the two-sample test") as step:
            outcome = test([pair.real.frame.image for pair in pairs], [pair.image for pair in pairs], disc.inside, step)
    metrics = {
        "sensor": spec.name,
        "quality": quality,
        "frames": len(pairs),
        "fitted": fitted,
        "without": sorted(without),
        "refused": real.refused,
        "disc": {"center_px": disc.center_px.tolist(), "radius_px": disc.radius_px},
        "pin_aligned": report.image_summary(pairs),
        "fixed_residual": fixed_residual(spec, pairs),
        "statistics": report.statistics_summary(found),
        "two_sample": {name: {"accuracy": told.accuracy, "low": told.low, "high": told.high} for name, told in outcome.items()},
        "pose_aligned": poses and report.pose_summary(poses),
    }
    pictures = out / "pictures"
    rows = report.write_pictures(pictures, pairs, "pins")
    pose_rows = report.write_pictures(pictures, poses.pairs, "pose") if poses else []
    page = report.write_page(out / "index.html", spec, metrics, report.write_plots(pictures, found), rows, pose_rows, found)
    numbers = write_json(out / "metrics.json", metrics | {"made_by": made_by(report.__name__)})
    return metrics, [page, numbers, *report.write_tables(out, pairs, found, poses)]
