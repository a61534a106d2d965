"""A written specification reads back as it was."""

import pytest

from scenes import load_sensor
from scenes.sensor import SensorSpec
from twin.calibration.sensor_file import write_sensor


def rounded(value):
    if isinstance(value, dict):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(part) for part in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def test_a_sensor_round_trips(sensor, tmp_path):
    path = tmp_path / f"{sensor.name}.toml"
    write_sensor(path, sensor, "first line\nsecond line")
    assert path.read_text().startswith("# first line\n# second line\n")
    assert rounded(load_sensor(path).model_dump()) == rounded(sensor.model_dump())
    assert all(file.name.startswith(f"{sensor.name}.") and file.suffix in (".toml", ".csv", ".uri") for file in tmp_path.iterdir())


def test_what_was_measured_of_each_cap_round_trips(tmp_path):
    sensor = load_sensor("mg400-127")
    look = sensor.appearance.model_dump() | {
        "cap_levels": tuple(1 + 0.001 * k for k in range(127)),
        "cap_shapes": tuple((0.01, 0.001 * k, -0.002) for k in range(127)),
        "specks": ({"x_mm": 1.0, "y_mm": -2.0, "radius_mm": 0.2, "opacity": 0.5, "light": 0.1},),
    }
    printed = SensorSpec.model_validate(sensor.model_dump() | {"appearance": look})
    write_sensor(tmp_path / "mg400-127.toml", printed)
    assert rounded(load_sensor(tmp_path / "mg400-127.toml").model_dump()) == rounded(printed.model_dump())
    longest = max(len(line) for line in (tmp_path / "mg400-127.toml").read_text().splitlines())
    assert longest < 200


@pytest.mark.parametrize("levels", [(1.0,), (1.0,) * 126])
def test_levels_for_other_pins_are_refused(levels):
    sensor = load_sensor("mg400-127")
    with pytest.raises(ValueError, match="127"):
        SensorSpec.model_validate(sensor.model_dump() | {"appearance": sensor.appearance.model_dump() | {"cap_levels": levels}})
