"""The program as a user starts it: files, messages, exit codes."""

import json
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
import trimesh
from command import run_twin as twin

from scenes import load_sensor
from scenes.load import SHIPPED


def one_line_error(done, *words, code=1):
    assert done.returncode == code, done.stdout + done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("twin: error:")]
    assert len(lines) == 1 and "Traceback" not in done.stderr
    for word in words:
        assert word in lines[0], lines[0]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    out = tmp_path_factory.mktemp("render")
    done = twin("render", "--sensor", "mg400-127", "--object", "sphere", "--indent-mm", "2.5", "--shear-mm", "1", "-0.5", "--out", out)
    assert done.returncode == 0, done.stderr
    return out, done.stdout


def test_render_writes_what_it_says(rendered):
    out, said = rendered
    for name in ("frame.png", "frame.exr", "truth.npz", "truth.json", "skin.vtp", "panel.png"):
        assert (out / name).stat().st_size > 0 and str(out / name) in said
    assert "127 of 127 pins in the picture" in said
    truth = json.loads((out / "truth.json").read_text())
    assert truth["force_n"][2] > 0 and truth["area_mm2"] > 0
    assert truth["pose"]["shear_mm"] == [1.0, -0.5] and truth["sensor"]["name"] == "mg400-127"
    with np.load(out / "truth.npz", allow_pickle=False) as caps:
        assert caps["caps_mm"].shape == (127, 3) and caps["caps_px"].shape == caps["rest_px"].shape == (127, 2)
        assert caps["visible"].dtype == bool


def test_a_rendered_contact_states_the_interval_of_its_force_in_newtons(rendered):
    """As wide as the stiffness of the specification is uncertain, in what the command prints and in the file."""
    out, said = rendered
    truth = json.loads((out / "truth.json").read_text())
    size, factor, ends = np.linalg.norm(truth["force_n"]), load_sensor("mg400-127").skin.stiffness_factor, truth["force_size_90_n"]
    assert ends == pytest.approx([size / factor, size * factor])
    assert f"(size with 90 %: {ends[0]:.2f} to {ends[1]:.2f} N)" in said


def test_preprocess_finds_the_rendered_pins(rendered, tmp_path):
    out, _ = rendered
    done = twin("preprocess", out / "frame.png", "--sensor", "mg400-127", "--out", tmp_path, "--overlay")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "pins.npz", allow_pickle=False) as pins, np.load(out / "truth.npz") as truth:
        assert pins["image_name"].tolist() == ["frame.png"] and pins["pins_px"].shape == (1, 127, 2)
        error = np.linalg.norm(pins["pins_px"][0] - truth["caps_px"], axis=1)
        assert np.nanmedian(error) < 0.3 and pins["found"][0] >= 125
        assert np.isnan(pins["predicted_px"][0][np.isfinite(pins["pins_px"][0])]).all()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"] == 1 and summary["ms"]["total"]["p50"] > 0 and summary["parameters"]


@pytest.fixture(scope="module")
def pins(rendered, tmp_path_factory):
    """The file of the rendered frame's pins."""
    out = tmp_path_factory.mktemp("pins")
    assert twin("preprocess", rendered[0] / "frame.png", "--sensor", "mg400-127", "--out", out).returncode == 0
    return out / "pins.npz"


@pytest.mark.parametrize(("kind", "edges"), [("knn", 762), ("delaunay", None), ("voronoi", None)])
def test_graph_of_a_frame_and_of_its_pins(rendered, pins, tmp_path, kind, edges):
    out, _ = rendered
    graphs = []
    for source, folder in ((out / "frame.png", tmp_path / "a"), (pins, tmp_path / "b")):
        done = twin("graph", source, "--sensor", "mg400-127", "--kind", kind, "--out", folder)
        assert done.returncode == 0, done.stderr
        assert (folder / "graph.png").is_file() and (folder / "surface.png").is_file() == (kind == "voronoi")
        with np.load(folder / "graph.npz", allow_pickle=False) as data:
            graphs.append({key: data[key] for key in data})
    assert np.array_equal(graphs[0]["edges"], graphs[1]["edges"])
    assert edges is None or len(graphs[0]["edges"]) == edges
    assert np.isfinite(graphs[0]["area_px2"]).all() == (kind == "voronoi")


@pytest.mark.slow
def test_the_releases_method_on_a_frame_in_the_recordings_form(tmp_path):
    drawn = ("--form", "processed", "--quality", "rasterised")
    done = twin("render", "--sensor", "mg400-127", "--object", "plane", "--indent-mm", 0, *drawn, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert cv2.imread(str(tmp_path / "frame.png"), cv2.IMREAD_UNCHANGED).shape == (256, 256)
    assert json.loads((tmp_path / "truth.json").read_text())["force_n"] == [0, 0, 0]
    done = twin("graph", tmp_path / "frame.png", "--sensor", "mg400-127", "--legacy", "--out", tmp_path / "graph")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "graph" / "graph.npz") as data:
        assert len(data["edges"]) == 684
    one_line_error(
        twin("graph", tmp_path / "frame.png", "--sensor", "mg400-127", "--legacy", "--kind", "knn", "--out", tmp_path), "--legacy", code=2
    )


def test_good_frames_are_processed_and_bad_ones_listed(rendered, tmp_path):
    out, _ = rendered
    frames = tmp_path / "frames"
    frames.mkdir()
    good = cv2.imread(str(out / "frame.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(frames / "a_good.png"), good)
    (frames / "b_torn.png").write_bytes((out / "frame.png").read_bytes()[:900])
    cv2.imwrite(str(frames / "c_small.png"), good[:100, :100])
    cv2.imwrite(str(frames / "d_deep.png"), good.astype(np.uint16) * 257)
    cv2.imwrite(str(frames / "e_colour.png"), cv2.cvtColor(good, cv2.COLOR_GRAY2BGR) if good.ndim == 2 else good)
    done = twin("preprocess", frames, "--sensor", "mg400-127", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "b_torn.png" in done.stdout and "c_small.png" in done.stdout
    with np.load(tmp_path / "out" / "pins.npz") as pins:
        valid = dict(zip(pins["image_name"].tolist(), pins["valid"].tolist(), strict=True))
    assert valid["a_good.png"] and valid["e_colour.png"]


def test_bad_input_is_one_line_with_the_remedy(tmp_path):
    sensor = ("--sensor", "mg400-127", "--out", tmp_path / "out")
    one_line_error(twin("preprocess", tmp_path / "nowhere", *sensor), "nowhere")
    (tmp_path / "empty").mkdir()
    one_line_error(twin("preprocess", tmp_path / "empty", *sensor), "empty")
    (tmp_path / "torn.avi").write_bytes(b"RIFF....AVI ")
    one_line_error(twin("preprocess", tmp_path / "torn.avi", *sensor), "torn.avi")
    one_line_error(twin("graph", tmp_path / "nowhere.npz", *sensor), "nowhere.npz")
    one_line_error(
        twin("render", "--sensor", "mg400-172", "--object", "plane", "--indent-mm", 1, "--out", tmp_path), "did you mean 'mg400-127'"
    )
    typo = tmp_path / "mine.toml"
    typo.write_text((SHIPPED / "sensors" / "mg400-127.toml").read_text().replace("thickness_mm", "thicknes_mm", 1))
    one_line_error(twin("render", "--sensor", typo, "--object", "plane", "--indent-mm", 1, "--out", tmp_path), "mine.toml", "did you mean")


def test_a_damaged_pins_file_is_named(pins, tmp_path):
    whole = pins.read_bytes()
    for name, content in (("cut.npz", whole[: len(whole) // 2]), ("empty.npz", b""), ("text.npz", b"pins")):
        (tmp_path / name).write_bytes(content)
        one_line_error(twin("graph", tmp_path / name, "--sensor", "mg400-127", "--out", tmp_path / "g"), name, "twin preprocess")
    with np.load(pins) as data:
        arrays = {key: data[key] for key in data}
    np.savez(tmp_path / "holes.npz", **(arrays | {"pins_px": np.full_like(arrays["pins_px"], np.nan)}))
    one_line_error(twin("graph", tmp_path / "holes.npz", "--sensor", "mg400-127", "--out", tmp_path / "g"), "holes.npz", "prediction")
    one_line_error(twin("graph", pins, "--sensor", "mg400-331", "--out", tmp_path / "g"), "127", "331")


def test_no_good_frame_is_a_failure_that_still_leaves_its_summary(tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    cv2.imwrite(str(frames / "black.png"), np.zeros((256, 256), np.uint8))
    done = twin("preprocess", frames, "--sensor", "mg400-127", "--form", "processed", "--out", tmp_path / "out")
    one_line_error(done, "frames")
    with np.load(tmp_path / "out" / "pins.npz") as pins:
        assert pins["found"].tolist() == [0] and not pins["valid"].any()
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["invalid"][0]["image_name"] == "black.png"


def test_a_sensor_without_recording_form_says_so_before_it_presses(tmp_path):
    text = (SHIPPED / "sensors" / "mg400-127.toml").read_text()
    own = re.sub(r"\n\[(recording|pipeline\.processed)\].*?(?=\n\[)", "", text, flags=re.DOTALL)
    (tmp_path / "own.toml").write_text(own)
    asked = ("--sensor", tmp_path / "own.toml", "--object", "plane", "--indent-mm", 2, "--form", "processed", "--out", tmp_path)
    one_line_error(twin("render", *asked), "own", "raw form")


def test_unusable_meshes_are_named(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=8.0)
    holed = trimesh.Trimesh(ball.vertices, ball.faces[:-5])
    holed.export(tmp_path / "holed.stl")
    metres = ball.copy()
    metres.apply_scale(1e-5)
    metres.export(tmp_path / "metres.stl")
    for name, words in (("holed.stl", ["holed.stl", "watertight"]), ("metres.stl", ["metres.stl", "unit"])):
        done = twin("render", "--sensor", "mg400-127", "--object", tmp_path / name, "--indent-mm", 1, "--out", tmp_path / "out")
        one_line_error(done, *words)


def test_a_video_is_read_to_its_end(rendered, tmp_path):
    out, _ = rendered
    frame = cv2.imread(str(out / "frame.png"), cv2.IMREAD_COLOR)
    path = tmp_path / "clip.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, frame.shape[1::-1])
    for _ in range(4):
        video.write(frame)
    video.release()
    done = twin("preprocess", path, "--sensor", "mg400-127", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "out" / "pins.npz") as pins:
        assert len(pins["found"]) == 4 and (pins["found"] >= 120).all()


def test_lists_and_help_teach():
    assert "mg400-331" in twin("sensors").stdout and "tin-box" in twin("objects").stdout
    text = twin("render", "--help").stdout
    for word in ("--tilt-deg RX RY", "-z", "towards the object"):
        assert word in text
    assert load_sensor("ur5-331").name in twin("sensors").stdout


def test_doctor_says_what_will_be_used():
    done = twin("doctor")
    assert done.returncode == 0, done.stderr
    for word in ("LLVM", "GPU", "3D pictures", "camera", "serial"):
        assert word in done.stdout


def test_a_process_of_its_own_ends_the_same_way(tmp_path):
    """What the other tests see in this process is what a shell sees: text, the one line of an error, exit codes."""
    command = [sys.executable, "-c", "from twin.cli import main; main()"]
    said = subprocess.run([*command, "sensors"], capture_output=True, text=True, timeout=300)
    assert said.returncode == 0 and said.stdout == twin("sensors").stdout
    wrong = ("preprocess", str(tmp_path / "nowhere"), "--sensor", "mg400-127", "--out", str(tmp_path / "out"))
    done = subprocess.run([*command, *wrong], capture_output=True, text=True, timeout=300)
    one_line_error(done, "nowhere")
    assert done.stderr == twin(*wrong).stderr
