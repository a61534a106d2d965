"""The worker goes to the newest wish, in order, and traces and refines what stands still; files of the studio are read with care."""

import os
import socket
import threading
import time
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

from twin.errors import ContactError, TwinError
from twin.studio.contact import Light, SolvedMesh
from twin.studio.page import PORTS_TRIED, StudioPage, free_port, keep_upload
from twin.studio.pictures import RATE_HZ, FilmWriter
from twin.studio.pose import NAMES, ObjectPose
from twin.studio.state import LAST_STATE, MOST_BYTES, StudioState, first_state, read_trajectory, save_trajectory, tap_and_shear
from twin.studio.worker import Failed, Newest, Traced, Worker

WAIT_S = 20.0


class Stand:
    """Stands in for an answer."""

    def __init__(self, number, pose, arrived, lit=Light.RASTERISED, mesh=SolvedMesh.USUAL):
        self.number, self.pose, self.arrived, self.lit, self.mesh, self.state = number, pose, arrived, lit, mesh, None
        self.solved = number


class SlowContact:
    """Goes 1 mm in a step, each of which takes a moment; the fine mesh needs two pieces."""

    def __init__(self, step_s=0.005):
        self.step_s, self.depth, self.count, self.left, self.asked = step_s, 0.0, 0, 2, []
        self.newest = None
        self.refined = True

    def _made(self, **more):
        self.count += 1
        self.newest = Stand(self.count, ObjectPose(depth_mm=self.depth), **more)
        return self.newest

    def step(self, wished):
        time.sleep(self.step_s)
        self.asked.append(wished.depth_mm)
        if wished.depth_mm > 90:
            raise ContactError("too deep for this test")
        self.depth += float(np.clip(wished.depth_mm - self.depth, -1, 1))
        self.left, self.refined = 2, False
        return self._made(arrived=self.depth == wished.depth_mm)

    def newest_traced(self, solved, light, lit, ms):
        if self.newest is None or solved != self.newest.solved:
            return None
        made = self._made(arrived=True, lit=lit, mesh=self.newest.mesh)
        made.solved = solved
        return made

    def refine(self):
        self.left -= 1
        self.refined = self.left <= 0
        return self._made(arrived=True, mesh=SolvedMesh.FINE) if self.refined else None

    def again(self):
        return self._made(arrived=True)


class StandTracer:
    """Answers each trace at the next look."""

    def __init__(self, broken=False):
        self.jobs, self.broken, self.asked, self.started = [], broken, [], 0

    def start(self):
        self.started += 1

    def trace(self, number, state):
        self.asked.append(number)
        passes = [Traced(number, np.zeros((2, 2)), 1.0, rough) for rough in (True, False)]
        self.jobs = [Failed("no path tracing here", tracing=True)] if self.broken else passes

    def outcomes(self):
        jobs, self.jobs = self.jobs, []
        return jobs


class StartedWorker(Worker):
    """Works in its context."""

    def __enter__(self):
        self.start()

    def __exit__(self, *_):
        self.stop()


def run(contact, tracer=None):
    answers, said, news = [], [], threading.Condition()

    def heard(answer):
        with news:
            answers.append(answer)
            news.notify_all()

    def wait(wanted):
        with news:
            assert news.wait_for(lambda: any(map(wanted, answers)), WAIT_S)

    return StartedWorker(contact, tracer, heard, said.append), answers, said, wait


def test_only_the_newest_wish_counts():
    contact = SlowContact()
    worker, answers, _, wait = run(contact)
    with worker:
        for depth in range(1, 40):
            worker.ask(ObjectPose(depth_mm=float(depth)))
        worker.ask(ObjectPose(depth_mm=3.0))
        wait(lambda a: a.arrived and a.pose.depth_mm == 3.0)
    assert len(contact.asked) < 12
    assert [a.number for a in answers] == sorted({a.number for a in answers})


def test_what_stands_still_is_traced_then_refined_and_shown_with_its_own_picture():
    contact, tracer = SlowContact(), StandTracer()
    worker, answers, _, wait = run(contact, tracer)
    with worker:
        worker.ask(ObjectPose(depth_mm=2.0))
        wait(lambda a: a.lit is Light.TRACED and a.mesh is SolvedMesh.FINE)
    kinds = [(a.lit, a.mesh) for a in answers if a.arrived]
    usual = [(lit, SolvedMesh.USUAL) for lit in (Light.RASTERISED, Light.ROUGH, Light.TRACED)]
    assert kinds == [*usual, (Light.TRACED, SolvedMesh.FINE)]  # the fine mesh's picture comes when it is as good as the one before
    assert len(tracer.asked) == 2
    assert tracer.started >= 1


def test_without_a_tracer_the_fine_answer_comes_drawn():
    contact, tracer = SlowContact(), StandTracer(broken=True)
    worker, answers, said, wait = run(contact, tracer)
    with worker:
        worker.ask(ObjectPose(depth_mm=1.0))
        wait(lambda a: a.mesh is SolvedMesh.FINE)
    assert said == ["no path tracing here"] and answers[-1].lit is Light.RASTERISED


def test_an_error_is_told_and_the_next_wish_is_served():
    worker, _, said, wait = run(SlowContact())
    with worker:
        worker.ask(ObjectPose(depth_mm=99.0))
        end = time.monotonic() + WAIT_S
        while not said and time.monotonic() < end:
            time.sleep(0.005)
        worker.ask(ObjectPose(depth_mm=1.0))
        wait(lambda a: a.arrived)
    assert said == ["too deep for this test"]


def test_a_fault_of_the_program_is_told_and_ends_no_thread(caplog):
    contact = SlowContact()
    step, contact.step = contact.step, lambda wished: 1 / 0
    worker, _, said, wait = run(contact)
    with worker:
        worker.ask(ObjectPose(depth_mm=2.0))
        end = time.monotonic() + WAIT_S
        while not said and time.monotonic() < end:
            time.sleep(0.005)
        contact.step = step
        worker.ask(ObjectPose(depth_mm=1.0))
        wait(lambda a: a.arrived)
    assert "division by zero" in said[0] and "ZeroDivisionError" in caplog.text
    taken, failed = [], threading.Event()
    newest = Newest(lambda divisor: taken.append(1 / divisor), "test", lambda text: failed.set())
    newest.start()
    newest.give(0)
    assert failed.wait(WAIT_S)
    newest.give(1)
    while not taken and time.monotonic() < end + WAIT_S:
        time.sleep(0.005)
    newest.stop()
    assert taken == [1.0]


def test_a_way_is_gone_pose_by_pose_and_a_wish_ends_it():
    contact = SlowContact()
    worker, _, _, wait = run(contact)
    with worker:
        worker.play([(0.0, ObjectPose(depth_mm=1.0)), (0.01, ObjectPose(depth_mm=2.0)), (0.02, ObjectPose(depth_mm=1.0))])
        wait(lambda a: a.arrived and a.pose.depth_mm == 2.0)
        worker.play([(0.02 * k, ObjectPose(depth_mm=float(k % 2))) for k in range(500)])
        worker.ask(ObjectPose(depth_mm=5.0))
        wait(lambda a: a.arrived and a.pose.depth_mm == 5.0)
        assert not worker._way


def test_a_state_opens_again(tmp_path):
    state = first_state(None, "mg400-331", "sphere").model_copy(update={"friction": 0.3, "pose": {"x_mm": 1.0, "depth_mm": 2.0}})
    again = first_state(state.save(tmp_path / "state.json"), "ignored", "ignored")
    assert again == state and again.object_pose() == ObjectPose(x_mm=1.0, depth_mm=2.0)


def test_the_last_state_is_shown_again_unless_another_is_asked_for(tmp_path):
    assert first_state(None, None, None, tmp_path) == first_state(None, "mg400-331", "sphere")
    kept = first_state("?sensor=mg400-127&object=edge&depth_mm=1.5", None, None)
    kept.save(tmp_path / LAST_STATE)
    assert first_state(None, None, None, tmp_path) == kept
    assert first_state(None, "mg400-331", None, tmp_path).object == "sphere"
    (tmp_path / LAST_STATE).write_text("{ torn")
    assert first_state(None, None, None, tmp_path).sensor == "mg400-331"


def archive(**files):
    held = BytesIO()
    with ZipFile(held, "w") as written:
        for name, content in files.items():
            written.writestr(name, content)
    return held.getvalue()


def test_uploads_stay_in_their_own_folder(tmp_path):
    folder = tmp_path / "saves"
    assert keep_upload(folder, "../../a part.stl", b"solid").relative_to(folder).parts[1:] == ("_.._a_part.stl",)
    frames = keep_upload(folder, "mine.zip", archive(**{"mine/a.png": b"1", "mine/b.png": b"2"}))
    assert frames.name == "mine" and sorted(path.name for path in frames.iterdir()) == ["a.png", "b.png"]
    keep_upload(folder, "evil.zip", archive(**{"../../../out.txt": b"", "/abs.txt": b""}))
    assert [path.name for path in tmp_path.iterdir()] == ["saves"]
    with pytest.raises(TwinError, match="no readable archive"):
        keep_upload(folder, "torn.zip", b"PK\x03\x04")


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b"{}", b'{"sensor": "a", "object": "b", "more": 1}', b'{"sensor": "a", "object": "b", "form": "odd"}',
     b'{"sensor": "a", "object": "b", "pose": {"up": 1}}', b'{"sensor": "a", "object": "b", "studio": 2}', b"[" * 100_000,
     b" " * (MOST_BYTES + 1), b'{"sensor": "a", "object": "b", "pose": {"x_mm": NaN}}'],
)  # fmt: skip
def test_what_is_no_state_is_refused_in_one_line(content):
    with pytest.raises(TwinError, match="some.json: .*open a file that 'Save state' wrote") as error:
        StudioState.read(content, "some.json")
    assert "\n" not in str(error.value)


def test_a_link_opens_the_whole_state_again():
    state = StudioState(sensor="mg400-331", object="my part.toml", friction=0.3, pose={"x_mm": -1.25, "depth_mm": 2.0}, colour="pressure")
    link = state.link("http://127.0.0.1:8090/")
    assert StudioState.of_link(link) == state and StudioState.of_link(state.link()) == state
    assert first_state("?sensor=mg400-331&object=edge", "ignored", "ignored").object_pose() == ObjectPose(depth_mm=2.0)


@pytest.mark.parametrize(
    "link", ["", "?", "nothing", "?sensor=a", "?sensor=a&object=b&more=1", "?sensor=a&object=b&x_mm=nan", "?sensor=a&object=b&friction=-1",
             "?sensor=a&object=b&depth_mm=deep", "?sensor=a&object=b&form=odd", "?" + "a=1&" * 60,
             "?sensor=a\n&form=odd&object=" + "b" * 99]
)  # fmt: skip
def test_what_is_no_link_to_a_state_is_refused_in_one_line(link):
    with pytest.raises(TwinError, match="^link .*copy the link from the page") as error:
        StudioState.of_link(link)
    assert "\n" not in str(error.value)


def test_a_page_that_can_not_listen_says_so_and_does_not_wait():
    with socket.create_server(("127.0.0.1", 65535)):
        for host, port in (("999.1.1.1", 8090), ("nowhere.invalid", 8090), ("127.0.0.1", 65535)):
            with pytest.raises(TwinError, match=f"`host` {host} `port` {port}: can't listen there"):
                StudioPage("page", host=host, port=port)


def test_the_next_free_port_is_taken():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert port < free_port("127.0.0.1", port) <= port + PORTS_TRIED
    assert free_port("127.0.0.1", 0) == 0


def test_a_state_is_read_from_a_file_alone(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(TwinError, match=f"^{place}: can't be read .*give a file that 'Save state' wrote"):
            StudioState.load(place)


def test_a_way_is_written_and_read(tmp_path):
    way = tap_and_shear(ObjectPose(tilt_x_deg=5.0))
    again = read_trajectory(save_trajectory(tmp_path / "way.csv", way).read_bytes(), "way.csv")
    assert len(again) == len(way) and again[0][0] == 0.0
    for (t, pose), (s, other) in zip(way, again, strict=True):
        assert s == pytest.approx(t, abs=1e-3)
        assert [getattr(pose, n) for n in NAMES] == pytest.approx([getattr(other, n) for n in NAMES], abs=1e-4)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"x_mm\n1\n", "expected the columns"),
        (b"time_s,up\n1,2\n", "expected the columns"),
        (b"time_s,x_mm\n0,a\n", "no readable trajectory"),
        (b"time_s,x_mm\n0,1\n0,2\n", "time_s does not increase"),
        (b"time_s,x_mm\n", "0 rows"),
        (b"time_s,x_mm\n0,nan\n", "not a finite number"),
        (b"time_s,x_mm\n0,1,2\n", "no readable trajectory"),
        (b"\xff\xfe", "no readable trajectory"),
    ],
)
def test_what_is_no_way_is_refused(content, why):
    with pytest.raises(TwinError, match=why):
        read_trajectory(content, "way.csv")


def test_a_video_shows_each_picture_for_its_time(tmp_path):
    import cv2

    film = FilmWriter(tmp_path / "video.mp4")
    for k, at_s in enumerate((0.0, 1.0)):
        film.add(np.full((64, 97, 3), 40 + 150 * k, np.uint8), at_s=at_s)
    assert "saved" in film.close()
    video = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    levels = []
    while (read := video.read())[0]:
        levels.append(read[1].mean())
    assert len(levels) == pytest.approx(RATE_HZ + 1, abs=1) and levels[0] < 80 < 150 < levels[-1]


def test_nothing_shown_makes_no_video(tmp_path: Path):
    assert "no picture was shown" in FilmWriter(tmp_path / "video.mp4").close()
    assert not (tmp_path / "video.mp4").exists()


def test_poses_of_a_way_are_within_reach():
    poses = [pose for _, pose in tap_and_shear(replace(ObjectPose(), twist_deg=10.0))]
    assert all(pose.within_limits()[1] == "" and pose.twist_deg == 10.0 for pose in poses)
