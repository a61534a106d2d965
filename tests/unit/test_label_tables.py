"""Tables of labels in any form in which people and programs write them: each label is read right, or what is wrong with it is told."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scenes import list_specifications, load_experiment
from twin.frames.tables import numbers, order_by_table, unlikely_units

MANY = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
FRAMES = [f"f_{k}.png" for k in range(6)]
LABELS = ("pose_2", "pose_6")
CODES = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be")
LINE_ENDS = ("\n", "\r\n", "\r")
NAMES = ("{}", "frames_bw/{}", "./{}", "C:\\data\\{}", '"{}"', " {} ")
DECIMAL_COMMA = [(";", ","), ("\t", ",")]
FORMS = [(",", "."), (";", "."), ("\t", "."), *DECIMAL_COMMA]  # separator, decimal mark
NO_NUMBERS = ("", "nan", "n/a", "inf", "1e999", "1.0 mm", "True", "1_5", "--", "1.2.3", "0x10", "#REF!")


@dataclass
class Written:
    """Rows of a table as they are meant: name and values by column; and how they are written."""

    rows: list[tuple[str, tuple[str, ...]]]
    columns: tuple[str, ...]
    form: tuple[str, str] = (",", ".")
    code: str = "utf-8"
    line_end: str = "\n"
    name: str = "{}"
    blank_lines: bool = False

    def write(self, path: Path) -> None:
        """Write it as it is said to be written."""
        separator, mark = self.form
        lines = [separator.join(["image_name", *self.columns])]
        lines += [separator.join([self.name.format(name), *(value.replace(".", mark) for value in values)]) for name, values in self.rows]
        path.write_bytes(((self.line_end * (1 + self.blank_lines)).join(lines) + self.line_end).encode(self.code))


@st.composite
def written(draw: st.DrawFn) -> tuple[Written, dict[str, dict[str, float]]]:
    """A sound table in some form, and the labels by frame."""
    value = st.floats(-1e3, 1e3).map(lambda v: f"{v:.4f}") | st.integers(-99, 99).map(str) | st.sampled_from(["1.5e0", "+2", "-2e-3"])
    columns = tuple(draw(st.permutations([*LABELS, "obj_id"])))
    rows = [(name, tuple(draw(value) for _ in columns)) for name in draw(st.permutations(FRAMES))]
    table = Written(rows, columns, *(draw(st.sampled_from(each)) for each in (FORMS, CODES, LINE_ENDS, NAMES)), draw(st.booleans()))
    truth = {name: {c: float(v) for c, v in zip(columns, values, strict=True)} for name, values in rows}
    return table, truth


def read(folder: Path, table: Written | None = None) -> tuple[dict[str, dict[str, float]], list[str]]:
    """The labels by frame, as commands take them, and what was told."""
    path, problems = folder / "targets.csv", list[str]()
    if table is not None:
        table.write(path)
    files, labels = order_by_table([path], [folder / name for name in FRAMES], problems)
    assert sorted(file.name for file in files) == FRAMES, "each frame once"
    values = {c: numbers(labels[c]) if c in labels else np.full(len(files), np.nan) for c in LABELS}
    return {file.name: {c: float(values[c][k]) for c in LABELS} for k, file in enumerate(files)}, problems


def right(found: dict[str, dict[str, float]], truth: dict[str, dict[str, float]], name: str) -> bool:
    return all(found[name][c] == truth[name][c] for c in LABELS)


@MANY
@given(made=written())
def test_a_sound_table_in_any_form_gives_its_labels_and_nothing_is_told(tmp_path, made):
    table, truth = made
    found, problems = read(tmp_path, table)
    assert all(right(found, truth, name) for name in FRAMES) and not problems


@MANY
@given(made=written(), data=st.data())
def test_of_spoilt_rows_each_label_is_right_or_told(tmp_path, made, data):
    """Rows left out, twice, contradicting, too long, too short, or with a cell that is no number."""
    table, truth = made
    kinds = st.sampled_from(["as it is", "left out", "twice", "contradicted", "too long", "too short", "no number", "of no picture"])
    rows, spoilt = [], {}
    for name, values in table.rows:
        kind = data.draw(kinds)
        spoilt[name] = kind
        if kind == "left out":
            continue
        if kind == "no number":
            values = (data.draw(st.sampled_from(NO_NUMBERS)), *values[1:])
        if kind in ("too long", "too short"):
            values = (*values, "1") if kind == "too long" else values[:-1]
        rows.append(("g" + name if kind == "of no picture" else name, values))
        if kind in ("twice", "contradicted"):
            rows.append((name, values if kind == "twice" else tuple("77" for _ in values)))
    table.rows = rows
    found, problems = read(tmp_path, table)
    told = "\n".join(problems)
    for name, kind in spoilt.items():
        unknown = all(np.isnan(found[name][c]) for c in LABELS)
        if kind == "no number":
            first = table.columns[0]
            assert first not in LABELS or np.isnan(found[name][first]), "what is no number is none"
            assert all(found[name][c] == truth[name][c] or unknown for c in LABELS if c != first)
        else:
            assert right(found, truth, name) or unknown, (kind, found[name], truth[name])
        assert kind in ("as it is", "no number") or "targets.csv" in told, f"a row {kind} is told"
        assert not unknown or told or kind == "no number"


@MANY
@given(made=written(), share=st.floats(0, 1))
def test_of_a_cut_table_each_label_is_right_or_unknown_but_the_last_number(tmp_path, made, share):
    """The last number of a cut table may have lost digits, which no reader can know; nothing else may be wrong."""
    table, truth = made
    table.write(tmp_path / "targets.csv")
    data = (tmp_path / "targets.csv").read_bytes()
    (tmp_path / "targets.csv").write_bytes(data[: int(share * len(data))])
    found, problems = read(tmp_path)
    wrong = [name for name in FRAMES if not right(found, truth, name) and not all(np.isnan(v) for v in found[name].values())]
    assert len(wrong) <= 1
    lost = [name for name in FRAMES if np.isnan(found[name]["pose_2"])]
    assert not lost or problems, "what was lost is told"


@pytest.mark.parametrize("last", ["", "-", "+", "\x00"])
def test_a_table_cut_before_its_last_number_is_told(tmp_path, last):
    (tmp_path / "targets.csv").write_text(f"image_name,pose_6,pose_2\nf_0.png,1,2\nf_1.png,1,{last}")
    found, problems = read(tmp_path)
    assert np.isnan(found["f_1.png"]["pose_2"]) and any("ends within its last row" in each for each in problems)


@pytest.mark.parametrize("form", DECIMAL_COMMA)
def test_a_decimal_comma_is_read_only_where_commas_separate_nothing(tmp_path, form):
    table = Written([(name, (f"{k}.25", "-0.5")) for k, name in enumerate(FRAMES)], LABELS, form)
    found, problems = read(tmp_path, table)
    assert [found[name]["pose_2"] for name in FRAMES] == [k + 0.25 for k in range(6)] and not problems


def test_a_number_with_an_underscore_is_a_slip_of_the_hand_and_no_number(tmp_path):
    """Python itself reads 1_5 as 15."""
    found, _ = read(tmp_path, Written([(name, ("1_5", "2.5")) for name in FRAMES], LABELS))
    assert np.isnan(found["f_0.png"]["pose_2"]) and found["f_0.png"]["pose_6"] == 2.5


EXPERIMENTS = [load_experiment(name) for name in list_specifications("experiments")]


def in_units(length, angle, ranges):
    """Labels of 200 contacts sampled from ranges in mm and deg, as they are in other units."""
    rng = np.random.default_rng(0)
    scale = {name: length if name[-1] in "123" else angle for name in ranges}
    return {name: scale[name] * rng.uniform(*ends, 200) for name, ends in ranges.items() if name.startswith(("pose_", "move_"))}


@pytest.mark.parametrize("experiment", EXPERIMENTS, ids=lambda experiment: experiment.name)
def test_lengths_in_metres_are_named_and_the_right_units_are_not(experiment):
    ranges = experiment.ranges()
    assert unlikely_units(in_units(1.0, 1.0, ranges)) == []
    (said,) = unlikely_units(in_units(1e-3, 1.0, ranges))
    assert "in mm" in said and "in m," in said
    (said,) = unlikely_units(in_units(1e3, 1.0, ranges))
    assert "in um," in said


@pytest.mark.parametrize("widest_deg", [10.0, 40.0, 60.0, 360.0])
def test_angles_in_radians_are_named(widest_deg):
    ranges = {"pose_3": (2.0, 5.0), "pose_6": (-widest_deg / 2, widest_deg / 2), "move_6": (-5.0, 5.0)}
    assert unlikely_units(in_units(1.0, 1.0, ranges)) == []
    (said,) = unlikely_units(in_units(1.0, np.radians(1.0), ranges))
    assert "in deg, pose_6" in said and "in rad," in said


def test_constant_missing_and_foreign_columns_tell_no_unit():
    labels = {"pose_1": np.full(5, 0.35), "pose_2": np.full(5, np.nan), "move_6": np.array(["-"] * 5), "Fx": np.linspace(0, 1e-3, 5)}
    assert unlikely_units(labels) == [] == unlikely_units({})
