"""Arrays beside a specification: what is written is read back, and a table that does not fit is refused with its remedy."""

import base64

import pytest

from scenes import SpecError, load_sensor
from scenes.load import SHIPPED
from scenes.sensor import SensorSpec
from scenes.tables import MOST_INLINE, fill_in_tables, take_out_tables
from twin.calibration.sensor_file import write_sensor

NAME = "ur5-331"
LEVELS = f"{NAME}.appearance.cap_levels.csv"


@pytest.fixture
def copied(tmp_path):
    """The shipped sensor with measured arrays, written to a folder of its own."""
    write_sensor(tmp_path / f"{NAME}.toml", load_sensor(NAME))
    return tmp_path / f"{NAME}.toml"


def test_the_shipped_tables_hold_what_was_measured():
    sensor = load_sensor(NAME)
    assert len(sensor.appearance.cap_levels) == len(sensor.appearance.cap_shapes) == len(sensor.appearance.cap_offsets) == sensor.pins.count
    light = sensor.housing.rim.light
    assert (len(light), len(light[0])) == (240, 32) and light[0][0] == (-12, -13, 3) and light[0][-1] == (-83, 67, 56)


def test_a_sensor_with_tables_reads_back_as_it_was_and_stays_readable(copied):
    assert load_sensor(copied) == load_sensor(NAME)
    assert len(copied.read_text().splitlines()) < 200
    assert not list(copied.parent.glob("*.partial"))


def test_the_dump_holds_the_numbers_and_not_the_reference():
    dump = load_sensor(NAME).model_dump()
    assert isinstance(dump["appearance"]["cap_levels"][0], float)
    assert SensorSpec.model_validate(dump) == load_sensor(NAME)


def test_tables_are_overwritten_together_with_the_specification(copied):
    sensor = load_sensor(NAME)
    darker = tuple(0.5 * level for level in sensor.appearance.cap_levels)
    changed = sensor.model_copy(update={"appearance": sensor.appearance.model_copy(update={"cap_levels": darker})})
    write_sensor(copied, changed)
    assert load_sensor(copied).appearance.cap_levels == pytest.approx(darker, rel=1e-5)  # written with six digits


def test_short_lists_stay_in_the_specification():
    short, long = (1.0,) * MOST_INLINE, (1.0,) * (MOST_INLINE + 1)
    kept, texts = take_out_tables({"a": {"short": short, "long": long, "names": ("x",) * 200}}, "mine")
    assert kept["a"]["short"] == short and kept["a"]["names"] == ("x",) * 200
    assert list(texts) == ["mine.a.long.csv"] and kept["a"]["long"] == {"csv": "mine.a.long.csv", "shape": [MOST_INLINE + 1]}


def test_whole_numbers_stay_whole_and_dimensions_keep_their_order(tmp_path):
    value = [[[100 * i + 10 * j + k for k in range(3)] for j in range(8)] for i in range(7)]
    kept, texts = take_out_tables({"light": value}, "mine")
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    read = fill_in_tables(kept, tmp_path)["light"]
    assert read == value and isinstance(read[6][7][2], int)


def test_a_missing_table_is_named_with_the_remedy(copied):
    (copied.parent / LEVELS).unlink()
    with pytest.raises(SpecError, match=rf"{NAME}.toml: appearance.cap_levels: the table .*{LEVELS} is missing; copy it"):
        load_sensor(copied)


@pytest.mark.parametrize("place", ["../{}", "/tmp/{}", "deeper/{}"])
def test_a_table_outside_the_folder_is_refused(copied, place):
    copied.write_text(copied.read_text().replace(f'"{LEVELS}"', f'"{place.format(LEVELS)}"'))
    with pytest.raises(SpecError, match="without a folder"):
        load_sensor(copied)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("shape = [331]", "shape = [330]", "has 331 lines of numbers, but shape = .330. needs 330"),
        ("shape = [331]", "shape = [331, 2]", "line 2 has 1 numbers, but shape = .331, 2. needs 2"),
        ("shape = [331]", "shape = [0]", "expected { csv = 'file name', shape = .numbers above 0. }"),
        (".cap_levels.csv", ".cap_levels.toml", "must be the name of a .csv file"),
    ],
)
def test_a_reference_that_does_not_fit_its_table_is_refused(copied, old, new, said):
    text = copied.read_text()
    assert old in text
    copied.write_text(text.replace(old, new, 1))
    with pytest.raises(SpecError, match=said):
        load_sensor(copied)


def test_a_table_of_another_sensor_is_refused(copied):
    table = copied.parent / LEVELS
    table.write_text("\n".join(table.read_text().splitlines()[:-1]) + "\n")
    copied.write_text(copied.read_text().replace("shape = [331]", "shape = [330]"))
    with pytest.raises(SpecError, match="appearance.cap_levels needs one number for each of the 331 pins"):
        load_sensor(copied)


def test_what_is_no_number_is_refused_with_its_line(copied):
    table = copied.parent / LEVELS
    table.write_text(table.read_text().replace("\n", "\nbright\n", 1))
    copied.write_text(copied.read_text().replace("shape = [331]", "shape = [332]"))
    with pytest.raises(SpecError, match=f"{LEVELS}, line 2: .*bright.*give numbers"):
        load_sensor(copied)


def test_a_shipped_table_has_a_reference():
    referred = {
        line.split('csv = "')[1].split('"')[0]
        for sensor in (SHIPPED / "sensors").glob("*.toml")
        for line in sensor.read_text().splitlines()
        if 'csv = "' in line
    }
    assert referred == {path.name for path in (SHIPPED / "sensors").glob("*.csv")}


PICTURE = f"{NAME}.housing.background.light.uri"


def test_a_picture_file_takes_the_place_of_a_data_uri(copied):
    """A background is replaced by putting the name of a picture file into the specification."""
    content = base64.b64decode((copied.parent / PICTURE).read_text().partition(",")[2])
    (copied.parent / "mine.jpg").write_bytes(content)
    copied.write_text(copied.read_text().replace(PICTURE, "mine.jpg"))
    assert load_sensor(copied) == load_sensor(NAME)


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("gone.uri", None, "housing.background.light: the picture .*gone.uri is missing; copy it together with the specification"),
        ("mine.bmp", b"BM", r"must be the name of a \.uri, \.png, \.jpg, \.jpeg or \.webp file in the folder"),
        ("../mine.png", None, "must be the name of .* without a folder"),
        ("mine.uri", b"a text", r"housing.background.light: expected a picture: \{ picture = 'file name' \}"),
    ],
)
def test_a_file_that_is_no_picture_is_refused_with_its_remedy(copied, file, content, message):
    if content is not None:
        (copied.parent / file).write_bytes(content)
    copied.write_text(copied.read_text().replace(PICTURE, file))
    with pytest.raises(SpecError, match=message):
        load_sensor(copied)
