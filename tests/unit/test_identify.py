"""A layout is identified from frames alone, and a wrong one is never sure: by rasterised frames of cameras that nobody knows."""

import cv2
import numpy as np
import pytest
from unknown_sensor import SIZE, frames_of, rest_of

from scenes import load_sensor
from scenes.pins import PinsSpec
from twin.errors import FrameError
from twin.geometry.pins import pin_lattice
from twin.pins.detectors.tune import tune
from twin.pins.finding.bumps import find_bumps
from twin.pins.labelling.identify import _match_known, identify, score_layout, symmetries
from twin.types import Form, Frame

LAYOUTS = [
    pytest.param(PinsSpec(rings=5), marks=pytest.mark.slow),
    pytest.param(PinsSpec(rings=10), marks=pytest.mark.slow),
    PinsSpec(rings=6, missing=(40,)),
    pytest.param(PinsSpec(layout="hexagon", rings=6), marks=pytest.mark.slow),
    PinsSpec(layout="hexagon", rings=4),
    PinsSpec(layout="grid", columns=9, rows=7),
    pytest.param(PinsSpec(layout="grid", columns=10, rows=10), marks=pytest.mark.slow),
]


def same(found, pins):
    sizes = [sorted(each.shape.model_dump(exclude_defaults=True).values()) for each in (found, pins)]  # a grid may be turned
    return (found.layout, found.missing) == (pins.layout, pins.missing) and sizes[0] == sizes[1]


@pytest.mark.parametrize("pins", LAYOUTS, ids=lambda p: p.in_words())
def test_the_layout_is_found_and_its_pins_named(pins):
    rest = rest_of(pins)
    found = identify(frames_of(rest, 2))
    assert same(found.best.pins, pins), found.best.line()
    assert found.sure, found.doubts
    nearest = np.linalg.norm(found.best.rest_px[:, None] - rest, axis=2).min(axis=1)
    assert np.median(nearest) < 2.4  # the contacts' median is not the rest


@pytest.mark.parametrize("scale", [0.45, pytest.param(5.0, marks=pytest.mark.slow)])
def test_the_frames_size_does_not_matter(scale):
    pins = PinsSpec(layout="hexagon", rings=6) if scale < 1 else PinsSpec(rings=4)
    size = (int(SIZE[0] * scale), int(SIZE[1] * scale))
    rest = (rest_of(pins) + 0.5) * scale - 0.5
    found = identify(frames_of(rest, 1, size=size, contact_px=3.6 * scale))
    assert same(found.best.pins, pins) and found.sure, found.best.line()


@pytest.mark.usefixtures("few_sizes")
def test_a_rim_that_the_frame_cuts_is_told_from_what_is_in_view():
    pins = PinsSpec(rings=6)
    cut = [np.ascontiguousarray(image[33:219, 36:276]) for image in frames_of(rest_of(pins), 2, ring=False)]
    found = identify(cut)
    assert same(found.best.pins, pins), found.best.line()


@pytest.mark.usefixtures("few_sizes")
@pytest.mark.parametrize(
    ("pins", "part"),
    [
        (PinsSpec(rings=6), np.s_[66:186, 78:234]),
        pytest.param(PinsSpec(layout="hexagon", rings=6), np.s_[66:186, 78:234], marks=pytest.mark.slow),
        (PinsSpec(layout="grid", columns=9, rows=9), np.s_[:, 90:210]),
    ],
    ids=lambda p: p.in_words() if isinstance(p, PinsSpec) else "",
)
def test_a_layout_whose_end_is_cut_off_is_never_sure(pins, part):
    turn_deg = 0.0 if pins.layout == "grid" else 11.0
    cut = [np.ascontiguousarray(image[part]) for image in frames_of(rest_of(pins, turn_deg=turn_deg), 2, ring=False, contact_px=1.8)]
    found = identify(cut)
    assert found.best.pins.count < pins.count and not found.sure, found.best.line()
    assert any("may be cut off" in doubt for doubt in found.doubts)
    if pins.layout != "grid":
        assert found.candidates[1].pins.rings == found.best.pins.rings + 1, "the next larger layout is shown"


def masked(images, rest, share, *, level=0.0, soft_px=0.0, noise_sd=3.0):
    """Frames that show a disc of a share of the layout's radius, around it one level, and the camera's noise over all."""
    middle, radius = rest.mean(axis=0), np.linalg.norm(rest - rest.mean(axis=0), axis=1).max()
    y, x = np.mgrid[: images[0].shape[0], : images[0].shape[1]]
    kept = np.clip((share * radius - np.hypot(x - middle[0], y - middle[1])) / max(soft_px, 1e-6) + 0.5, 0, 1)
    noise = np.random.default_rng(0).normal(0, noise_sd, (len(images), *images[0].shape))
    return [np.clip(kept * image + (1 - kept) * level + more, 0, 255).astype(np.uint8) for image, more in zip(images, noise, strict=True)]


@pytest.mark.parametrize(
    ("share", "look"),
    [
        pytest.param(0.86, {}, marks=pytest.mark.slow),
        pytest.param(0.9, {"level": 12.0, "soft_px": 4.8}, marks=pytest.mark.slow),
        (0.62, {"noise_sd": 8.0}),
    ],
    ids=["noise", "a soft gray edge", "much noise, two rings hidden"],
)
def test_a_layout_behind_a_round_mask_is_never_sure(share, look):
    """What the mask leaves looks like a smaller layout that explains everything: nothing is seen beyond it, not even a housing."""
    pins = PinsSpec(rings=6)
    rest = rest_of(pins)
    found = identify(masked(frames_of(rest, 2, contact_px=1.8), rest, share, **look))
    assert found.best.pins.count < pins.count and found.best.explained > 0.95, found.best.line()
    assert not found.sure and any("may be cut off" in doubt for doubt in found.doubts)


@pytest.mark.usefixtures("few_sizes")
def test_a_mask_that_shows_the_housing_leaves_the_layout_sure():
    rest = rest_of(PinsSpec(rings=6))
    found = identify(masked(frames_of(rest, 2, contact_px=1.8), rest, 1.3))
    assert found.sure and same(found.best.pins, PinsSpec(rings=6)), found.doubts


def test_a_layout_whose_pins_fall_together_explains_nothing():
    """Labels of a grid that are put on rings can bring two of its pins to one place."""
    pins = PinsSpec(rings=3)
    rest = rest_of(pins)
    spots = find_bumps(frames_of(rest, 1)[0], 6.0)
    assert _match_known(pins, rest, [spots])[0].explained > 0.9
    rest[5] = rest[6]
    assert _match_known(pins, rest, [spots])[0].explained == 0.0


@pytest.mark.usefixtures("few_sizes")
def test_a_pin_that_the_rim_lacks_may_be_dark_and_is_not_sure():
    whole = PinsSpec(rings=4)
    found = identify(frames_of(np.delete(rest_of(whole), 50, axis=0), 2, contact_px=1.8, ring=False))
    assert found.best.pins.missing and not found.sure and any("too dark to be seen" in doubt for doubt in found.doubts)


def test_frames_turned_and_filled_show_the_layout():
    """A turned frame's corners are filled, and its cut pins are not in view: they count neither for the layout nor against it."""
    pins = PinsSpec(rings=6)
    images = frames_of(rest_of(pins, radius=123.0), 2, ring=False)
    turn = cv2.getRotationMatrix2D((149.5, 125.5), 37, 1.0)
    turn[:, 2] += 30
    turned = [cv2.warpAffine(image[13:239], turn, (360, 336)) for image in images]
    found = identify(turned)
    assert same(found.best.pins, pins) and found.best.explained > 0.97, found.best.line()


def test_stray_light_and_specks_do_not_change_the_layout():
    pins = PinsSpec(rings=6)
    images = frames_of(rest_of(pins), 2)
    rng = np.random.default_rng(0)
    for image in images:
        glow = np.zeros(image.shape, np.float32)
        cv2.circle(glow, (198, 96), 36, 90, -1)
        np.copyto(image, np.clip(image + cv2.GaussianBlur(glow, (0, 0), 21), 0, 255).astype(np.uint8))
        for x, y in rng.uniform((90, 72), (210, 180), (6, 2)).astype(int):
            cv2.circle(image, (int(x), int(y)), 2, 255, -1)
    found = identify(images)
    assert same(found.best.pins, pins), found.best.line()


@pytest.mark.usefixtures("few_sizes")
@pytest.mark.parametrize(
    ("shown", "offered"),
    [
        pytest.param(PinsSpec(rings=10), PinsSpec(rings=9), marks=pytest.mark.slow),
        (PinsSpec(rings=6), PinsSpec(rings=4)),
        pytest.param(PinsSpec(rings=5), PinsSpec(rings=6), marks=pytest.mark.slow),
        pytest.param(PinsSpec(rings=6), PinsSpec(layout="hexagon", rings=4), marks=pytest.mark.slow),
        pytest.param(PinsSpec(layout="hexagon", rings=6), PinsSpec(rings=6), marks=pytest.mark.slow),
    ],
    ids=lambda p: p.in_words(),
)
def test_a_wrong_layout_is_never_sure_and_the_right_one_is_named(shown, offered):
    spec = load_sensor("mg400-331").model_copy(update={"pins": offered})
    frames = [Frame(image, Form.RAW) for image in frames_of(rest_of(shown), 2)]
    try:
        tuned = tune(frames, spec)
    except FrameError as error:
        assert shown.in_words() in str(error)
    else:
        assert tuned.detector.evidence.sure == "unsure"
        assert any(shown.in_words() in note for note in tuned.notes), tuned.notes


def test_frames_without_pins_are_refused_with_what_to_do():
    noise = np.random.default_rng(0).integers(0, 255, (150, 200)).astype(np.uint8)
    for image in (np.zeros((150, 200), np.uint8), noise, np.zeros((1, 1), np.uint8), np.full((10, 800), 255, np.uint8)):
        with pytest.raises(FrameError, match="positions"):
            identify([image])


def test_given_positions_are_seen_wherever_they_lie():
    rng = np.random.default_rng(3)
    places = pin_lattice(PinsSpec(rings=4)).places + rng.normal(0, 0.04, (61, 2))
    pins = PinsSpec(layout="positions", positions=tuple(map(tuple, places.tolist())))
    shown = score_layout(pins, frames_of(rest_of(pins, turn_deg=140.0)))
    assert shown is not None and shown.explained > 0.97
    assert len(symmetries(pins)) == 1


def test_a_reflection_of_an_led_beside_a_cap_does_not_draw_it_away():
    y, x = np.mgrid[:200, :240].astype(float)
    caps = np.array([[60.0 + 24 * i, 52.0 + 24 * j] for i in range(6) for j in range(5)])
    dark = 4 + 40 * sum(np.exp(-((((x - a) ** 2 + (y - b) ** 2) / (2 * 5.0**2)) ** 3)) for a, b in caps)
    glint = 255.0 * (((x - 137) ** 2 + (y - 107) ** 2) < 9)  # 6.4 px beside the cap at (132, 100), as bright as reflections are
    clean, lit = (find_bumps(np.clip(image, 0, 255).astype(np.uint8), 3.7) for image in (dark, np.maximum(dark, glint)))
    nearest = lambda found: np.linalg.norm(found.px[:, None] - caps, axis=2).min(axis=0)  # noqa: E731
    assert nearest(clean).max() < 0.3 and nearest(lit).max() < 1.0
    white = np.where(dark > 24, 255, 0).astype(np.uint8)  # in a thresholded frame every cap is white, and none is a glint
    assert nearest(find_bumps(white, 3.7)).max() < 0.5


def test_frames_of_inverted_contrast_show_the_same_layout_of_dark_pins():
    found = identify([255 - image for image in frames_of(rest_of(PinsSpec(rings=4)), 2)])
    assert (found.polarity, found.best.pins.layout, found.best.pins.rings) == ("dark", "rings", 4) and found.sure


@pytest.mark.usefixtures("few_sizes")
def test_thresholded_frames_of_fading_light_are_not_sure():
    """A fixed threshold makes caps in dark corners black, and those before them small; a local one leaves them alike."""
    pins = PinsSpec(rings=6)
    images = frames_of(rest_of(pins, radius=90.0), 2, contact_px=1.8)
    y, x = np.mgrid[: images[0].shape[0], : images[0].shape[1]]
    light = np.clip(1.0 - 0.8 * np.hypot(x - 155, y - 122) / 90, 0, 1)
    even = identify([np.where(image > 70, 255, 0).astype(np.uint8) for image in images])
    faded = identify([np.where(cv2.GaussianBlur(image, (0, 0), 1.8) * light > 32, 255, 0).astype(np.uint8) for image in images])
    assert even.sure and even.best.pins.rings == 6, even.doubts
    assert not faded.sure and any("light fades" in doubt for doubt in faded.doubts), faded.best.line()
