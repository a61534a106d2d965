"""The soft body of a sensor: its skin and its gel.

Lengths mm, stiffness MPa (N/mm^2).
"""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from scenes.base import Fraction, Index, NonNegative, OpenSection, Positive, Section
from scenes.materials.base import MaterialLaw
from scenes.plugins import classes


class RelaxationTerm(Section):
    """A part of the shear stiffness that relaxes (one Maxwell element).

    Attributes
    ----------
    fraction : float
        Share of the instantaneous stiffness.
    time_s : float
        Time constant.
    """

    fraction: Annotated[float, Field(gt=0, lt=1)]
    time_s: Positive


MOST_POISSON = 0.49999  # measured: contacts converge up to this value; closer to 0.5, rounding errors exceed the solver's tolerance


def _compressible(poisson_ratio: float) -> float:
    if poisson_ratio > MOST_POISSON:
        raise ValueError(f"a contact does not converge above {MOST_POISSON}; rubber that hardly changes its volume has 0.49 to 0.4999")
    return poisson_ratio


Poisson = Annotated[float, Field(ge=0), AfterValidator(_compressible)]


class MaterialSpec(OpenSection):
    """A nearly incompressible rubber: its stiffness, its hyperelastic law and its relaxation.

    Attributes
    ----------
    young_modulus_mpa, poisson_ratio : float
        Young's modulus and Poisson's ratio at small strain. For a viscoelastic rubber they are the instantaneous values, before relaxation.
    law : str
        Name of the hyperelastic law: "neo-hookean", "mooney-rivlin", "yeoh", or one of another package. Each has keys of its own.
    relaxation : tuple of RelaxationTerm
        Terms of a Prony series; empty for an elastic material.
    """

    part_key: ClassVar[str] = "law"

    young_modulus_mpa: Positive
    poisson_ratio: Poisson
    law: str = "neo-hookean"
    relaxation: tuple[RelaxationTerm, ...] = ()

    @classmethod
    def parts(cls) -> Mapping[str, type[MaterialLaw]]:
        return classes("materials", MaterialLaw)

    @model_validator(mode="after")
    def _check_relaxation(self) -> Self:
        if sum(term.fraction for term in self.relaxation) >= 1:
            raise ValueError("the fractions of relaxation must sum to less than 1: some stiffness must stay")
        return self


ASSUMED_FACTOR = 1.6
"""Uncertainty factor of the forces of a specification whose stiffness was not measured. Printed skins have a modulus of 0.4 to 1 MPa."""

Shape = Literal["cap", "round-pad", "rectangular-pad"]
_OWN_KEYS: dict[Shape, tuple[str, ...]] = {
    "cap": ("outer_radius_mm",),
    "round-pad": ("outer_radius_mm",),
    "rectangular-pad": ("width_mm", "height_mm"),
}
"""Keys for the size of each shape. Keys of other shapes must be omitted."""
LEAST_EDGE = 2.0
"""Smallest height of a pad's rounded edge, relative to the thickness of its skin, because the inside of the edge is rounded, too."""


class SkinSpec(MaterialSpec):
    """The skin: its shape, its thickness and its material. It is clamped at its rim, all around.

    The origin of the sensor frame is the centre of a cap's sphere, or the centre of a pad's outside. z points out of the tip.

    Attributes
    ----------
    shape : {"cap", "round-pad", "rectangular-pad"}
        A cap is the part of a sphere above the plane ``rim_z_mm``: a dome, a shallow cap or a miniature tip. Pads are flat. If ``rim_z_mm``
        is below 0, the whole edge of a pad is rounded with this radius.
    outer_radius_mm : float
        Radius of the outside. For a cap it is the radius of the sphere, for a round pad the radius seen along the axis. The default is the
        radius in the simulation CAD of the TacTip's makers.
    width_mm, height_mm : float
        Size of the outside of a rectangular pad along x and along y.
    thickness_mm : float
        Thickness of the skin.
    rim_z_mm : float
        z of the plane of the rim. For a cap of radius R with an opening of radius r it is sqrt(R^2 - r^2).
    stiffness_factor : float
        Uncertainty factor of the forces, because the stiffness is not known exactly: the true forces are larger or smaller by at most this
        factor with a probability of 90 %. The default is for an assumed stiffness. ``twin calibrate contact`` finds it from weighed
        presses.

    Notes
    -----
    The default thickness and stiffness are those of the printed TacTip: about 1 mm of Agilus30 of Shore A 26 to 30 (0.4 to 1 MPa).
    """

    young_modulus_mpa: Positive = 0.7
    poisson_ratio: Poisson = 0.47
    shape: Shape = "cap"
    outer_radius_mm: Positive = 20.0
    width_mm: Positive | None = None
    height_mm: Positive | None = None
    thickness_mm: Positive = 1.0
    rim_z_mm: float = 0.0
    stiffness_factor: Annotated[float, Field(ge=1)] = ASSUMED_FACTOR

    @property
    def size_keys(self) -> tuple[str, ...]:
        """Keys for the size of the outside."""
        return _OWN_KEYS[self.shape]

    @property
    def apex_mm(self) -> float:
        """z of the outermost point of the skin, on the axis."""
        return self.outer_radius_mm if self.shape == "cap" else 0.0

    @property
    def half_size_mm(self) -> tuple[float, float]:
        """Largest distance of the skin's outside from the axis, along x and along y."""
        if self.width_mm and self.height_mm:
            return self.width_mm / 2, self.height_mm / 2
        rim_z_mm = max(self.rim_z_mm, 0.0) if self.shape == "cap" else 0.0
        reach = math.sqrt(max(self.outer_radius_mm**2 - rim_z_mm**2, 0.0))
        return reach, reach

    @model_validator(mode="after")
    def _check_shape(self) -> Self:
        given = [key for key in ("outer_radius_mm", "width_mm", "height_mm") if getattr(self, key) != SkinSpec.model_fields[key].default]
        for key in given:
            if key not in _OWN_KEYS[self.shape]:
                owner = next(shape for shape, keys in _OWN_KEYS.items() if key in keys)
                raise ValueError(f"{key} belongs to shape = '{owner}', not to '{self.shape}'")
        if self.shape == "cap":
            if self.thickness_mm >= self.outer_radius_mm:
                raise ValueError("thickness_mm must be smaller than outer_radius_mm")
            if abs(self.rim_z_mm) >= self.outer_radius_mm - self.thickness_mm:
                raise ValueError("rim_z_mm must cut the inside of the sphere: its size must be below outer_radius_mm - thickness_mm")
            return self
        if self.shape == "rectangular-pad" and not (self.width_mm and self.height_mm):
            raise ValueError("shape = 'rectangular-pad' needs width_mm and height_mm")
        edge_mm = -self.rim_z_mm
        if edge_mm < 0:
            raise ValueError("rim_z_mm of a flat pad is 0, or minus the height of its rounded edge")
        if 0 < edge_mm < LEAST_EDGE * self.thickness_mm:
            raise ValueError(f"rim_z_mm of a flat pad with a rounded edge must be at most -{LEAST_EDGE:g} thickness_mm, or 0")
        if edge_mm >= min(self.half_size_mm):
            raise ValueError("the rounded edge of a pad (-rim_z_mm) must be smaller than half its size")
        return self


class GelSpec(MaterialSpec):
    """Gel between skin and window.

    Attributes
    ----------
    sealed : bool
        Whether the total volume of the gel is exactly constant, for any Poisson's ratio.
    refractive_index : float
        Refractive index of the gel. The default is that of the silicone gel.
    absorption_per_mm : three numbers
        Beer-Lambert coefficients for red, green and blue.
    haze : float
        Fraction of the light towards the camera that the gel scatters forward.
    haze_sigma_px : float
        Standard deviation of the Gaussian of the scattered light.

    Notes
    -----
    The default modulus is that of the gel RTV27905 (0.01 to 0.03 MPa).
    """

    young_modulus_mpa: Positive = 0.02
    poisson_ratio: Poisson = 0.47
    sealed: bool = False
    refractive_index: Index = 1.41
    absorption_per_mm: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)
    haze: Fraction = 0.0
    haze_sigma_px: Positive = 20.0
