"""Study: how close are the renders of a sensor to its real frames? It includes the two-sample test."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenes import SensorSpec
from training.data.two_sample import SMALL, TwoSample, accuracy_text, evaluate_classifiers, evaluate_halves
from twin.errors import OptionError, format_count
from twin.evaluation.pictures.realism import run_realism
from twin.progress import Progress, Step, silent
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
        spots = found["spots"]
        lines.append(
            f"spectra differ by {found['spectrum_db']:.2f} dB; {spots['paired']} of {spots['real']} bright spots have a counterpart"
        )
        lines.append(f"all pins found in {100 * metrics['pin_aligned']['exact_fraction']:.1f} % of the renders")
        for name, made in metrics["two_sample"].items():
            lines.append(f"two-sample accuracy, {name}: {accuracy_text(**made)}")
        if poses := metrics["pose_aligned"]:
            error = poses["pin_error_px"]
            lines.append(
                f"pin error from the labels: {error['test']:.2f} px on unseen frames ({error['fitted']:.2f} px on the fitted ones)"
            )
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
    fitted, without
        As in ``run_realism``.
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
    asked = (_thorough if thorough else _quick) if test else None
    found = run_realism(
        frames,
        sensor,
        out,
        with_poses=pose_aligned,
        limit=limit,
        fitted=fitted,
        without=without,
        quality=quality,
        test=asked,
        progress=progress,
    )
    return Realism(*found)


def _quick(real: list[np.ndarray], rendered: list[np.ndarray], inside: np.ndarray, step: Step) -> dict[str, TwoSample]:
    return evaluate_classifiers(real, rendered, inside, judges={"small": SMALL}, progress=step)


def _thorough(real: list[np.ndarray], rendered: list[np.ndarray], inside: np.ndarray, step: Step) -> dict[str, TwoSample]:
    halves = evaluate_halves(real, inside, progress=step)
    return evaluate_classifiers(real, rendered, inside, progress=step) | {f"{name}, real halves": made for name, made in halves.items()}


def _image_line(title: str, count: int, images: dict[str, Any]) -> str:
    mean = {name: images[name]["mean"] for name in IMAGES}
    return (
        f"{title}, {format_count(count, 'frames')}: PSNR {mean['psnr_db']:.2f} dB (gray {mean['psnr_gray_db']:.2f}), "
        f"SSIM {mean['ssim']:.3f} (gray {mean['ssim_gray']:.3f}), FLIP {mean['flip']:.3f}; whole frame {mean['psnr_whole_db']:.2f} dB"
    )
