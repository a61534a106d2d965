"""A whole calibration of camera and light: from a folder of frames to a specification and a page."""

from dataclasses import dataclass
from pathlib import Path

from scenes import SensorSpec
from twin.calibration.calibrate_optics import FRAMES, Calibration, fit_optics
from twin.calibration.report import write_page
from twin.errors import FrameError
from twin.progress import Progress, silent
from twin.sensor_file import write_sensor


@dataclass(frozen=True)
class OpticsCalibration:
    """What was fitted, and what was written: the specification first."""

    found: Calibration
    written: list[Path]

    def lines(self) -> list[str]:
        """What could not be told by the frames, and how near the twin came; for people."""
        before, after = self.found.before, self.found.after
        return [
            *(f"note: {note}" for note in self.found.notes),
            f"over the disc: PSNR {before['psnr_db']:.2f} -> {after['psnr_db']:.2f} dB, SSIM {before['ssim']:.3f} -> {after['ssim']:.3f}",
        ]


def calibrate_optics(
    frames: Path, sensor: SensorSpec, out: Path, *, limit: int = FRAMES, no_contact: Path | None = None, progress: Progress = silent
) -> OpticsCalibration:
    """Fit camera and light of a specification to a folder of raw frames, and write it.

    Beside the specification a folder ``NAME-calibration`` holds the page and the stages' results: an interrupted run goes on there.

    Parameters
    ----------
    sensor : SensorSpec
        Where the fit starts.
    out : Path
        The ``.toml`` file to write.
    limit, no_contact
        As ``fit_optics`` takes them.

    Raises
    ------
    FrameError
        No frame can be used, or ``out`` is no name of a ``.toml`` file.
    RenderError
        Nothing can be rendered, or differentiated, here.
    """
    folder = folder_beside(out, "calibration")
    found = fit_optics(frames, sensor, folder, limit=limit, no_contact=no_contact, progress=progress)
    write_sensor(out, found.spec, f"Fitted to {len(found.frames)} frames of {frames.name}, starting from {sensor.name}.")
    return OpticsCalibration(found, [out, write_page(folder, sensor, found, frames.name)])


def folder_beside(out: Path, kind: str) -> Path:
    """The folder for what belongs to a specification that is to be written; made if missing.

    Raises
    ------
    FrameError
        ``out`` is no name of a ``.toml`` file.
    """
    if out.suffix != ".toml":
        raise FrameError(f"--out {out}: give the name of a .toml file")
    folder = out.with_name(f"{out.stem}-{kind}")
    folder.mkdir(parents=True, exist_ok=True)
    return folder
