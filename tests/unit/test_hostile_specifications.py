"""Specifications that try to do harm: numbers in disguise, files without bound, names that are paths. One line each, no traceback."""

import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.safety.decide import load_limits
from scenes import SpecError, load_experiment, load_object, load_randomisation, load_sensor, load_servo
from scenes.files import DEEPEST, LARGEST_BYTES
from scenes.load import SHIPPED
from twin.errors import TwinError
from twin.evaluation.degradation.study import load_plan
from twin.pins import load_detector

LONGEST_MESSAGE = 1000  # characters: what a terminal shows at once
BALL = 'description = "a ball"\nshape = { kind = "sphere", radius_mm = 4.0 }\n'
SENSOR = (SHIPPED / "sensors" / "mg400-127.toml").read_text()


def one_line(caught, *words) -> None:
    said = str(caught.value)
    assert len(said.splitlines()) == 1 and len(said) < LONGEST_MESSAGE, said
    for word in words:
        assert word in said, said


def refused(load, path: Path, *words) -> None:
    with pytest.raises((SpecError, TwinError)) as caught:
        load(path)
    one_line(caught, str(path), *words)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("thickness_mm = 1.0", "thickness_mm = true", "skin.thickness_mm"),
        ("thickness_mm = 1.0", 'thickness_mm = "1.0"', "skin.thickness_mm"),
        ("thickness_mm = 1.0", "thickness_mm = 1979-05-27", "skin.thickness_mm"),
        ("rings = 6", 'rings = "6"', "pins.rings"),
        ("rings = 6", "rings = true", "pins.rings"),
        ("rings = 6", "rings = 6.0", "pins.rings"),
        ("width_px = 640", "width_px = false", "camera.width_px"),
        ("skin_albedo = [", "skin_albedo = [true, ", "appearance.skin_albedo"),
    ],
)
def test_only_a_number_is_a_number(tmp_path, old, new, key):
    assert old in SENSOR
    path = tmp_path / "mine.toml"
    path.write_text(SENSOR.replace(old, new, 1))
    refused(load_sensor, path, key)


@pytest.mark.parametrize("number", ["true", '"4"', "[4]", "{ mm = 4 }", "04:00:00"])
def test_numbers_of_objects_are_strict_too(tmp_path, number):
    path = tmp_path / "ball.toml"
    path.write_text(BALL.replace("4.0", number))
    refused(load_object, path, "radius_mm")


@pytest.mark.parametrize("truth", ["1", '"true"', "0.0"])
def test_only_true_and_false_are_truths(tmp_path, truth):
    path = tmp_path / "mine.toml"
    path.write_text(SENSOR.replace("[gel]", f"[gel]\nsealed = {truth}", 1) if "sealed" not in SENSOR else SENSOR)
    refused(load_sensor, path, "gel.sealed")


def test_a_sign_that_is_a_truth_is_refused(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(SENSOR.split("[rig]")[0] + "\n[rig]\ntcp_to_dome_mm = -20.0\nturn_sign = true\n")
    refused(load_sensor, path, "rig.turn_sign")


def test_whole_numbers_serve_where_any_number_does(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(BALL.replace("4.0", "4"))
    assert load_object(path).shape.radius_mm == 4.0


LOADERS = [load_sensor, load_object, load_experiment, load_randomisation, load_servo, load_detector, load_plan, load_limits]


@pytest.mark.parametrize("load", LOADERS)
@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"a = " + b"[" * 100_000, "nested"),
        (b"a = " + b"[" * (DEEPEST + 1) + b"]" * (DEEPEST + 1), "nested"),
        (b"[" + b".".join([b"a"] * 5000) + b"]\n", "nested"),
        (b"a = " + b"9" * 5000, "64 bits"),
        (b"a = 0x" + b"f" * 100_000, "64 bits"),
        (b"[deep]\na = [1, 9223372036854775808]", "deep.a"),
        (b"# " + b"x" * LARGEST_BYTES, "larger"),
        (b"\xff\xfea\x00=\x001\x00", "UTF-8"),
        (b"a = \x00", "TOML"),
        (b"\x80\x02]q\x00.", "UTF-8"),
        (b"a = 1", "unknown key 'a'"),
    ],
    ids=["open", "nested", "dotted", "digits", "hex", "bits", "large", "utf16", "nul", "pickle", "key"],
)
def test_a_file_without_bound_is_refused_in_one_line(tmp_path, load, content, word):
    path = tmp_path / "mine.toml"
    path.write_bytes(content)
    refused(load, path, word)


@pytest.mark.parametrize("load", [load for load in LOADERS if load is not load_plan])  # a sweep without a key is everything as it is
def test_an_empty_file_is_told_what_it_lacks(tmp_path, load):
    path = tmp_path / "mine.toml"
    path.write_bytes(b"")
    refused(load, path, "missing")


def test_a_long_value_is_shown_by_its_beginning(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(BALL.replace("4.0", '"' + "x" * 100_000 + '"'))
    refused(load_object, path, "radius_mm", "xxx")


def test_thousands_of_faults_are_counted(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(BALL + "\n".join(f"key_{k} = 1" for k in range(5000)))
    refused(load_object, path, "key_0", "more")


def test_a_byte_order_mark_is_no_content(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_bytes(b"\xef\xbb\xbf" + BALL.encode())
    assert load_object(path).shape.radius_mm == 4.0


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("load", LOADERS)
def test_a_named_pipe_is_not_waited_for(tmp_path, load):
    path = tmp_path / "mine.toml"
    os.mkfifo(path)
    refused(load, path)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs an endless device")
@pytest.mark.parametrize("load", LOADERS)
def test_an_endless_device_is_not_read(tmp_path, load):
    path = tmp_path / "mine.toml"
    path.symlink_to("/dev/zero")
    refused(load, path)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"9" * 5000, "line 1"),
        (b"9" * 4000, "64 bits"),
        (b"x" * 5000, "line 1"),
        (b"\xff\xfe1\x00", "UTF-8"),
        (b"1," * LARGEST_BYTES, "larger"),
    ],
    ids=["digits", "bits", "text", "utf16", "large"],
)
def test_a_hostile_table_of_a_specification_is_one_line(tmp_path, content, word):
    path = tmp_path / "mine.toml"
    path.write_text(BALL.replace("4.0", '{ csv = "mine.csv", shape = [1] }'))
    (tmp_path / "mine.csv").write_bytes(content)
    refused(load_object, path, "mine.csv", word)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_table_that_is_a_named_pipe_is_not_waited_for(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(BALL.replace("4.0", '{ csv = "mine.csv", shape = [1] }'))
    os.mkfifo(tmp_path / "mine.csv")
    refused(load_object, path, "mine.csv", "named pipe")


def test_a_folder_is_no_specification(tmp_path):
    path = tmp_path / "mine.toml"
    path.mkdir()
    refused(load_sensor, path)


PATHS = ["../../../escaped", "/tmp/escaped", "a/b", "..\\\\escaped", "..", ".", "", "a\\u0000b", "line\\nbreak", "x\\u001b[31m", "n" * 300]


@pytest.mark.parametrize("name", PATHS)
def test_a_name_is_no_path(tmp_path, name):
    path = tmp_path / "ball.toml"
    path.write_text(f'name = "{name}"\n' + BALL)
    refused(load_object, path, "name")


@pytest.mark.parametrize(
    ("load", "source"),
    [
        (load_sensor, "sensors/mg400-127.toml"),
        (load_experiment, "experiments/surface-2d.toml"),
        (load_randomisation, "randomisations/moves.toml"),
        (load_servo, "servos/surface.toml"),
    ],
)
def test_no_specification_has_a_path_for_a_name(tmp_path, load, source):
    path = tmp_path / "mine.toml"
    path.write_text('name = "../../../escaped"\n' + (SHIPPED / source).read_text())
    refused(load, path, "name", "escaped")


def test_names_in_any_script_and_with_spaces_are_names(tmp_path):
    for name in ("Kugel groß", "球", "ball-10.v2 (copy)"):
        path = tmp_path / f"{name}.toml"
        path.write_text(BALL)
        assert load_object(path).name == name


@pytest.mark.skipif(os.name != "posix", reason="needs links")
@pytest.mark.parametrize("file", ["loop.stl", "a\\u0000b.stl", "nowhere/" * 1000 + "x.stl", "."])
def test_a_mesh_that_is_no_file_is_refused(tmp_path, file):
    (tmp_path / "loop.stl").symlink_to("loop.stl")
    path = tmp_path / "ball.toml"
    path.write_text(f'description = ""\nshape = {{ kind = "mesh", file = "{file}" }}\n')
    refused(load_object, path, "file")


@pytest.mark.skipif(os.name != "posix", reason="such a name is a path elsewhere")
def test_a_mesh_whose_file_has_no_usable_name_is_refused(tmp_path):
    path = tmp_path / "a\\b.stl"
    path.write_bytes(b"solid x\nendsolid x\n")
    refused(load_object, path, "name")


plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.dates() | st.times() | st.datetimes()
values = st.recursive(
    plain, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4), max_leaves=12
)


def as_toml(value) -> str:
    """A TOML value; what TOML has no word for is 0."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return '"' + "".join(f"\\U{ord(c):08x}" for c in value if not "\ud800" <= c <= "\udfff") + '"'
    if isinstance(value, list):
        return "[" + ", ".join(as_toml(part) for part in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{as_toml(key)} = {as_toml(part)}" for key, part in value.items()) + " }"
    return value.isoformat() if value is not None else "0"


KEYS = sorted({line.split("=")[0].strip() for line in SENSOR.splitlines() if "=" in line and not line.startswith("#")})


@settings(max_examples=60, deadline=None)
@given(key=st.sampled_from(KEYS), value=values)
def test_any_value_of_any_key_loads_or_is_explained(tmp_path_factory, key, value):
    lines = [f"{key} = {as_toml(value)}" if line.split("=")[0].strip() == key else line for line in SENSOR.splitlines()]
    path = tmp_path_factory.mktemp("any") / "mine.toml"
    path.write_text("\n".join(lines), encoding="utf-8", errors="replace")
    try:
        load_sensor(path)
    except SpecError as error:
        assert str(path) in str(error) and len(str(error).splitlines()) == 1


@settings(max_examples=150, deadline=None)
@given(load=st.sampled_from(LOADERS), content=st.binary(min_size=1, max_size=400) | st.text(min_size=1, max_size=400).map(str.encode))
def test_any_bytes_are_one_line(tmp_path_factory, load, content):
    path = tmp_path_factory.mktemp("any") / "mine.toml"
    path.write_bytes(content)
    try:
        load(path)
    except (SpecError, TwinError) as error:
        assert str(path) in str(error) and len(str(error).splitlines()) == 1 and len(str(error)) < LONGEST_MESSAGE
    else:
        assert load is load_plan, "a comment or white space alone is a sweep of everything, and nothing else"


@settings(max_examples=60, deadline=None)
@given(place=st.integers(0, len(SENSOR) - 1), width=st.integers(0, 30), instead=st.binary(max_size=8))
def test_a_damaged_specification_loads_or_is_one_line(tmp_path_factory, place, width, instead):
    data = SENSOR.encode()
    path = tmp_path_factory.mktemp("any") / "mine.toml"
    path.write_bytes(data[:place] + instead + data[place + width :])
    try:
        load_sensor(path)
    except SpecError as error:
        assert str(path) in str(error) and len(str(error).splitlines()) == 1
