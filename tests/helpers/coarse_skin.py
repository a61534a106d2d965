"""A skin of few elements, for tests that ask for a contact and its pictures, not for the accuracy of its forces."""

from functools import partial

from twin.geometry.solid import Resolution
from twin.mechanics.solver import SkinSolver

COARSE, FINE = Resolution(8), 12


def use_coarse_skin(monkeypatch) -> None:
    """Let the twin's cameras and the studio solve contacts on few elements."""
    for module in ("hardware.cameras.twin", "twin.studio.contact"):
        monkeypatch.setattr(f"{module}.SkinSolver", partial(SkinSolver, resolution=COARSE))
    monkeypatch.setattr("twin.studio.contact.FINE", FINE)
