"""The studio in a real Chromium, wide and narrow, through all modes: nothing overlaps, no text is cropped, controls keep their places.

``make browser`` runs it. Pictures of each mode are in ``out/browser``.
"""

import shutil
from pathlib import Path

import pytest
from browser_page import open_page

from hardware.live.studio_mode import LiveMode
from training.estimate.estimator import models_by_sensor
from twin.studio.state import first_state
from twin.studio.studio import Studio, StudioPlan

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("chromium") is None, reason="no Chromium: apt-get install chromium")]
pytest.importorskip("playwright", reason="no playwright: pip install 'tactip-twin[browser]'")

OUT = Path("out/browser")
SIZES = {"wide": (1400, 900), "narrow": (400, 800)}
MODES = {
    "Twin": "Restart contact",
    "Degrade": "Find breaking point",
    "Recording": "Next doubtful label",
    "Live": "EMERGENCY STOP",
    "Your own sensor": "Use this sensor",
}
# without parts that lie in a control by intent: arrows of numbers, handles of sliders, buttons of panels
CONTROLS = """() => [...document.querySelectorAll(
    'button.mantine-Button-root, input:not([type=hidden]):not([type=file]), img[src^="blob:"]')]
  .filter(each => each.checkVisibility() && each.getBoundingClientRect().width > 0)
  .map((each, k) => { const box = each.getBoundingClientRect();
    return [each.textContent || each.value || each.tagName + k, box.left, box.top, box.right, box.bottom]; })"""
CROPPED = """() => [...document.querySelectorAll('.studio *, .mantine-Button-label, .mantine-Text-root, label')]
  .filter(each => each.checkVisibility() && each.clientWidth > 0 && each.scrollWidth > each.clientWidth + 1)
  .map(each => each.textContent)"""
OUTSIDE = """() => [...document.querySelectorAll('.studio *, .uplot, button.mantine-Button-root, input:not([type=hidden])')]
  .filter(each => each.checkVisibility() && (each.getBoundingClientRect().right > innerWidth + 1 || each.getBoundingClientRect().left < -1))
  .map(each => each.textContent || each.tagName)"""
PLACES = """() => [...document.querySelectorAll('button.mantine-Button-root, input:not([type=hidden]):not([type=file])')]
  .filter(each => each.checkVisibility()).map(each => Math.round(each.getBoundingClientRect().top))"""
LEGENDS = """() => [...document.querySelectorAll('.uplot')].map(each =>
  each.querySelector('.u-legend').getBoundingClientRect().top - each.querySelector('.u-wrap').getBoundingClientRect().bottom)"""
HIDDEN = "[...document.querySelectorAll('.numbers')].map(each => Math.max(each.scrollHeight - each.clientHeight, 0)).filter(each => each)"
DEPTH = "parseFloat(document.querySelector('[data-depth]')?.dataset.depth)"


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    OUT.mkdir(parents=True, exist_ok=True)
    plan = StudioPlan(first_state(None, "mg400-127", "sphere"), tmp_path_factory.mktemp("studio"), port=18390, traces=False)
    with Studio(plan, models_by_sensor(None), LiveMode) as made:
        yield made


@pytest.fixture(params=SIZES)
def page(studio, request):
    studio.page.choose("Twin")
    width, height = SIZES[request.param]
    with open_page(studio.page.url, width=width, height=height) as (opened, messages):
        opened.size = request.param
        await_depth(opened, None)
        yield opened
        assert not messages


def await_depth(page, wanted):
    """Wait until the numbers belong to a depth; None for any."""
    page.wait_for_function(f"Number.isFinite({DEPTH})" if wanted is None else f"Math.abs({DEPTH} - ({wanted})) < 1e-3", timeout=120_000)
    page.wait_for_timeout(1500)


def overlapping(boxes):
    """Pairs of controls that share more than a pixel of both directions."""
    return [
        (a[0], b[0])
        for k, a in enumerate(boxes)
        for b in boxes[:k]
        if min(a[3], b[3]) - max(a[1], b[1]) > 1 and min(a[4], b[4]) - max(a[2], b[2]) > 1
    ]


@pytest.mark.parametrize("mode", MODES)
def test_each_mode_shows_all_of_its_controls_and_text(studio, page, mode):
    studio.page.choose(mode)
    last = page.get_by_text(MODES[mode]).first
    last.wait_for(state="visible", timeout=20_000)
    page.wait_for_timeout(4000 if mode == "Degrade" else 1500)
    page.screenshot(path=OUT / f"{page.size}-{mode.split()[-1].lower()}.png")
    assert overlapping(page.evaluate(CONTROLS)) == []
    assert page.evaluate(CROPPED) == []
    assert page.evaluate(HIDDEN) == [], "numbers can be read without scrolling"
    assert page.evaluate(OUTSIDE) == []
    last.scroll_into_view_if_needed()
    box = last.bounding_box()
    assert box["y"] >= 0 and box["y"] + box["height"] <= SIZES[page.size][1], "it can be reached"
    page.screenshot(path=OUT / f"{page.size}-{mode.split()[-1].lower()}-end.png")
    if mode in ("Recording", "Live", "Your own sensor"):
        assert page.locator(".absent >> visible=true").is_visible() and not page.locator('img[src^="blob:"] >> visible=true').count()


def test_messages_and_stops_move_no_control(studio, page):
    pose = studio.twin.state.object_pose()
    field = page.locator("xpath=//label[normalize-space(text())='depth, mm']/following::input[not(@type='hidden')]").first
    field.click()
    page.wait_for_timeout(500)
    before = page.evaluate(PLACES)
    field.fill("19.5")
    field.press("Enter")
    page.locator(".numbers .stop").wait_for(state="visible", timeout=120_000)
    studio.page.say("a message", bad=True)
    page.get_by_text("a message").wait_for(state="visible", timeout=20_000)
    page.screenshot(path=OUT / f"{page.size}-stop.png")
    assert page.evaluate(PLACES) == before
    studio.page.hush()
    studio.twin.ask(pose)
    await_depth(page, pose.depth_mm)


def test_charts_have_their_legends_below_them_and_appear_in_their_mode_alone(studio, page):
    page.get_by_text("Charts", exact=True).first.click()
    page.locator(".uplot canvas").first.wait_for(state="visible", timeout=20_000)
    page.wait_for_timeout(1500)
    page.screenshot(path=OUT / f"{page.size}-charts.png")
    assert min(page.evaluate(LEGENDS)) >= 0
    assert page.evaluate(OUTSIDE) == []
    assert not page.locator(".absent >> visible=true").count()
    studio.page.choose("Recording")
    page.wait_for_timeout(1500)
    assert not page.locator(".uplot canvas >> visible=true").count()
    assert "There is no chart" in page.locator(".absent >> visible=true").inner_text()


def test_the_pictures_come_before_the_controls_of_a_narrow_window(studio, page):
    shown = ('img[src^="blob:"] >> visible=true', "input:not([type=hidden]) >> visible=true")
    picture, control = (page.locator(each).first.bounding_box(timeout=20_000) for each in shown)
    assert picture["y"] < control["y"] if page.size == "narrow" else picture["x"] < control["x"]


def test_a_lost_server_is_told_and_the_page_comes_back_to_the_same_state(tmp_path):
    def serve():
        return Studio(
            StudioPlan(first_state(None, *started, tmp_path), tmp_path, port=18490, traces=False), models_by_sensor(None), LiveMode
        )

    started = "mg400-127", "edge"
    with serve() as first:
        browser = open_page(first.page.url)
        page, _ = browser.__enter__()
        await_depth(page, None)
        first.twin.ask(first.twin.state.object_pose().__class__(x_mm=1.0, depth_mm=2.5))
        await_depth(page, 2.5)
    page.locator(".lost").wait_for(state="visible", timeout=30_000)
    page.screenshot(path=OUT / "lost.png")
    started = None, None
    with serve():
        page.locator(".lost").wait_for(state="hidden", timeout=60_000)
        await_depth(page, 2.5)
        page.screenshot(path=OUT / "back.png")
        browser.__exit__(None, None, None)
