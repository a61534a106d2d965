"""Whether a recording's labels agree with its pins, from the recording to tables and a page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes import SensorSpec
from training.audit import Audit, audit_labels
from training.audit_page import summary_of, write_audit
from training.dataset import load_dataset
from twin.progress import Progress, silent, stage
from twin.types import Form

TARGET = "surface-2d-shear"  # the labels that an audit needs
LISTS = ("no_contact", "wrong_sign", "fit_no_story", "same_pins_as_an_earlier_frame", "reader")
SHOWN = 3  # names of each list


@dataclass(frozen=True)
class LabelAudit:
    """What was found.

    Attributes
    ----------
    audit : Audit
    summary : dict
        As ``audit.json`` holds it.
    frames : int
    written : list of Path
    """

    audit: Audit
    summary: dict[str, Any]
    frames: int
    written: list[Path]

    def lines(self) -> list[str]:
        """For people."""
        undone, undecided = self.summary["moves_not_executed"], self.summary["undecided"]
        lines = [f"{self.frames} frames; in {undone['frames']} the move was not executed; {undecided} undecided"]
        for key in LISTS:
            if names := self.summary[key]:
                more = ", ..." if len(names) > SHOWN else ""
                lines.append(f"{key.replace('_', ' ')}: {len(names)} ({', '.join(names[:SHOWN])}{more})")
        drift = self.audit.drift["r2_of_row_number_beyond_labels"]
        return [
            *lines,
            f"depth beyond the label where not executed: {self.audit.depth_per_move:+.4f} mm for each mm of move_1",
            f"row number told by the outmost pins beyond the labels: R^2 {drift:.2f}",
        ]


def audit_recording(data: Path, sensor: SensorSpec, out: Path, *, form: Form | None = None, progress: Progress = silent) -> LabelAudit:
    """Audit the labels of a flat-surface recording, and write what was found to an existing folder.

    Raises
    ------
    FrameError
        The recording has not the labels pose_2, pose_6, move_1 and move_6.
    """
    with stage(progress, "frames") as step:
        found = load_dataset(data, sensor, TARGET, form=form, progress=step)
    made = audit_labels(found.pins, *found.targets.raw.T)
    summary = summary_of(made, found)
    return LabelAudit(made, summary, len(found), write_audit(out, made, found, summary))
