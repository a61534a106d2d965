"""The studio's page over its own protocol, without a browser: drag, sliders, each mode, two clients, and what is refused."""

import json
import re
import threading
import time
from html import escape
from pathlib import Path
from urllib.request import Request as Asked
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
import trimesh
from drawn_frames import drawn_frame, smooth_warp
from studio_client import StudioClient
from unknown_sensor import leave_out_costs
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Request

from hardware.errors import DeviceError
from hardware.live import studio_mode
from hardware.live.studio_mode import CameraFeed, LiveMode, WatchedArm
from scenes import load_sensor
from training.estimate.estimator import models_by_sensor
from twin.errors import TwinError
from twin.frames.images import write_image
from twin.pins import nominal_reference
from twin.studio.page import from_own_page
from twin.studio.scene import Scene
from twin.studio.state import StudioState, first_state
from twin.studio.studio import Studio, StudioPlan
from twin.types import Form

SENSOR = "mg400-127"
RADIUS_MM = load_sensor(SENSOR).skin.outer_radius_mm
WAIT_S = 40.0


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    out = tmp_path_factory.mktemp("studio")
    plan = StudioPlan(first_state(None, SENSOR, "sphere"), out, port=18090, traces=False)
    with Studio(plan, models_by_sensor(None), LiveMode) as made:
        yield made


@pytest.fixture()
def client(studio):
    with StudioClient(studio.page.url) as made:
        made.wait(lambda u: bool(made.gui), WAIT_S)
        studio.page.choose("Twin")
        made.wait(lambda u: u.number > 0, WAIT_S)
        yield made


def write_recording(folder, spec, count):
    """A labelled recording of rasterised frames; its first label can't be right."""
    reference, rng = nominal_reference(spec, Form.PROCESSED), np.random.default_rng(0)
    (folder / "frames_bw").mkdir(parents=True)
    write_image(folder / "init_0.png", drawn_frame(spec, Form.PROCESSED, reference.pins_px).image)
    rows = ["image_name,pose_2,pose_6,move_1,move_6"]
    for k in range(count):
        frame = drawn_frame(spec, Form.PROCESSED, smooth_warp(reference.pins_px, 3.0, rng))
        write_image(folder / "frames_bw" / f"frame_{k}_0.png", frame.image)
        rows.append(f"frame_{k}_0.png,{40.0 if k == 0 else -3.0},0.0,0.0,0.0")
    (folder / "targets.csv").write_text("\n".join(rows) + "\n")
    return folder


def drag(client, depth, x=0.0, *, to=None):
    """Drag the gizmo and wait for the answer at a depth, by default that of the gizmo."""
    since, to = len(client.updates), depth if to is None else to
    client.drag((x, 0.0, RADIUS_MM - depth))
    return client.wait(lambda u: u.number > 0 and abs(u.depth_mm - to) < 1e-4, WAIT_S, since=since)


def test_a_drag_moves_skin_picture_numbers_and_estimate_together(client):
    drag(client, 1.0)
    client.wait(lambda u: "90 % interval" in u.html, WAIT_S)
    update = drag(client, 2.5)
    assert update.pictures >= 2 and {"/sensor/skin", "/sensor/pins", "/object"} <= update.nodes
    assert "127 of 127" in update.html and "usual mesh" in update.html and "rasterised" in update.html


def test_answers_come_in_order_and_each_shows_its_own_pose(client):
    since = len(client.updates)
    for depth in np.linspace(0.5, 2.5, 15):
        client.drag((0.0, 0.0, RADIUS_MM - depth))
        time.sleep(0.02)
    client.wait(lambda u: abs(u.depth_mm - 2.5) < 1e-4, WAIT_S, since=since)
    shown = [u for u in client.updates[since:] if u.number > 0]
    assert [u.number for u in shown] == sorted({u.number for u in shown})


def test_an_impossible_place_stops_the_object_and_says_why(client):
    since = len(client.updates)
    client.set("object", "plane")
    client.set("depth, mm", 19.5)
    update = client.wait(lambda u: "half the gel" in u.html or "stays here" in u.html, 3 * WAIT_S, since=since)
    assert update.depth_mm < 19.5
    client.set("object", "sphere")
    drag(client, 1.0)


def test_nonsense_from_a_browser_is_told_and_changes_nothing(client):
    drag(client, 1.0)
    client.drag((float("nan"), 0.0, 19.0))
    assert "not a finite number" in wait_html(client, "not a finite number")
    client.drag((0.0, 0.0, 19.0), (0.0, 0.0, 0.0, 0.0))
    client.set("mode", "No such mode")
    drag(client, 1.5)


def test_two_browsers_see_the_same_and_one_that_returns_finds_it(studio, client):
    with StudioClient(studio.page.url) as other:
        other.wait(lambda u: u.number > 0, WAIT_S)
        since = len(other.updates)
        drag(client, 1.75)
        other.wait(lambda u: abs(u.depth_mm - 1.75) < 1e-4, WAIT_S, since=since)
    with StudioClient(studio.page.url) as again:
        assert abs(again.wait(lambda u: u.number > 0, WAIT_S).depth_mm - 1.75) < 1e-4


def test_sliders_undo_and_what_is_shown(client):
    drag(client, 1.0)
    time.sleep(1.0)
    since = len(client.updates)
    client.set("depth, mm", 2.0)
    client.wait(lambda u: abs(u.depth_mm - 2.0) < 1e-4, WAIT_S, since=since)
    since = len(client.updates)
    client.set("Undo", True)
    client.wait(lambda u: abs(u.depth_mm - 1.0) < 1e-4, WAIT_S, since=since)
    for label, value, word in (("colour pins by", "pressure", "MPa"), ("frame", "processed", "mm"), ("frame", "raw", "mm")):
        since = len(client.updates)
        client.set(label, value)
        client.wait(lambda u, word=word: word in u.html, WAIT_S, since=since)


def test_picture_and_state_are_saved_and_open_again(studio, client, tmp_path):
    out = Path(studio.twin._out)
    drag(client, 1.25, 0.5)
    client.set("Save picture", True)
    client.set("Save state", True)
    end = time.monotonic() + WAIT_S
    while len(list(out.glob("[!.]*-1.*"))) < 2 and time.monotonic() < end:
        time.sleep(0.05)
    state = StudioState.load(out / "state-1.json")
    assert state.pose["depth_mm"] == pytest.approx(1.25) and state.pose["x_mm"] == pytest.approx(0.5)
    studio.twin.open(state)
    since = len(client.updates)
    client.wait(lambda u: abs(u.depth_mm - 1.25) < 1e-4, WAIT_S, since=since)


def test_a_link_shows_its_state_again_and_not_from_a_foreign_page(studio, client):
    drag(client, 1.5, 0.75)
    end = time.monotonic() + WAIT_S
    while "depth_mm=1.5&" not in str(client.value("link")) and time.monotonic() < end:
        time.sleep(0.02)
    link = str(client.value("link"))
    assert link.startswith(studio.page.url) and "x_mm=0.75" in link
    drag(client, 2.0)
    for site in ("cross-site", "none"):
        since = len(client.updates)
        with urlopen(Asked(link.replace("depth_mm=1.5", f"depth_mm={len(site)}e-1"), headers={"Sec-Fetch-Site": site})) as page:
            assert b"<html" in page.read()
    update = client.wait(lambda u: u.number > 0 and u.depth_mm not in (2.0, 1.5), WAIT_S, since=since)
    client.wait(lambda u: abs(u.depth_mm - 0.4) < 1e-4, WAIT_S, since=since)
    assert update.depth_mm <= 0.4 + 1e-4
    client.set("link", "?sensor=nothing&object=sphere")
    wait_html(client, "no sensor named &#x27;nothing&#x27;")


def test_an_answer_of_the_sensor_that_is_being_replaced_does_no_harm(studio, client, monkeypatch):
    """While the new sensor's scene is made, the scene of the old one is gone; an answer of the old one may come just then."""
    drag(client, 1.5)
    old, failed, threads = studio.twin.worker.newest, [], []

    def publish():
        try:
            studio.twin._publish(old)
        except BaseException as error:
            failed.append(error)

    def scene(*arguments):
        made = Scene(*arguments)
        threads.append(threading.Thread(target=publish))
        threads[0].start()
        threads[0].join(0.3)
        return made

    monkeypatch.setattr("twin.studio.modes.twin_mode.Scene", scene)
    studio.twin.open(StudioState(sensor="mg400-331", object="sphere", pose={"depth_mm": 1.0}))
    threads[0].join(WAIT_S)
    assert not failed
    client.wait(lambda u: "of 331" in u.html, WAIT_S)
    monkeypatch.undo()
    since = len(client.updates)
    studio.twin.open(StudioState(sensor=SENSOR, object="sphere", pose={"depth_mm": 1.0}))
    client.wait(lambda u: "of 127" in u.html, WAIT_S, since=since)


def test_an_object_that_is_chosen_while_a_sensor_opens_is_kept(studio, client):
    drag(client, 1.5)
    since = len(client.updates)
    client.set("sensor", "mg400-331")
    client.set("object", "cylinder")
    client.wait(lambda u: "of 331" in u.html, WAIT_S, since=since)
    end = time.monotonic() + WAIT_S
    while {studio.twin.contact.setup.obj.name, client.value("object")} != {"cylinder"} and time.monotonic() < end:
        time.sleep(0.02)
    assert studio.twin.contact.setup.obj.name == client.value("object") == "cylinder"
    since = len(client.updates)
    studio.twin.open(StudioState(sensor=SENSOR, object="sphere", pose={"depth_mm": 1.0}))
    client.wait(lambda u: "of 127" in u.html, WAIT_S, since=since)


def test_a_depth_that_is_chosen_while_an_object_is_taken_or_a_sensor_opens_is_kept(studio, client, monkeypatch):
    drag(client, 2.0)
    twin, taken, prepare = studio.twin, studio.twin.contact.change, studio.twin._prepare

    def take(**given):
        taken(**given)
        client.set("depth, mm", 0.6)
        until(lambda: twin._wish.depth_mm == 0.6)

    monkeypatch.setattr(twin.contact, "change", take)
    since = len(client.updates)
    client.set("object", "plane")
    client.wait(lambda u: abs(u.depth_mm - 0.6) < 1e-4, WAIT_S, since=since)
    monkeypatch.undo()

    def prepared(state):
        client.set("depth, mm", 1.2)
        until(lambda: twin._wish.depth_mm == 1.2)
        return prepare(state)

    monkeypatch.setattr(twin, "_prepare", prepared)
    since = len(client.updates)
    client.set("sensor", "mg400-331")
    client.wait(lambda u: "of 331" in u.html and abs(u.depth_mm - 1.2) < 0.1, WAIT_S, since=since)
    monkeypatch.undo()
    since = len(client.updates)
    twin.open(StudioState(sensor=SENSOR, object="sphere", pose={"depth_mm": 1.0}))
    client.wait(lambda u: "of 127" in u.html, WAIT_S, since=since)


def test_a_choice_whose_callback_comes_late_is_kept_and_every_browser_shows_it(studio, client, monkeypatch):
    """The page has the new value before the callback runs; and a browser may get an older value of the program after its own choice."""
    drag(client, 1.5)
    control = studio.twin._object

    def scene(*arguments):
        control._impl.value = "cylinder"  # the choice has come, and its callback waits for a thread
        return Scene(*arguments)

    monkeypatch.setattr("twin.studio.modes.twin_mode.Scene", scene)
    studio.twin.open(StudioState(sensor=SENSOR, object="sphere", pose={"depth_mm": 1.0}))
    assert control.value == "cylinder"
    client.gui[client.uuid("object")]["value"] = "sphere"
    studio.twin._change_object()
    until(lambda: studio.twin.contact.setup.obj.name == client.value("object") == "cylinder")
    monkeypatch.undo()
    studio.twin.open(StudioState(sensor=SENSOR, object="sphere", pose={"depth_mm": 1.0}))
    until(lambda: client.value("object") == "sphere")


def test_degrade_shows_the_same_contact_with_its_limits(client):
    drag(client, 2.0)
    since = len(client.updates)
    client.set("mode", "Degrade")
    html = wait_html(client, "<th>limit</th>")
    assert "not degraded" in html
    client.set("severity 1", 1.0)
    html = wait_html(client, "class='bad'")
    assert since < len(client.updates)
    client.set("Find breaking point", True)
    assert re.search(r"Breaking point of this contact: .* is tolerated up to", wait_html(client, "Breaking point of this contact"))
    client.set("Reset", True)
    client.set("mode", "Twin")


def wait_html(client, text):
    """The page's HTML once it holds a text."""
    end = time.monotonic() + 2 * WAIT_S
    while text not in client.html():
        assert time.monotonic() < end, client.html()[-1500:]
        time.sleep(0.05)
    return client.html()


def until(true):
    """Wait until a condition is true."""
    end = time.monotonic() + 2 * WAIT_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_recording_is_shown_with_labels_doubts_and_the_twins_picture(studio, client, tmp_path):
    folder = write_recording(tmp_path / "recording", load_sensor(SENSOR), 3)
    until(lambda: studio.twin.contact.model is not None)
    client.set("mode", "Recording")
    client.set("folder or video", str(tmp_path / "nothing"))
    client.set("Open", True)
    wait_html(client, "nothing: ")
    client.set("folder or video", str(folder))
    client.set("Open", True)
    html = wait_html(client, "1 of 3")
    assert "nothing: " not in html, "the earlier error is gone"
    assert "depth is outside the 90 % interval" in html or "No estimate" in html
    client.set("frame number", 2)
    wait_html(client, "3 of 3")
    for beyond, shown in ((-3, "1 of 3"), (7, "3 of 3")):
        client.set("frame number", beyond)
        wait_html(client, shown)
    client.set("mode", "Twin")


def test_a_recording_that_was_opened_before_its_model_was_loaded_gets_estimates(studio, client, tmp_path):
    folder = write_recording(tmp_path / "recording", load_sensor(SENSOR), 1)
    contact = studio.twin.contact
    until(lambda: contact.model is not None)
    model, contact.model = contact.model, None
    client.set("mode", "Recording")
    client.set("folder or video", str(folder))
    client.set("Open", True)
    wait_html(client, "no estimates: there is no model")
    contact.use(model)
    studio.twin.worker.show_again()
    until(lambda: "1 of 1" in (html := client.html()) and "no estimates" not in html)
    client.set("mode", "Twin")


def connect_live(client, folder, arm):
    """Connect the mode Live to the frames of a folder, and to an arm."""
    client.set("mode", "Live")
    client.set("camera", str(folder))
    client.set("arm", arm)
    client.set("Connect", True)


def test_live_shows_a_source_and_an_arm_that_is_read_only(studio, client, tmp_path):
    folder = write_recording(tmp_path / "recording", load_sensor(SENSOR), 3)
    until(lambda: studio.modes[3]._twin.contact.model is not None)
    connect_live(client, folder, "simulated")
    html = wait_html(client, "arm: read only")
    assert "tool within x 150 to 450" in html
    robot = studio.modes[3]._feed.robot
    before = robot._arm.state().pose.copy()
    with pytest.raises(TwinError, match="read only; arm it first"):
        robot.nudge(2, 1.0)
    assert np.array_equal(robot._arm.state().pose, before)
    client.set("armed: the page may move the arm", True)
    until(lambda: robot.armed)
    robot.nudge(2, 1.0)
    assert robot._arm.state().pose[2] == pytest.approx(before[2] + 1.0, abs=0.1)
    client.set("EMERGENCY STOP", True)
    until(lambda: not robot.armed)
    assert not robot._arm.state().enabled
    until(lambda: not studio.modes[3]._feed._thread.is_alive())
    wait_html(client, "has ended</p>")
    client.set("Check the sensor's health", True)  # of a source that has ended, too
    until(lambda: studio.modes[3]._health)
    wait_html(client, escape(studio.modes[3]._health[0]))
    client.set("Disconnect", True)
    client.set("mode", "Twin")


def test_live_shows_the_pins_of_a_sensor_without_a_model(studio, client, tmp_path):
    folder = write_recording(tmp_path / "recording", load_sensor(SENSOR), 3)
    contact = studio.modes[0].contact
    until(lambda: contact.model is not None)
    model, contact.model = contact.model, None
    try:
        connect_live(client, folder, "")
        html = wait_html(client, "pins found: 127 of 127")
        assert "No estimate: there is no model of this sensor" in html
        client.set("Disconnect", True)
        client.set("mode", "Twin")
    finally:
        contact.model = model


def test_of_feeds_connected_at_the_same_time_one_stays_and_every_other_lets_go_of_its_arm(studio, client, tmp_path, monkeypatch):
    class Feed(CameraFeed):
        def start(self, on_shot, on_end):
            time.sleep(0.2)  # so that each is still connecting when the next is asked for
            super().start(on_shot, on_end)

    feeds, live = [], studio.modes[3]
    monkeypatch.setattr(studio_mode, "CameraFeed", lambda *plan: feeds.append(Feed(*plan)) or feeds[-1])
    write_recording(tmp_path, load_sensor(SENSOR), 3)
    client.set("camera", "")
    until(lambda: not live._camera.value and live._twin.contact.model is not None)
    client.set("mode", "Live")
    until(lambda: live._active)
    live._camera.value, live._arm.value = str(tmp_path), "simulated"
    threads = [threading.Thread(target=ask) for ask in (live.connect, live.show, live.connect)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert len(feeds) >= 2 and [feed for feed in feeds if not feed._end.is_set()] == [live._feed]
    kept = live._feed
    live.show()
    assert live._feed is kept
    live.disconnect()
    assert all(feed._end.is_set() for feed in feeds) and live._feed is None
    client.set("mode", "Twin")


def test_a_specification_is_proposed_corrected_and_used(studio, client, tmp_path, monkeypatch):
    leave_out_costs(monkeypatch)
    reference, rng = nominal_reference(load_sensor(SENSOR), Form.PROCESSED), np.random.default_rng(1)
    middle = reference.pins_px.mean(axis=0)
    radius = np.linalg.norm(reference.pins_px - middle, axis=1).max()
    for k in range(4):
        frame = drawn_frame(load_sensor(SENSOR), Form.PROCESSED, smooth_warp(reference.pins_px, 2.0, rng))
        cv2.circle(frame.image, tuple(int(v) for v in middle), int(1.16 * radius), 255, 4)  # the housing: nothing is cut off
        write_image(tmp_path / f"mine_{k}.png", frame.image)
    client.set("mode", "Your own sensor")
    client.set("Use this sensor", True)
    wait_html(client, "nothing has been proposed yet")
    client.set("frames", str(tmp_path / "nothing"))
    client.set("Propose a specification", True)
    wait_html(client, "nothing: ")
    client.set("frames", str(tmp_path))
    client.set("Propose a specification", True)
    html = wait_html(client, "127 pins in a hexagon of 6 rings")
    assert "UNSURE" not in html and "mine_0.png (1 of 4)" in html and "127 of 127" in html
    client.set("correct the layout", "one smaller")
    assert "UNSURE" in wait_html(client, "91 pins in a hexagon of 5 rings")
    client.set("Use this sensor", True)
    client.wait(lambda update: update.number > 0 and "my-sensor" in str(client.value("sensor")), 2 * WAIT_S)
    assert studio.twin.state.pose["depth_mm"] > 0, "a sensor without contact shows nothing"
    studio.twin.open(first_state(None, SENSOR, "sphere"))


@pytest.mark.parametrize("origin", ["http://elsewhere.example", "null", "file://", "http://127.0.0.1:1"])
def test_a_page_of_another_site_is_refused_before_it_can_say_anything(studio, origin):
    """Also a local file and a frame without rights, whose origin browsers call null."""
    with pytest.raises(InvalidStatus) as refused, StudioClient(studio.page.url, origin=origin):
        pass
    assert refused.value.response.status_code == 403


def test_a_name_that_leads_to_this_machine_by_chance_is_refused():
    """Any site can give its name this machine's address, and its page would then be the server's own."""
    hosts = ("127.0.0.1", "localhost")
    for host, origin, own in (
        ("localhost:8", "http://localhost:8", True),
        ("localhost:8", None, True),
        ("LOCALHOST:8", "http://localhost:8", True),
        ("evil.example:8", "http://evil.example:8", False),
        ("evil.example:8", None, False),
        ("localhost:8", "http://localhost:9", False),
        ("[x", None, False),
        ("localhost:8", "http://[evil", False),
    ):
        headers = Headers({"Host": host} | ({} if origin is None else {"Origin": origin}))
        assert from_own_page(Request("/", headers), hosts) is own, (host, origin)
    assert from_own_page(Request("/", Headers({"Host": "tip.lab:8", "Origin": "http://tip.lab:8"})), ())
    assert not from_own_page(Request("/", Headers()), ())


def test_values_that_no_browser_gives_are_refused_and_put_back(client, tmp_path):
    holed = trimesh.creation.box((12.0, 12.0, 6.0))
    holed.update_faces(np.arange(len(holed.faces)) > 2)
    holed.export(tmp_path / "holed.stl")
    held = {name: client.value(name) for name in ("friction", "object", "frame", "colour pins by")}
    for label, value, reason in (
        ("friction", -1.0, "friction -1: give a number from 0 to"),
        ("friction", float("nan"), "friction nan"),
        ("object", "../../x", "../../x"),
        ("object", str(tmp_path / "holed.stl"), "not watertight"),
        ("frame", "cooked", "cooked&#x27; is not a value"),
        ("colour pins by", "smell", "smell&#x27; is not a value"),
    ):
        client.set(label, value)
        wait_html(client, reason)
        until(lambda: [client.value(name) for name in held] == list(held.values()))


def test_an_arm_of_no_known_kind_is_told_from_one_without_limits():
    with pytest.raises(DeviceError, match="no arm 'mg40:127.0.0.1'; there are"):
        WatchedArm("mg40:127.0.0.1")


def test_no_tunnel_is_ever_opened(studio):
    assert studio.page.server.request_share_url() is None


def test_another_host_is_warned_of(tmp_path):
    state = first_state(None, SENSOR, "sphere")
    assert not StudioPlan(state, tmp_path).warnings
    (warning,) = StudioPlan(state, tmp_path, host="0.0.0.0").warnings
    assert "no password" in warning
    assert json.loads(state.model_dump_json())["sensor"] == SENSOR
