"""Where the caps go on the default mesh, on a coarser one, and on one twice as fine."""

from dataclasses import dataclass

import numpy as np

from scenes.load import load_object, load_sensor
from scenes.object import ObjectSpec
from twin.geometry.solid import Resolution
from twin.mechanics import ContactPose, SkinSolver


def shaped(name: str, **shape: float) -> ObjectSpec:
    """A shipped object with a shape of other sizes."""
    spec = load_object(name)
    return spec.model_copy(update={"shape": spec.shape.model_copy(update=shape)})


CASES = {
    "plane": (load_object("plane"), ContactPose(2.0)),
    "sphere": (load_object("sphere"), ContactPose(2.0)),
    "tilted cylinder": (load_object("cylinder"), ContactPose(2.0, tilt_deg=(10.0, 15.0), shear_mm=(0.8, 0.3), twist_deg=10.0)),
    "edge": (load_object("edge"), ContactPose(2.0)),
    "round edge": (shaped("edge", fillet_mm=1.5), ContactPose(2.0)),
    "sheared edge": (load_object("edge"), ContactPose(2.0, tilt_deg=(0.0, 10.0), shear_mm=(1.0, 0.0))),
    "square rod": (load_object("square-rod"), ContactPose(2.0, tilt_deg=(0.0, 5.0))),
    "bump": (shaped("sphere", radius_mm=2.0), ContactPose(2.0)),
}


@dataclass(frozen=True)
class Off:
    """Errors against the finer mesh: of caps, largest and mean over the largest displacement, and of the force, relative."""

    largest: float
    mean: float
    force: float


def make_solvers() -> list[SkinSolver]:
    """Twice as fine, default, coarser."""
    spec, normal = load_sensor("mg400-331"), Resolution()
    finer = Resolution(2 * normal.across, 2 * normal.skin_layers, 2 * normal.gel_layers)
    coarser = Resolution(10, normal.skin_layers, normal.gel_layers)
    return [SkinSolver(spec, resolution=resolution) for resolution in (finer, normal, coarser)]


def errors_of(solvers: list[SkinSolver], case: str) -> list[Off]:
    """Of the default and the coarser mesh."""
    touched, pose = CASES[case]
    rest = solvers[0].rest().caps_mm
    exact, *others = (solver.press(touched, pose) for solver in solvers)
    moved = np.linalg.norm(exact.caps_mm - rest, axis=1)
    found = []
    for state, solver in zip(others, solvers[1:], strict=True):
        off = np.linalg.norm(state.caps_mm - exact.caps_mm, axis=1) / moved.max()
        force = np.linalg.norm(state.force_n - exact.force_n) / np.linalg.norm(exact.force_n)
        found.append(Off(float(off.max()), float(off.mean()), float(force)))
        print(
            f"{case}, across {solver.resolution.across}: caps {off.max():.2%}, mean {off.mean():.2%} of {moved.max():.2f} mm, {force:.2%}"
        )
    return found
