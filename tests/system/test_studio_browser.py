"""The studio in a real Chromium: drawn, dragged, by keyboard, in a narrow window, each mode, and nothing in the browser's console."""

import shutil

import cv2
import numpy as np
import pytest
from browser_page import open_page

from hardware.live.studio_mode import LiveMode
from training.estimate.estimator import models_by_sensor
from twin.studio.state import first_state
from twin.studio.studio import Studio, StudioPlan

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium: apt-get install chromium")]
pytest.importorskip("playwright", reason="no playwright: pip install 'tactip-twin[browser]'")
LEAST_LIT = 40  # gray level of the brightest 1 % of a drawn scene


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    plan = StudioPlan(first_state(None, "mg400-127", "sphere"), tmp_path_factory.mktemp("studio"), port=18290, traces=False)
    with Studio(plan, models_by_sensor(None), LiveMode) as made:
        yield made


def shown(page):
    """(H, W, 3) uint8 of what the browser shows."""
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)


def depth(page):
    return float(page.get_attribute("[data-depth]", "data-depth"))


NOW = "parseFloat(document.querySelector('[data-depth]').dataset.depth)"


def await_change(page, before):
    page.wait_for_function(f"Math.abs({NOW} - ({before})) > 1e-4", timeout=60_000)


def await_depth(page, wanted):
    """The object may be seen on its way there."""
    page.wait_for_function(f"Math.abs({NOW} - ({wanted})) < 1e-3", timeout=60_000)


def test_the_page_is_drawn_and_moved_by_keys_alone(studio):
    with open_page(studio.page.url) as (page, messages):
        page.wait_for_timeout(3000)
        assert np.percentile(shown(page)[:, 400:880], 99) > LEAST_LIT
        before = depth(page)
        page.keyboard.press("Shift+PageDown")
        await_change(page, before)
        assert depth(page) == pytest.approx(before + 0.25, abs=1e-3)
        page.keyboard.press("Control+z")
        await_change(page, depth(page))
        assert depth(page) == pytest.approx(before, abs=1e-3)
        assert not messages


def test_a_typed_number_moves_the_object(studio):
    with open_page(studio.page.url) as (page, messages):
        field = page.locator("xpath=//label[normalize-space(text())='depth, mm']/following::input[not(@type='hidden')]").first
        field.fill("1.5")
        field.press("Enter")
        await_depth(page, 1.5)
        assert not messages


@pytest.mark.parametrize("mode", ["Degrade", "Recording", "Live", "Your own sensor", "Twin"])
def test_each_mode_opens(studio, mode):
    with open_page(studio.page.url) as (page, messages):
        studio.page.choose(mode)
        wanted = {
            "Degrade": "Find breaking point",
            "Recording": "Next doubtful label",
            "Live": "EMERGENCY STOP",
            "Your own sensor": "Propose a specification",
            "Twin": "Restart contact",
        }[mode]
        page.get_by_text(wanted).first.wait_for(state="visible", timeout=20_000)
        assert not messages


def test_a_narrow_window_has_the_controls(studio):
    with open_page(studio.page.url, width=420, height=800) as (page, messages):
        page.wait_for_timeout(2000)
        assert np.percentile(shown(page), 99) > LEAST_LIT
        assert page.locator("[data-depth]").count() == 1
        page.locator("img >> visible=true").first.wait_for(timeout=10_000)
        assert not messages
