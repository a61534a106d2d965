"""The mode 'Degrade': the contact of the mode 'Twin', seen by a degraded sensor."""

import time

import numpy as np

from twin.errors import TwinError
from twin.evaluation.degradation.condition import DegradedCase
from twin.evaluation.degradation.conditions import CONDITIONS, condition
from twin.evaluation.degradation.shots import DegradedFrame, degraded_state
from twin.evaluation.degradation.sweep import MEASURES, SEVERITIES, measure_frame
from twin.optics.preview import Shading
from twin.pins import make_detector, nominal_reference, shipped_detector
from twin.pins.pipeline import Pipeline
from twin.studio.contact import ContactAnswer
from twin.studio.modes.mode import PageMode
from twin.studio.modes.twin_mode import TwinMode
from twin.studio.page import StudioPage, frame_pictures, put
from twin.studio.pictures import badge, estimate_table, paragraph
from twin.studio.pose import ObjectPose
from twin.types import Form

SLIDERS = 3
"""Number of conditions that can act at once, each with its own severity."""
NO_CONDITION = "nothing"
"""Name of the choice for a slider without a condition."""
FIRST = ("defocus", "caps-missing", "camera-rolled")
"""Conditions that are selected at first, if they exist."""


class FrameEvaluator:
    """Degrades contacts of one sensor and evaluates the results as ``twin robustness`` does.

    Parameters
    ----------
    mode : TwinMode
        The mode whose contact is used.
    """

    def __init__(self, mode: TwinMode) -> None:
        self.contact = mode.contact
        spec = mode.contact.setup.sensor
        self.spec, self.reference = spec, nominal_reference(spec, Form.RAW)
        self.pipeline = Pipeline(spec, Form.RAW)
        self._detector = make_detector(spec, shipped_detector(spec, Form.RAW))
        pitch_px = float(np.mean(self.reference.spacing_px))
        self.limits = {m.name: m.limit * (pitch_px if m.in_pitches else 1.0) for m in MEASURES}

    def __call__(
        self, answer: ContactAnswer, cases: list[tuple[DegradedCase, float]], shading: Shading
    ) -> tuple[DegradedFrame, dict[str, float], list[str]]:
        """A contact's frame with cases, each at its severity; its values by the names of ``MEASURES``; titles of those beyond limits."""
        touched = bool(len(answer.state.contact_mm))
        shot = degraded_state(self.spec, answer.state, cases, shading=shading, touched=touched)
        figures = measure_frame(self._detector, self._detector(shot.frame), shot)
        return shot, figures, [m.title for m in MEASURES if m.exceeds(figures[m.name], self.limits[m.name])]


class DegradeMode(PageMode):
    """The mode 'Degrade'.

    Parameters
    ----------
    page : Page
    twin : TwinMode
    """

    title = "Degrade"
    has_scene = True

    def __init__(self, page: StudioPage, twin: TwinMode) -> None:
        super().__init__(page)
        self._twin, self.charts = twin, twin.charts
        self._judge: FrameEvaluator | None = None
        self._edge, self._finding = "", False
        self._pose: ObjectPose | None = None
        self._wanted = self.newest(self._show, "degrade")
        # by title, without those that change mechanics or settings of the pipeline, as the contact is given
        conditions = {f"{c.title} ({c.family})": c for c in CONDITIONS.values() if not c.solves and c.setting is None}
        titles = (NO_CONDITION, *conditions)
        by_name = {c.name: title for title, c in conditions.items()}
        self._conditions, self._controls = conditions, []
        with self.folder:
            for k in range(SLIDERS):
                first = by_name.get(FIRST[k], NO_CONDITION)
                choice = page.watch(page.gui.add_dropdown(f"condition {k + 1}", titles, initial_value=first), self._restart)
                slider = page.gui.add_slider(f"severity {k + 1}", 0.0, 1.0, 0.01, 0.0, hint="1: unusable")
                self._controls.append((choice, page.watch(slider, self._restart)))
            page.button("Find breaking point", self._find, hint="raise the severity of condition 1 until something fails; others are kept")
            page.button("Reset", self._reset)

    def show(self) -> None:
        """Show the twin's contact, degraded."""
        self._page.show_nothing("Rendering the contact with a degraded sensor ...")
        self._wanted.give(None)

    def follow(self, answer: ContactAnswer) -> None:
        """Use the twin's new contact."""
        if self._active:
            if answer.pose != self._pose:
                self._edge = ""
            self._wanted.give(None)

    def _restart(self) -> None:
        self._edge, self._finding = "", False
        self._wanted.give(None)

    def _find(self) -> None:
        self._finding = True
        self._wanted.give(None)

    def _reset(self) -> None:
        for _, slider in self._controls:
            put(slider, 0.0)
        self._restart()

    def cases(self) -> list[tuple[DegradedCase, float]]:
        """The chosen conditions with their severities."""
        chosen = [(choice.value, float(slider.value)) for choice, slider in self._controls]
        return [(DegradedCase((condition(self._conditions[title].name),)), severity) for title, severity in chosen if title != NO_CONDITION]

    def _show(self, _: None) -> None:
        answer = self._twin.worker.newest
        if answer is None or not self._active:
            return
        if self._judge is None or self._judge.contact is not self._twin.contact:
            self._judge = FrameEvaluator(self._twin)
        judge, shading, started = self._judge, self._twin.contact.camera.preview.shading, time.perf_counter()
        self._pose = answer.pose
        if self._finding:
            self._edge = self._edge_of(judge, answer, shading)
            self._finding = not self._edge  # a newer contact came, so the search must be repeated for it
        cases = self.cases()
        shot, figures, failed = judge(answer, cases, shading)
        frame, estimate, seen = judge.contact.observe(shot.frame, Form.RAW, judge.pipeline)
        ms = 1e3 * (time.perf_counter() - started)
        pictures = frame_pictures(judge.spec, judge.reference, frame, seen)
        words = "; ".join(f"{case.title} {case.label(severity)}" for case, severity in cases if severity) or "no degradation"
        numbers = [
            badge("degraded" if any(severity for _, severity in cases) else "not degraded") + badge("rasterised"),
            paragraph(words, "note"),
            _measures(figures, failed, judge.limits),
            paragraph("" if seen.valid else f"The pipeline refuses the frame: {seen.reason}", "stop"),
            estimate_table(estimate, answer.labels) if shot.touched else "",
            paragraph(self._edge, "said"),
            paragraph(f"{ms:.0f} ms latency", "note"),
        ]
        self.put_up(pictures, "camera, raw frame, degraded", numbers)

    def _edge_of(self, judge: FrameEvaluator, answer: ContactAnswer, shading: Shading) -> str:
        """The severity of the first chosen condition at which this contact leaves the envelope, in words."""
        cases = self.cases()
        if not cases:
            self._finding = False
            raise TwinError("choose a condition first; its severity is then raised until something fails")
        (case, _), others = cases[0], cases[1:]
        borne = 0.0
        for severity in SEVERITIES:
            if self._wanted.overtaken:
                return ""
            _, _, failed = judge(answer, [(case, severity), *others], shading)
            if failed and severity == 0.0:
                return f"This frame fails without {case.title}, too: {', '.join(failed)}."
            if failed:
                fails = f"at {case.label(severity)} (severity {severity:g}) it fails: {', '.join(failed)}"
                return f"Breaking point of this contact: {case.title} is tolerated up to {case.label(borne)} (severity {borne:g}); {fails}."
            borne = severity
        return f"Breaking point of this contact: {case.title} is tolerated up to its most severe value, {case.label(1.0)}."


def _measures(figures: dict[str, float], failed: list[str], limits: dict[str, float]) -> str:
    """HTML of the measures with their limits."""
    rows = []
    for m in MEASURES:
        value = figures[m.name]
        kind = "bad" if m.title in failed else "" if np.isnan(value) else "good"
        limit = f"{'at least' if m.least else 'at most'} {limits[m.name]:.3g} {m.unit}"
        shown = "-" if np.isnan(value) else f"{value:.3f}"
        rows.append(f"<tr><td>{m.title}</td><td class='{kind}'>{shown}</td><td>{limit}</td></tr>")
    return f"<table><tr><th>pipeline</th><th>value</th><th>limit</th></tr>{''.join(rows)}</table>"
