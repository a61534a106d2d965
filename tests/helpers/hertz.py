"""A rigid sphere on a half space of the gel's own elements: Hertz 1882 (Johnson, "Contact Mechanics", ch. 4).

With E* = E / (1 - nu^2): contact radius a = sqrt(R d), force F = 4/3 E* sqrt(R) d^(3/2), pressure
p0 sqrt(1 - (r / a)^2) with p0 = 2 E* a / (pi R), d the indentation.

The half space is a block of ``SIZE`` contact radii to each side and in depth, clamped there, with elements that grow outwards. A clamped
layer is stiffer than the half space: by 9 % at 10 radii, 1 % at 100.
Lengths are large, so that the penalty's penetration (0.005 mm) is nothing against the indentation.
"""

from dataclasses import dataclass

import numpy as np
from block import build_block

from twin.mechanics.balance import Body, LoadState
from twin.mechanics.contact import ContactPoints
from twin.mechanics.law import ContactLaw
from twin.mechanics.newton import LoadStepper
from twin.objects.analytic import Sphere

SPHERE_MM, RADIUS_MM = 500.0, 40.0  # a / R = 0.08
SIZE = 100.0  # of the block, in contact radii
POINTS = 4  # along each side of an outer element


def graded(fine_mm: float, reach_mm: float, end_mm: float, growth: float = 1.7) -> np.ndarray:
    """Breaks from 0: even up to ``reach_mm``, then growing up to ``end_mm``."""
    out = list(np.linspace(0, reach_mm, int(round(reach_mm / fine_mm)) + 1))
    step = fine_mm
    while out[-1] < end_mm:
        step *= growth
        out.append(out[-1] + step)
    out[-1] = end_mm
    if out[-1] - out[-2] < 0.5 * (out[-2] - out[-3]):
        del out[-2]
    return np.array(out)


def contact_points(block, reach_mm: float) -> ContactPoints:
    """Even points of the outer elements within a square around the middle."""
    breaks = block.basis.breaks
    middle = (breaks[1:] + breaks[:-1]) / 2
    inner = np.flatnonzero(np.abs(middle) < reach_mm)
    at = (breaks[inner, None] + np.diff(breaks)[inner, None] * (np.arange(POINTS) + 0.5) / POINTS).ravel()
    width = np.repeat(np.diff(breaks)[inner] / POINTS, POINTS)
    first = block.basis.element_of(at)
    local = np.take_along_axis(block.basis.values(at), first[:, None] + np.arange(3), axis=1)
    row = first[:, None] + np.arange(3)
    controls = block.index[0][row[:, None, :, None], row[None, :, None, :]]
    count = len(at)
    return ContactPoints(
        controls=controls.reshape(count**2, 9),
        weights=np.einsum("ri,cj->rcij", local, local).reshape(count**2, 9),
        lift_mm=np.zeros((count**2, 3)),
        area_mm2=np.multiply.outer(width, width).ravel(),
        element=(first[:, None] * block.basis.elements + first).ravel(),
        place=np.zeros(count**2, complex),
    )


@dataclass(frozen=True)
class Indented:
    """Force, and by element under the contact: mean pressure, distance from the axis, area (e,)."""

    force_n: float
    radius_mm: float  # from the pressure's second moment: 2/5 a^2 in Hertz's distribution
    pressure_mpa: np.ndarray
    r_mm: np.ndarray
    area_mm2: np.ndarray


def indent(spec, *, fine: float, size: float = SIZE, steps: int = 4) -> Indented:
    """Press; ``fine`` is the contact radius over the size of the elements below the contact."""
    depth_mm = RADIUS_MM**2 / SPHERE_MM
    half = graded(RADIUS_MM / fine, 1.5 * RADIUS_MM, size * RADIUS_MM)
    side = np.concatenate([-half[:0:-1], half])
    block = build_block("gel", breaks=side, depths=graded(RADIUS_MM / fine, RADIUS_MM, size * RADIUS_MM))
    fixed = np.zeros(block.index.shape, bool)
    fixed[-1] = fixed[:, [0, -1]] = fixed[:, :, [0, -1]] = True
    fixed = fixed.ravel()
    points = contact_points(block, 1.5 * RADIUS_MM)
    elements = block.elements(spec)
    count = len(points.area_mm2)
    state = LoadState(
        control_mm=block.control_mm,
        border=np.zeros(2),
        anchor_mm=np.zeros((count, 3)),
        held=np.zeros(count, bool),
        slid_mm=np.zeros(count),
        limit_n=np.zeros(count),
        gap_mm=np.zeros(count),
        penalty_mpa_mm=30.0,
        T=np.eye(4),
    )
    stepper = LoadStepper(Body((elements,), points, ~fixed, False), [block.boxes], Sphere(SPHERE_MM), ContactLaw())
    for step in range(1, steps + 1):
        T = np.eye(4)
        T[2, 3] = -depth_mm * step / steps
        state, balance, looked = stepper.step(state, T, (elements,))
    force, area = np.zeros(count), points.area_mm2
    force[looked] = balance.contact.normal_n
    at = points.positions(state.control_mm)
    # 16 points press on the few unknowns of an element, and share its load unevenly: only their sum means something
    _, of = np.unique(points.element, return_inverse=True)
    sums = [np.bincount(of, weights=w) for w in (force, area, area * np.hypot(at[:, 0], at[:, 1]), force * (at[:, :2] ** 2).sum(axis=1))]
    radius_mm = float(np.sqrt(2.5 * sums[3].sum() / force.sum()))
    return Indented(-balance.point_force_n[:, 2].sum(), radius_mm, sums[0] / sums[1], sums[2] / sums[1], sums[1])


def hertz(spec) -> tuple[float, float]:
    """Force in N and largest pressure in MPa."""
    modulus = spec.young_modulus_mpa / (1 - spec.poisson_ratio**2)
    depth_mm = RADIUS_MM**2 / SPHERE_MM
    return 4 / 3 * modulus * np.sqrt(SPHERE_MM) * depth_mm**1.5, 2 * modulus * RADIUS_MM / (np.pi * SPHERE_MM)


def errors(spec, found: Indented) -> tuple[float, float, float]:
    """Relative errors of force and contact radius, rms of the elements' mean pressure's."""
    force, largest = hertz(spec)
    wanted = largest * np.sqrt(np.maximum(1 - (found.r_mm / RADIUS_MM) ** 2, 0))
    inside = found.r_mm < 1.2 * RADIUS_MM
    off = np.sqrt((found.area_mm2 * (found.pressure_mpa - wanted) ** 2)[inside].sum() / found.area_mm2[inside].sum())
    return found.force_n / force - 1, found.radius_mm / RADIUS_MM - 1, off / largest
