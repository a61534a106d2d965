"""What assumed numbers cost: how far estimates of depth and tilt move if a number of the specification is wrong.

A twin with the assumed numbers presses a plate in nine ways; its displacements of the pins are a function of depth and tilt, quadratic
in each. A twin with another number, whose camera is fitted to the same pins at rest, presses it too. The depth and tilt whose
displacements are most like those of the other twin, less the true ones, are the cost of the assumption.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.optimize import least_squares

from scenes import load_object
from scenes.sensor import SensorSpec
from twin.calibration.camera_pose import PARAMETERS, fit_camera
from twin.calibration.size import of_radius
from twin.camera.projection import project
from twin.errors import ContactError, FrameError
from twin.geometry.solid import Resolution
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.pins.labelling.reference import project_rest
from twin.progress import Step
from twin.types import FloatArray, Form

SPARSE = Resolution(across=8)
"""Elements of these simulations, in which only differences count."""
DEPTHS, TILTS_DEG = (0.05, 0.1, 0.15), (-10.0, 0.0, 10.0)
"""Depths, in radii of the tip, and tilts about x of the nine contacts."""
SIZES = np.array([DEPTHS[1], TILTS_DEG[2]])
"""A usual depth and tilt, by which they are divided."""
PROBES = ((0.08, -5.0), (0.12, 5.0))
"""Depth and tilt of the contacts of the other twins."""
MORE, TURN_DEG, STIFFER = 1.1, 5.0, 1.5
"""Changes: of a length, of the angle of the outermost pins, and of a modulus."""
LONGER, STIFF = f"{MORE - 1:+.0%}", f"times {STIFFER:g}"
NUMBERS = (
    ("thickness of the skin, {:g} mm", "skin", "thickness_mm", MORE, 0.0, LONGER),
    ("length of the pins, {:g} mm", "pins", "length_mm", MORE, 0.0, LONGER),
    ("angle of the outermost pins, {:g} deg", "pins", "max_polar_deg", 1.0, TURN_DEG, f"{TURN_DEG:+g} deg"),
    ("distance of the camera, {:.1f} mm", "camera", "distance_mm", MORE, 0.0, LONGER),
    ("stiffness of the skin", "skin", "young_modulus_mpa", STIFFER, 0.0, STIFF),
    ("stiffness of the gel", "gel", "young_modulus_mpa", STIFFER, 0.0, STIFF),
)
"""The assumed numbers beside the radius: title, section and key; factor and summand of their change, and the change in words."""


@dataclass(frozen=True)
class AssumptionCost:
    """What an assumption costs.

    Attributes
    ----------
    assumed, change : str
        The number, and by how much it is changed.
    depth_share : float
        Mean change of an estimated depth, as a share of the depth.
    tilt_deg : float
        Mean change of an estimated tilt of 5 deg, away from 0.
    """

    assumed: str
    change: str
    depth_share: float
    tilt_deg: float

    def line(self) -> str:
        """The cost as a line of text."""
        return f"{self.assumed}: {self.change} moves depths by {100 * self.depth_share:+.0f} %, a tilt of 5 deg by {self.tilt_deg:+.1f} deg"


def _changes(spec: SensorSpec) -> dict[tuple[str, str], tuple[SensorSpec, bool]]:
    """Specifications with another number, by its name and change; and whether pins at rest then need another camera."""
    radius_mm = spec.skin.outer_radius_mm
    changes = {(f"radius of the tip, {radius_mm:g} mm", LONGER): (of_radius(spec, MORE * radius_mm), False)}
    for title, section, key, factor, added, change in NUMBERS:
        value = getattr(getattr(spec, section), key)
        changes[title.format(value), change] = spec.alter(**{section: {key: factor * value + added}}), key in PARAMETERS
    return changes


def cost_of_assumptions(spec: SensorSpec, *, progress: Step | None = None) -> list[AssumptionCost]:
    """The costs of a specification's assumed numbers, the largest first. One with which a contact fails is left out.

    Parameters
    ----------
    spec : SensorSpec
        Of a sensor with a dome.
    progress : callable, optional
        Called with (contacts done, contacts wanted).
    """
    radius_mm, plate = spec.skin.outer_radius_mm, load_object("plane")
    grid, changes, found, done = list(product(DEPTHS, TILTS_DEG)), _changes(spec), [], 0

    def displacements(sensor: SensorSpec, contacts: Sequence[tuple[float, float]]) -> FloatArray:
        """Displacements (contacts, 2 N) of the pins of a sensor, px."""
        nonlocal done
        solver, rows = SkinSolver(sensor, resolution=SPARSE), []
        rest = project(sensor.view, solver.rest().caps_mm)
        for depth, tilt_deg in contacts:
            state = solver.press(plate, ContactPose(depth * radius_mm, (tilt_deg, 0.0)))
            rows.append((project(sensor.view, state.caps_mm) - rest).ravel())
            done += 1
            if progress is not None:
                progress(done, len(grid) + (1 + len(changes)) * len(PROBES))
        return np.array(rows)

    def powers(depth: float, tilt_deg: float) -> FloatArray:
        a, b = np.array([depth, tilt_deg]) / SIZES
        return np.outer([1, a, a * a], [1, b, b * b]).ravel()

    moved, truth = displacements(spec, [*grid, *PROBES]), np.array(PROBES)
    table = np.linalg.solve(np.array([powers(*each) for each in grid]), moved[: len(grid)])

    def estimate(seen: FloatArray) -> FloatArray:
        """Depths and tilts (probes, 2) that the assumed numbers give to displacements (probes, 2 N)."""
        pairs = zip(seen, truth / SIZES, strict=True)
        fits = [least_squares(lambda x, row=row: powers(*x * SIZES) @ table - row, start).x for row, start in pairs]
        return np.array(fits) * SIZES

    own, rest_px = estimate(moved[len(grid) :]), project_rest(spec, Form.RAW)  # the table's error, with the right numbers
    for (assumed, change), (other, moves_pins) in changes.items():
        try:
            if moves_pins:  # the others leave the pins at rest where they are seen
                other, _ = fit_camera(other, rest_px)
            depth, tilt = ((estimate(displacements(other, PROBES)) - own) * np.sign(truth)).T
        except (ContactError, FrameError):
            continue
        found.append(AssumptionCost(assumed, change, float(np.mean(depth / truth[:, 0])), float(np.mean(tilt))))
    return sorted(found, key=lambda cost: -abs(cost.depth_share) - abs(cost.tilt_deg) / 5.0)
