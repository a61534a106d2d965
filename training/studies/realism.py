"""Study: how close are the renders of a sensor to its real frames? It includes the two-sample test."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scenes import SensorSpec
from training.data.two_sample import SMALL, TwoSample, accuracy_text, evaluate_classifiers, evaluate_halves
from twin.camera.projection import lens_disc
from twin.errors import OptionError, format_count
from twin.evaluation.pictures import report
from twin.evaluation.pictures.aligned import FEW_LOST, read_real
from twin.evaluation.pictures.compare import fixed_residual, statistics
from twin.evaluation.pictures.compare import pin_aligned as align_pins
from twin.evaluation.pictures.compare import pose_aligned as align_poses
from twin.optics.relief import without as plain_of
from twin.progress import Progress, Step, silent, stage
from twin.store import writes
from twin.types import Quality, ReadableResult

IMAGES = ("psnr_db", "psnr_gray_db", "ssim", "ssim_gray", "flip", "psnr_whole_db")


@dataclass(frozen=True, repr=False)
class Realism(ReadableResult):
    """The result: all figures, as ``metrics.json`` holds them, and the files, the page first."""

    metrics: dict[str, Any]
    written: list[Path]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        metrics, found = self.metrics, self.metrics["statistics"]
        lines = [f"refused {refused['image_name']}: {refused['reason']}" for refused in metrics["refused"]]
        lines.append(_image_line("pin-aligned", metrics["frames"], metrics["pin_aligned"]))
        if fixed := metrics["fixed_residual"]:
            share = f"{100 * fixed['share']:.1f} % of its power is fixed to each cap"
            lines.append(f"on the caps the renders differ by {fixed['levels']:.2f} gray levels (rms); {share}")
        worst = ", ".join(f"{name} {100 * value:.1f} %" for name, value in found["worst_relative_difference"].items())
        lines.append(f"largest difference in a radial bin: {worst}")
        lines += [f"{name}: real {pair['real']:.2f}, rendered {pair['rendered']:.2f}" for name, pair in found["scalars"].items()]
        bright = "{paired} of {real} bright spots have a counterpart".format(**found["spots"])
        lines.append(f"spectra differ by {found['spectrum_db']:.2f} dB; {bright}")
        lines.append(f"all pins found in {100 * metrics['pin_aligned']['exact_fraction']:.1f} % of the renders")
        for name, made in metrics["two_sample"].items():
            lines.append(f"two-sample accuracy, {name}: {accuracy_text(**made)}")
        if poses := metrics["pose_aligned"]:
            unseen, fitted = (poses["pin_error_px"][part] for part in ("test", "fitted"))
            lines.append(f"pin error from the labels: {unseen:.2f} px on unseen frames ({fitted:.2f} px on the fitted ones)")
            lines.append(_image_line("pose-aligned, unseen", metrics["frames"] // 2, poses["test_images"]))
        return [*lines, _verdict(**found["target"])]


def _verdict(relative: float, met: dict[str, bool]) -> str:
    """Whether the caps look as the real ones do at every radius, and else what to do."""
    missed = [name.removesuffix("_px") for name, reached in met.items() if not reached]
    if not missed:
        return f"verdict: level, diameter and edges of the caps are within {100 * relative:.0f} % of the real ones at every radius"
    verb = "differ" if len(missed) > 1 else "differs"
    return (
        f"verdict: the caps' {', '.join(missed)} {verb} from the real ones by more than {100 * relative:.0f} % at some radius; "
        "'twin calibrate optics' fits them"
    )


@writes("index.html", "metrics.json", "frames.csv", "radial.csv", "spectrum.csv", "spots.csv", "pictures")
def compare_with_renders(
    frames: Path,
    sensor: SensorSpec,
    out: Path,
    *,
    pose_aligned: bool = False,
    limit: int | None = None,
    fitted: int = 0,
    without: Collection[str] = (),
    quality: Quality = "standard",
    test: bool = True,
    thorough: bool = False,
    progress: Progress = silent,
) -> Realism:
    """Compare a folder of real raw frames with their renders, and write the result to a folder.

    Parameters
    ----------
    pose_aligned : bool
        Also render from the labels alone.
    limit : int, optional
        Most frames that are used; they are spread evenly over the folder.
    fitted : int
        Limit with which ``calibrate_optics`` was run. The frames to which it fitted are omitted.
    without : collection of str
        Details that are not rendered (`twin.optics.relief.without`).
    quality : {"rasterised", "preview", "standard", "high"}
    test : bool
        Train the two-sample test (minutes).
    thorough : bool
        Also train a stronger network, and both on two halves of the real frames, where there is no difference (ten minutes).

    Raises
    ------
    FrameError
        No frame can be used, or the labels are missing.
    OptionError
        ``thorough`` without ``test``.
    RenderError
        Nothing can be rendered here.
    """
    if thorough and not test:
        raise OptionError("`thorough` adds to the two-sample test, but `two_sample=False` leaves it out; give one of them")
    spec = plain_of(sensor, without)
    disc, bar = lens_disc(spec.view, spec.housing), partial(stage, progress)
    with bar("read the real frames, find their pins") as step:
        real = read_real(frames, spec, disc, limit=limit, fitted=fitted, lost=0.0 if pose_aligned else FEW_LOST, progress=step)
    with bar("fit the skin to the pins, render") as step:
        pairs = align_pins(spec, real.frames, disc, quality=quality, progress=step)
    poses = align_poses(spec, real.frames, disc, quality=quality, bar=bar) if pose_aligned else None
    with bar("measure caps, skin, noise, spectra") as step:
        found = statistics(pairs, disc, spec.pipeline.raw.polarity, progress=step)
    outcome: dict[str, TwoSample] = {}
    if test and len(pairs) > 1:
        with bar("train the two-sample test") as step:
            outcome = _two_sample([pair.real.frame.image for pair in pairs], [pair.image for pair in pairs], disc.inside, thorough, step)
    metrics = {"sensor": spec.name, "quality": quality, "frames": len(pairs), "fitted": fitted, "without": sorted(without)} | {
        "refused": real.refused,
        "disc": {"center_px": disc.center_px.tolist(), "radius_px": disc.radius_px},
        "pin_aligned": report.image_summary(pairs),
        "fixed_residual": fixed_residual(spec, pairs),
        "statistics": report.statistics_summary(found),
        "two_sample": {name: {"accuracy": told.accuracy, "low": told.low, "high": told.high} for name, told in outcome.items()},
        "pose_aligned": poses and report.pose_summary(poses),
    }
    return Realism(metrics, report.write_results(out, spec, metrics, pairs, found, poses))


def _two_sample(real: list[np.ndarray], rendered: list[np.ndarray], inside: np.ndarray, thorough: bool, step: Step) -> dict[str, TwoSample]:
    """The two-sample tests of real and rendered images, by the names of the classifiers."""
    if not thorough:
        return evaluate_classifiers(real, rendered, inside, judges={"small": SMALL}, progress=step)
    halves = evaluate_halves(real, inside, progress=step)
    return evaluate_classifiers(real, rendered, inside, progress=step) | {f"{name}, real halves": made for name, made in halves.items()}


def _image_line(title: str, count: int, images: dict[str, Any]) -> str:
    mean = {name: images[name]["mean"] for name in IMAGES}
    return (
        f"{title}, {format_count(count, 'frames')}: PSNR {mean['psnr_db']:.2f} dB (gray {mean['psnr_gray_db']:.2f}), "
        f"SSIM {mean['ssim']:.3f} (gray {mean['ssim_gray']:.3f}), FLIP {mean['flip']:.3f}; whole frame {mean['psnr_whole_db']:.2f} dB"
    )
