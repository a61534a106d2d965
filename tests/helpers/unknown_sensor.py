"""Frames of sensors whose camera nobody knows: drawn caps of any layout, and the bright ring of the housing."""

import cv2
import numpy as np
from drawn_frames import draw_discs, smooth_warp

from twin.geometry.pins import pin_lattice
from twin.pins.labelling.identify import SIZES

SIZE, RADIUS = (300, 252), 108.0  # px: small frames, in which 331 pins still stand 11 px apart


def rest_of(pins, *, size=SIZE, radius=RADIUS, turn_deg=11.0, bulge=-0.15):
    """Where a camera that looks at a dome, turned and a little off, has the pins: px (N, 2)."""
    place = pin_lattice(pins).places @ [1, 1j] * np.exp(1j * np.radians(turn_deg))
    place = place * (1 + bulge * np.abs(place) ** 2) / (1 + bulge)
    return np.column_stack([place.real, place.imag]) * radius + np.array(size) / 2 + [5.4, -3.6]


def frames_of(rest, count=3, *, size=SIZE, contact_px=4.2, ring=True, level=(20, 120), seed=0):
    """Gray frames of contacts: caps, and the bright ring of the housing."""
    spacing = np.median(np.sort(np.linalg.norm(rest[:, None] - rest, axis=2), axis=1)[:, 1])
    images = []
    for k in range(count):
        rng = np.random.default_rng(100 * seed + k)
        image = draw_discs(size, smooth_warp(rest, contact_px, rng), 0.27 * spacing, level=level, blur_px=0.8, noise_sd=1.0, rng=rng)
        if ring:
            middle, radius = tuple(int(v) for v in rest.mean(axis=0)), np.linalg.norm(rest - rest.mean(axis=0), axis=1).max()
            cv2.circle(image, middle, int(1.16 * radius), 200, max(round(0.04 * radius), 1))
        images.append(image)
    return images


def leave_out_costs(monkeypatch):
    """Make new sensors without the costs of their assumptions."""
    monkeypatch.setattr("twin.calibration.new_sensor.cost_of_assumptions", lambda sensor, *, progress: [])


def search_few_sizes(monkeypatch):
    """Search frames of this module's size for spots of four sizes of eight: its caps have one of them."""
    monkeypatch.setattr("twin.pins.labelling.identify.SIZES", SIZES[2:6])


def leave_out_other_layouts(monkeypatch):
    """Make checks and tunings search frames for no layout but the sensor's own."""
    for module in ("twin.pins.check", "twin.pins.detectors.tune"):
        monkeypatch.setattr(f"{module}.other_layout", lambda layout, images: [])
