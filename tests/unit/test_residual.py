"""The residual network: off it changes nothing, on it is the network that was taught, anywhere in the frame."""

import numpy as np
import pytest
import torch
from plain_sensor import changed
from pydantic import ValidationError

from scenes import load_sensor
from scenes.sensor import ResidualSpec
from training.runs import residual as teaching
from training.runs.residual import ResidualNetwork, spec_of, teach
from twin.camera.capture import before_stream, expose, luma_weights
from twin.camera.projection import Disc, lens_disc
from twin.camera.residual import average_colours, change, differences, refine, with_residual
from twin.errors import RenderError
from twin.optics.preview import Preview
from twin.pins import Pipeline
from twin.types import Form, Frame

ROUNDING = 1e-3
"""Gray levels by which two ways of summing single-precision numbers may differ."""
SHIFT_PX = 0.05
"""By how far 95 % of the pins' centroids may be moved."""


def a_network(seed=0):
    torch.manual_seed(seed)
    network = ResidualNetwork()
    torch.nn.init.normal_(list(network.parameters())[-2], std=0.05)
    return network


def a_disc(height=80, width=100, radius=37.0):
    y, x = np.mgrid[:height, :width]
    return Disc(np.array([51.0, 40.0]), radius, np.hypot(x - 51, y - 40) < radius)


@pytest.fixture(scope="module")
def network():
    return a_network()


@pytest.fixture(scope="module")
def residual(network):
    return spec_of(list(network.parameters()), a_disc())


def test_the_frame_is_changed_as_the_taught_network_says(network, residual):
    rng = np.random.default_rng(0)
    signal = rng.uniform(-20, 200, (20, 26, 3)).astype(np.float32)
    noise = rng.standard_normal((20, 26, residual.noises)).astype(np.float32)
    with torch.no_grad():
        taught = network(*(torch.from_numpy(part).permute(2, 0, 1)[None] for part in (signal, noise)))[0].permute(1, 2, 0).numpy()
    assert np.abs(taught).max() > 1
    np.testing.assert_allclose(change(signal, noise, residual), taught, atol=1e-2)  # weights are written with 5 digits


def test_outside_the_disc_only_colours_are_shared_and_luma_stays(residual):
    gray = np.random.default_rng(1).uniform(0, 255, (80, 100, 3)).astype(np.float32)
    luma = luma_weights("bt709")
    found = refine(gray, residual, luma, 2, np.random.default_rng(2), (0, 0))
    inside = a_disc(radius=38.0).inside
    np.testing.assert_allclose((found @ luma)[~inside], (gray @ luma)[~inside], atol=ROUNDING * 10)
    assert np.abs((found - gray) @ luma)[inside].mean() > 0.1
    chroma = (found @ differences(luma).T)[..., 1:]
    np.testing.assert_allclose(chroma[:, 0::2], chroma[:, 1::2], atol=ROUNDING * 10)


def test_a_window_of_a_frame_is_refined_as_in_the_whole_frame(residual):
    gray = np.random.default_rng(1).uniform(0, 255, (80, 100, 3)).astype(np.float32)
    whole = refine(gray, residual, luma_weights("bt709"), 2, None, (0, 0))
    part = refine(gray[10:70, 21:], residual, luma_weights("bt709"), 2, None, (21, 10))
    reach = 5  # px that the four kernels see
    np.testing.assert_allclose(part[reach:-reach, reach:], whole[10 + reach : 70 - reach, 21 + reach :], atol=ROUNDING * 10)


def test_groups_of_columns_begin_at_the_full_frames_first_column():
    chroma = np.arange(5, dtype=np.float32).reshape(1, 5, 1)
    assert average_colours(chroma, 2, 0).ravel().tolist() == [0.5, 0.5, 2.5, 2.5, 4]
    assert average_colours(chroma, 2, 3).ravel().tolist() == [0, 1.5, 1.5, 3.5, 3.5]


def test_it_is_off_unless_it_is_asked_for_and_gray_frames_never_have_it(residual):
    spec = load_sensor("ur5-331")
    own = changed(spec, response={"residual": residual})
    light = np.random.default_rng(0).uniform(0, 0.4, (80, 100, 3)).astype(np.float32)
    without = expose(light, changed(spec, response={"residual": None}).capture, np.random.default_rng(3))
    np.testing.assert_array_equal(expose(light, own.capture, np.random.default_rng(3)), without)
    assert (expose(light, with_residual(own).capture, np.random.default_rng(3)) != without).any()
    gray = light[..., 0]
    np.testing.assert_array_equal(expose(gray, with_residual(own).capture), expose(gray, spec.capture))


def test_a_sensor_without_a_network_and_one_with_too_few_weights_are_refused(residual):
    with pytest.raises(RenderError, match="no residual network.*leave `residual` out"):
        with_residual(load_sensor("mg400-331"))
    with pytest.raises(ValidationError, match="weights has 7090 numbers, 16 channels and 2 noises need 7091"):
        ResidualSpec.model_validate(residual.model_dump() | {"weights": residual.weights[1:]})


def test_the_same_seed_teaches_the_same_network_and_teaching_changes_it(monkeypatch):
    for name, few in {"BATCH": 4, "TURNED": 2, "ALONE": 1}.items():
        monkeypatch.setattr(teaching, name, few)
    spec = changed(load_sensor("ur5-331"), response={"residual": None})
    light = [np.random.default_rng(k).uniform(0, 0.4, (80, 100, 3)).astype(np.float32) for k in range(2)]
    real = [np.clip(before_stream(x, spec.capture, None) + 9, 0, 255).astype(np.uint8) for x in light]
    first, second, longer = (teach(real, light, spec, a_disc(radius=60.0), steps=steps) for steps in (3, 3, 4))
    assert first == second and first != longer


def test_the_shipped_network_leaves_the_pins_where_they_are():
    spec = load_sensor("ur5-331")
    disc = lens_disc(spec.view, spec.housing)
    assert spec.response.residual is not None and not spec.response.residual.used
    assert spec.response.residual.radius_px == pytest.approx(disc.radius_px, abs=0.01)
    light = Preview(spec).render()
    shown = [expose(light, each.capture, np.random.default_rng(0)) for each in (spec, with_residual(spec))]
    assert np.abs(shown[0].astype(int) - shown[1])[disc.inside].mean() > 0.3
    pins = [Pipeline(spec, Form.RAW)(Frame(image, Form.RAW, "a")).pins_px for image in shown]
    moved = np.linalg.norm(pins[0] - pins[1], axis=1)
    assert np.isfinite(moved).all() and np.quantile(moved, 0.95) < SHIFT_PX
