"""A sealed gel's volume and the forces are measured together; in which unit the volume is given makes no difference."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from scenes import load_object, load_sensor
from twin.geometry.solid import Resolution
from twin.mechanics.body.elements import Elements
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver

POSE = ContactPose(2.0, tilt_deg=(8.0, 0.0), shear_mm=(0.6, 0.2))
SAME_MM = 1e-7  # of a cap: rounding, as the same iterations are made
PER_MM3 = {"mm3": 1.0, "thousands of mm3": 1e-3, "thousandths of a mm3": 1e3, "m3": 1e-9}


@dataclass(frozen=True)
class Rescaled(Elements):
    """Elements whose volume is in another unit, and the pressure that seals it in N mm by that unit."""

    per_mm3: float = 1.0

    def add_volume(self, control_mm, out):
        gradient = np.zeros_like(out)
        grown = super().add_volume(control_mm, gradient)
        out += self.per_mm3 * gradient
        return self.per_mm3 * grown

    def add_forces(self, control_mm, out, pressure_mpa=0.0):
        return super().add_forces(control_mm, out, self.per_mm3 * pressure_mpa)

    def stiffness(self, control_mm, pressure_mpa, out, **options):
        super().stiffness(control_mm, self.per_mm3 * pressure_mpa, out, **options)

    @property
    def rest_volume_mm3(self):
        return self.per_mm3 * super().rest_volume_mm3


class Counted(SkinSolver):
    """Keeps the contact, to see how it was solved."""

    def begin(self, *args, **options):
        self.contact = super().begin(*args, **options)
        return self.contact


def sealed_contact(monkeypatch, per_mm3):
    """State and contact of one press, the gel's volume in another unit."""
    monkeypatch.setattr("twin.mechanics.body.elements.Elements", lambda *args, **options: Rescaled(*args, per_mm3=per_mm3, **options))
    spec = load_sensor("mg400-127")
    spec = spec.model_copy(update={"gel": spec.gel.model_copy(update={"sealed": True, "poisson_ratio": 0.45})})
    solver = Counted(spec, resolution=Resolution(10))
    return solver.press(load_object("plane"), POSE), solver.contact


@pytest.mark.parametrize("unit", list(PER_MM3)[1:])
def test_a_sealed_contact_converges_alike_in_any_unit_of_volume(monkeypatch, unit):
    meant, one = sealed_contact(monkeypatch, 1.0)
    found, other = sealed_contact(monkeypatch, PER_MM3[unit])
    assert other.stepper.iterations == one.stepper.iterations
    assert np.abs(found.caps_mm - meant.caps_mm).max() < SAME_MM
    assert found.residual == pytest.approx(meant.residual, rel=0.05)  # of what is left by rounding of single precision


def test_a_lost_volume_is_told_in_newton(monkeypatch):
    """The norm of the residual is the same whichever unit the lost volume is in, and is not blind to it."""
    _, contact = sealed_contact(monkeypatch, 1.0)
    body, rescaled = contact.setting.body, PER_MM3["m3"]
    other = replace(body, kinds=tuple(replace(kind, per_mm3=rescaled) for kind in body.kinds))
    grown_mm3 = 5.0
    assert body.volume_force_n_per_mm3 * grown_mm3 == pytest.approx(other.volume_force_n_per_mm3 * rescaled * grown_mm3)
    assert body.volume_force_n_per_mm3 > 0 and replace(body, sealed=False).volume_force_n_per_mm3 == 0
