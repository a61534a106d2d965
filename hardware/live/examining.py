"""Check of a sensor's condition from frames of a camera or of a recording."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from hardware.cameras.source import await_frame, open_camera
from scenes import SensorSpec
from twin.calibration.camera_view import register_files
from twin.errors import FrameError, OptionError, format_count
from twin.frames import evenly_read, open_recording, spread_indices
from twin.frames.images import write_image
from twin.pins import DetectorSpec, Pipeline, with_detector
from twin.pins.batch import draw_overlay
from twin.pins.check import Finding, Grade, examine
from twin.progress import Progress, silent, stage
from twin.report.page import Cell, Page, PagePicture
from twin.store import writes, writes_file
from twin.types import Form, Frame, ReadableResult

LIMIT = 20  # most frames that are used
SHOWN = 4  # frames whose pictures are on the page
MOST_LIVE = 1000  # most frames of a camera that are kept: 6 GB at 1920 x 1080 in colour


@dataclass(frozen=True, repr=False)
class Examination(ReadableResult):
    """The findings, and the irregularities of the recording."""

    findings: list[Finding]
    notes: list[str] = field(default_factory=list)

    @property
    def failed(self) -> bool:
        """Whether the sensor failed in any finding."""
        return any(found.verdict is Grade.FAILED for found in self.findings)

    def lines(self) -> list[str]:
        """Lines of text: each finding with its remedy below it, then the irregularities."""
        lines = [f"note: {note}" for note in self.notes]
        for found in self.findings:
            lines.append(f"{found.verdict.upper():8} {found.name:10} {found.text}")
            if found.remedy:
                lines.append(f"         -> {found.remedy}")
        return lines


@writes_file()
@writes("index.html", "frame-*.png", to="page")
def examine_sensor(
    source: str,
    sensor: SensorSpec,
    *,
    form: Form | None = None,
    detector: DetectorSpec | None = None,
    limit: int = LIMIT,
    no_contact: Path | None = None,
    pushes: Sequence[str] = (),
    twist: Path | None = None,
    out: Path | None = None,
    page: Path | None = None,
    contacts: Callable[[list[Frame], SensorSpec], Finding | None] | None = None,
    progress: Progress = silent,
) -> Examination:
    """Examine at most ``limit`` frames of a camera or a recording.

    Parameters
    ----------
    source : str
        Text for ``open_camera``.
    form : Form, optional
        Form of the frames; recognised by size and content by default.
    detector : DetectorSpec, optional
        Result of 'twin tune'; by default the specification's own detector.
    no_contact, pushes, twist, out : optional
        As ``rest``, ``pushes``, ``twist`` and ``out`` of ``twin.calibration.camera_view.register_files``: the camera's turn and mirror are
        found, and the frames are compared with the corrected copy of the specification.
    page : Path, optional
        Folder for a page with the findings, and pictures of frames with their pins.
    contacts : callable, optional
        Finding whether the contacts in the frames are in the domain of a model of the sensor; for the specification's own detector.

    Raises
    ------
    FrameError
        The detector is not of method ``twin``, there are no frames, or the pushes do not determine the camera's view.
    OptionError
        Pushes without a frame without contact, or the other way round.
    DeviceError
        There is no such camera, or it delivers no frame.
    """
    if detector is not None and detector.method != "twin":
        remedy = "`pipeline` takes method 'twin'; run 'twin tune' without `method`"
        raise FrameError(f"{detector.name}: tuned for method '{detector.method}', {remedy}")
    views = []
    if no_contact is not None and (pushes or twist is not None):
        sensor, view = register_files(sensor, no_contact, pushes, twist=twist, form=form, out=out)
        mirrored = "mirrored and " if view.mirrored else ""
        views.append(f"the camera's picture is {mirrored}turned by {view.turn_deg:.1f} deg against the given specification")
    elif no_contact is not None or pushes or twist is not None or out is not None:
        raise OptionError("`no_contact`, `push` and `out` belong together: give a frame without contact, and pushes to known sides")
    seeing = sensor if detector is None else with_detector(sensor, detector)  # frames have the size for which the detector was tuned
    frames, notes = frames_of(source, seeing, form, limit)
    with stage(progress, "frames") as step:
        findings = examine(frames, sensor, detector, progress=step)
    if detector is None and contacts is not None:
        findings += filter(None, [contacts(frames, sensor)])
    found = Examination(findings, views + notes)
    if page is not None:
        _write_page(page, found, frames, Pipeline(seeing, frames[0].form), source)
    return found


def _write_page(folder: Path, found: Examination, frames: list[Frame], pipeline: Pipeline, source: str) -> None:
    tones: dict[Grade, Literal["", "good", "bad"]] = {Grade.HEALTHY: "good", Grade.FAILED: "bad"}
    counts = Counter(str(finding.verdict) for finding in found.findings)
    lead = f"{format_count(len(frames), 'frames')} of {source}. Checks: {', '.join(f'{count} {grade}' for grade, count in counts.items())}."
    page = Page(f"Health of {pipeline.spec.name}", "twin check", topic="TacTip twin: health", lead=lead)
    page.notice("What to do", [finding.remedy for finding in found.findings if finding.remedy], tone="bad" if found.failed else "")
    page.notice("Noted", found.notes)
    verdicts = [Cell(str(each.verdict), tones.get(each.verdict, "")) for each in found.findings]
    rows = [{"check": each.name, "verdict": cell, "found": each.text} for each, cell in zip(found.findings, verdicts, strict=True)]
    page.table(rows, ["check", "verdict", "found"])
    page.section("Pins in the frames", "Green: found. Red: a lost pin's expected place. Yellow: spots that are no pins.")
    pictures = []
    for k, frame in enumerate((frames[k] for k in spread_indices(len(frames), SHOWN)), 1):
        path = write_image(folder / f"frame-{k}.png", draw_overlay(frame, pipeline(frame), scale=2))
        pictures.append(PagePicture(path, f"Frame {frame.name} with its pins", frame.name))
    page.figures(*pictures, layout="row")
    page.write(folder / "index.html")


def frames_of(source: str, sensor: SensorSpec | None, form: Form | None, limit: int) -> tuple[list[Frame], list[str]]:
    """The next ``limit`` frames of a camera, or as many of a recording, evenly spread, and the irregularities of the recording.

    Raises
    ------
    FrameError
        There are no frames, or more than ``MOST_LIVE`` of a camera are requested.
    """
    camera = open_camera(source, sensor, form)
    if not camera.is_live:
        recording = open_recording(Path(source), sensor, form)
        return evenly_read(recording, limit), recording.notes()
    if limit > MOST_LIVE:
        raise FrameError(f"`max_frames` {limit}: at most {MOST_LIVE} frames of a camera, as they are kept until the end")
    with camera:
        return [await_frame(camera) for _ in range(limit)], []
