"""The steps of ``twin new`` after pins and camera: light is fitted to colour frames, and the contact to labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes.experiment import LABELS, ExperimentSpec
from scenes.load import list_specifications, load_experiment
from scenes.pins import PinsSpec
from twin.calibration.new_sensor import LIMIT, NewSensor, new_sensor
from twin.errors import OptionError
from twin.frames import frames_at, open_recording
from twin.frames.tables import numbers
from twin.progress import Progress, silent
from twin.types import FINE, Form, ReadableResult

if TYPE_CHECKING:
    from twin.calibration.contact.calibrate import ContactCalibration
    from twin.calibration.optics import OpticsCalibration

ALIKE = 0.6
"""Least share of varying labels that a table and an experiment have in common, of the labels that vary in either of them."""
VARIES = 1e-6
"""Least change, mm or deg, of a label that counts as varying."""


@dataclass(frozen=True, repr=False)
class WholeSensor(ReadableResult):
    """A specification made from frames, and what was fitted to it afterwards.

    Attributes
    ----------
    made : NewSensor
        Layout, camera and pin detection.
    experiment : ExperimentSpec or None
        How the labelled contacts were made, as assumed in the fit.
    optics : OpticsCalibration or None
    contact : ContactCalibration or None
    """

    made: NewSensor
    experiment: ExperimentSpec | None
    optics: "OpticsCalibration | None"
    contact: "ContactCalibration | None"

    @property
    def written(self) -> list[Path]:
        """Paths of the specification and of the pages."""
        parts: Sequence[NewSensor | OpticsCalibration | ContactCalibration | None] = (self.made, self.optics, self.contact)
        return list(dict.fromkeys(path for part in parts if part is not None for path in part.written))

    def lines(self) -> list[str]:
        """The results, step by step."""
        lines = [line for line in self.made.lines() if not line.startswith("next:")]
        if self.optics is not None:
            lines += ["light and colours:", *self.optics.lines()]
        if self.contact is not None and self.experiment is not None:
            lines += [f"contact, as the experiment {self.experiment.name} makes it:", *self.contact.lines()]
        done = [kind for kind, part in (("optics", self.optics), ("contact", self.contact)) if part is not None]
        left = [step for step in self.made.next_steps if not any(f"calibrate {kind}" in step for kind in done)]
        return lines + [f"next: {step}" for step in left]


def whole_sensor(
    frames: Path,
    out: Path,
    *,
    labels: Path | None = None,
    optics: bool = False,
    experiment: ExperimentSpec | None = None,
    contacts: int = 20,
    workers: int = 1,
    across: int = FINE,
    layout: PinsSpec | None = None,
    radius_mm: float | None = None,
    no_contact: Path | None = None,
    table: Path | None = None,
    form: Form | None = None,
    limit: int = LIMIT,
    progress: Progress = silent,
) -> WholeSensor:
    """Make a specification as ``new_sensor`` does, then fit what labels and colour frames determine. ``out`` holds the whole result.

    Parameters
    ----------
    labels : Path, optional
        Table of labels of the frames: the contact is fitted to ``contacts`` of them, see ``calibrate_to_file``.
    optics : bool
        Also fit light and colours, see ``calibrate_optics``. It needs raw frames.
    experiment : ExperimentSpec, optional
        How the labelled contacts were made. By default the experiment in which the same labels vary.
    workers : int
        Processes for the simulated contacts.
    across : int
        Elements along each side of the skin's grid.

    Raises
    ------
    FrameError, OptionError
        As ``new_sensor``, ``calibrate_optics`` and ``calibrate_to_file``; or the labels of no experiment vary like the table's.
    """
    table = labels or table
    at = frames_at(frames, table, no_contact)
    if optics and open_recording(at, form=form).form == Form.PROCESSED:
        raise OptionError(
            f"{frames}: thresholded frames contain nothing about light and colours; leave out `optics`, or give raw camera frames"
        )
    if labels is not None and experiment is None:
        experiment = experiment_like(open_recording(at, form=form).labels)
    made = new_sensor(
        frames, out, layout=layout, radius_mm=radius_mm, no_contact=no_contact, table=table, form=form, limit=limit, progress=progress
    )
    sensor, light, contact = made.sensor, None, None
    if optics:
        from twin.calibration.optics import calibrate_optics

        light = calibrate_optics(frames, sensor, out, no_contact=no_contact, progress=progress)
        sensor = light.found.spec
    if labels is not None and experiment is not None:
        from twin.calibration.contact.calibrate import ContactCalibration, calibrate_to_file

        found = calibrate_to_file(
            at, sensor, experiment, out, labels=contacts, workers=workers, across=across, form=form, progress=progress
        )
        assert isinstance(found, ContactCalibration)  # it is given frames
        contact = found
    return WholeSensor(made, experiment, light, contact)


def experiment_like(labels: Mapping[str, np.ndarray]) -> ExperimentSpec:
    """The experiment in which the same labels vary as in a table.

    Parameters
    ----------
    labels : mapping of str to (M,) array
        A table's columns by their names.

    Raises
    ------
    OptionError
        The table has no labels of contacts, or no experiment has similar labels.
    """
    varying = {name for name in LABELS if name in labels and _varies(numbers(labels[name]))}
    if not varying:
        raise OptionError(
            "no label of a contact varies in the table; expected pose_1..6 and move_1..6, or pose_x..pose_Rz and shear_x..shear_Rz"
        )
    found: list[tuple[float, bool, int, str]] = []
    for name in list_specifications("experiments"):
        plan = load_experiment(name)
        own = {label for label, (low, high) in plan.ranges().items() if high - low > VARIES}
        # of equally similar experiments, the recorded ones (with a source) come first, then the one with the shortest name
        found.append((len(own & varying) / len(own | varying), bool(plan.source), -len(name), name))
    share, *_, name = max(found, key=lambda each: each[:3])
    if share < ALIKE:
        raise OptionError(
            f"no experiment has contacts whose labels vary like the table's ({', '.join(sorted(varying))}); name one with `experiment` "
            f"('twin experiments' lists them)"
        )
    return load_experiment(name)


def _varies(values: np.ndarray) -> bool:
    known = values[np.isfinite(values)]
    return bool(len(known) and np.ptp(known) > VARIES)
