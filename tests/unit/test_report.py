"""Pages are sound HTML that needs nothing but itself, read well in both themes, and write numbers as people do."""

import csv
import itertools
import math
import re
from dataclasses import fields
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_up_pages import HOSTILE, PAGES
from sound_page import PageReader, read_sound_page

from twin.frames.images import write_image
from twin.report.charts import muted_colour, new_figure, save_figure, write_chart
from twin.report.page import (
    DARK,
    GROUP,
    LIGHT,
    LONGEST,
    MINUS,
    NOTHING,
    SERIES,
    Cell,
    Column,
    Page,
    PagePicture,
    Theme,
    bad,
    code,
    column,
    dark_of,
    force_interval,
    good,
    link_to,
    make_table,
    number,
    sentence,
    strong,
    stylesheet,
    write_rows,
    write_table,
)

TEXT_CONTRAST = 4.5  # WCAG 2.1, 1.4.3, level AA
LINE_CONTRAST = 3.0  # WCAG 2.1, 1.4.11
APART = 20.0  # CIELAB distance of two series, several times what is just seen side by side (about 2)
# What protanopes and deuteranopes see of linear RGB (Machado, Oliveira and Fernandes 2009, severity 1), and everybody else
SIGHTS = {
    "usual": np.eye(3),
    "protanope": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]),
    "deuteranope": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]),
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])  # of linear sRGB
WHITE = np.array([0.9505, 1.0, 1.089])  # D65


@pytest.fixture(scope="module", params=PAGES)
def made(request, tmp_path_factory):
    """A page whose charts are drawn in the light theme, and made in both."""

    def save_light(path, figure, **options):
        return write_image(path, np.zeros((8, 8), np.uint8)) if path.stem.endswith("-dark") else save_figure(path, figure, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.report.charts.save_figure", save_light)
        return PAGES[request.param](tmp_path_factory.mktemp(request.param))


# Pages


def test_every_page_is_sound(made):
    page = read_sound_page(made.read_text(encoding="utf-8"), made.parent)
    assert "h1" in page.tags and "prefers-color-scheme: dark" in made.read_text(encoding="utf-8")
    assert re.search(r"Made by twin [a-z -]+, tactip-twin ", page.text)


def test_hostile_names_stay_text(tmp_path):
    page = Page(HOSTILE, HOSTILE, topic=HOSTILE, lead=HOSTILE)
    page.section(HOSTILE, HOSTILE, sentence(HOSTILE, strong(HOSTILE), code(HOSTILE), good(HOSTILE), bad(HOSTILE)))
    page.heading(HOSTILE, anchor=HOSTILE)
    page.items([HOSTILE])
    page.notice(HOSTILE, [HOSTILE, HOSTILE])
    page.table([{"a": HOSTILE, "b": Cell(1.5, note=HOSTILE, href=link_to(HOSTILE))}], [Column("a", HOSTILE, HOSTILE), "b"], caption=HOSTILE)
    page.figures(PagePicture(tmp_path / f"{HOSTILE}.png", HOSTILE, HOSTILE), PagePicture(Path("javascript:x"), "x", kind="photo"))
    page.download(tmp_path / f"{HOSTILE}.csv", HOSTILE)
    read = read_sound_page(page.html(tmp_path))
    assert read.text.count(HOSTILE) == 25, "each of the texts above, the title twice"
    assert read.alts[0] == HOSTILE
    assert not {"script", "b"} & set(read.tags)
    addresses = [unquote(address) for address in read.addresses]
    assert {f"{HOSTILE}.png", f"{HOSTILE}-dark.png", f"{HOSTILE}.csv", f"#{HOSTILE}"} <= set(addresses)


def test_words_in_backquotes_are_names(tmp_path):
    page = Page("Title", "twin new")
    page.items(["give its radius (`radius_mm`), not `<b>`"])
    assert "(<code>radius_mm</code>), not <code>&lt;b&gt;</code>" in page.html(tmp_path)


def test_an_unsound_page_is_refused():
    for html, word in (
        ("<p>", "never closed"),
        ("<p><b></p></b>", "ends <b>"),
        ('<a href="https://example.org">x</a>', "leads out"),
        ('<img src="//example.org/x.png" alt="x">', "leads out"),
        ('<img src="x.png">', "without a text"),
        ('<p onclick="x()"></p>', "holds a script"),
    ):
        with pytest.raises(AssertionError, match=word):
            read_sound_page(html)


@pytest.mark.parametrize("alt", ["", "  "])
def test_a_picture_without_a_text_is_refused(alt):
    with pytest.raises(ValueError, match="says what it shows"):
        PagePicture(Path("a.png"), alt)


def test_an_embedded_page_needs_no_other_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    chart = write_chart(Path("out/chart.png"), lambda: new_figure(1, panel_inch=1.0)[0])
    page = Page("A", "twin a")
    page.figures(PagePicture(chart, "a chart"))
    embedded = PageReader(page.write(Path("out/index.html"), embed=True).read_text(encoding="utf-8"))
    assert len(embedded.addresses) == 2 and all(address.startswith("data:image/png;base64,") for address in embedded.addresses)
    beside = PageReader(page.html(Path("out")))
    assert beside.addresses == ["chart-dark.png", "chart.png"]


def test_contents_are_listed_where_there_are_many_sections(tmp_path):
    page = Page("A", "twin a")
    for k in range(3):
        page.section(f"Part {k}")
    assert "nav" not in PageReader(page.html(tmp_path)).tags
    page.section("Part & more")
    assert PageReader(page.html(tmp_path)).addresses == ["#part-0", "#part-1", "#part-2", "#part-more"]


@pytest.mark.usefixtures("undrawn_charts")
def test_the_sim_to_real_page_writes_whole_numbers_whole(tmp_path):
    page = read_sound_page(PAGES["sim-to-real"](tmp_path).read_text(encoding="utf-8"))
    assert "3010" in page.text and f"25{GROUP}344 states" in page.text and not re.search(r"\de[+-]?\d", page.text)
    assert (tmp_path / "errors.png").is_file() and (tmp_path / "ingredients.png").is_file()


# Themes


def shades(css: str) -> dict[str, dict[str, str]]:
    """The stylesheet's colour variables by theme, as a browser takes them: the dark ones stand in the media rule."""
    light, _, rest = css.partition("@media (prefers-color-scheme: dark)")
    dark = rest[: rest.index("}")]
    return {name: dict(re.findall(r"--(\w+): (#[0-9a-f]{6});", part)) for name, part in (("light", light), ("dark", dark))}


def linear(color: str) -> np.ndarray:
    """Linear RGB of ``#rrggbb`` (IEC 61966-2-1)."""
    level = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)


def contrast(one: str, other: str) -> float:
    """WCAG 2.1's contrast ratio."""
    low, high = sorted(float(linear(color) @ XYZ[1]) for color in (one, other))
    return (high + 0.05) / (low + 0.05)


def lab(light: np.ndarray) -> np.ndarray:
    """CIELAB of linear RGB."""
    part = XYZ @ np.clip(light, 0, 1) / WHITE
    f = np.where(part > 0.008856, np.cbrt(part), 7.787 * part + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_contrast_is_what_the_standard_says():
    assert contrast("#ffffff", "#000000") == pytest.approx(21) and contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_is_read_on_every_background(theme):
    colors = shades(stylesheet())[theme]
    assert set(colors) == {field.name for field in fields(Theme)}
    for text, ground in itertools.product(("ink", "muted", "accent", "good", "bad"), ("page", "surface", "tint")):
        assert contrast(colors[text], colors[ground]) >= TEXT_CONTRAST, f"{theme}: {text} on {ground}"


def test_the_stylesheet_takes_its_colours_from_the_themes():
    rules = stylesheet().partition("* { box-sizing")[2]
    assert set(re.findall(r"#[0-9a-fA-F]{3,8}\b", rules)) <= {"#000", "#fff"}, "behind a frame, and on paper"
    assert set(re.findall(r"var\(--(\w+)\)", rules)) <= {field.name for field in fields(Theme)}


def test_series_differ_for_every_kind_of_colour_vision():
    for color, theme in itertools.product(SERIES, (LIGHT, DARK)):
        assert contrast(color, theme.surface) >= LINE_CONTRAST, f"{color} on {theme.surface}"
    for (sight, matrix), (one, other) in itertools.product(SIGHTS.items(), itertools.combinations(SERIES, 2)):
        assert np.linalg.norm(lab(matrix @ linear(one)) - lab(matrix @ linear(other))) >= APART, f"{sight}: {one} and {other}"


def test_a_chart_is_drawn_for_each_theme(tmp_path):
    grounds = []

    def draw():
        figure, (ax,) = new_figure(1, panel_inch=1.0)
        ax.axhline(0.5, color=muted_colour())
        grounds.append(muted_colour())
        return figure

    path = write_chart(tmp_path / "a.b.png", draw)
    assert path == tmp_path / "a.b.png" and dark_of(path) == tmp_path / "a.b-dark.png" and grounds == [LIGHT.muted, DARK.muted]
    for written, theme in ((path, LIGHT), (dark_of(path), DARK)):
        corner = cv2.imread(str(written))[0, 0, ::-1]
        assert "#" + "".join(f"{part:02x}" for part in corner) == theme.surface
    assert new_figure(1)[0].get_facecolor() == pytest.approx((1, 1, 1, 1)), "the theme ends with the chart"


# Numbers


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (3010, "3010"),
        (3010.0, "3010"),
        (np.int64(12), "12"),
        (25344, f"25{GROUP}344"),
        (1234567.8, f"1{GROUP}234{GROUP}568"),
        (0.0531, "0.0531"),
        (np.float32(0.5), "0.500"),
        (9.996, "10.0"),
        (-1.25, f"{MINUS}1.25"),
        (0, "0"),
        (0.0, "0"),
        (3e-7, "3.00×10⁻⁷"),
        (True, "yes"),
        (np.bool_(False), "no"),
        (None, NOTHING),
        (math.nan, NOTHING),
        (math.inf, "∞"),
        ("finished", "finished"),
    ],
)
def test_one_number(value, text):
    assert number(value) == text


def test_signs_and_decimals_are_as_asked():
    assert number(1.5, signed=True) == "+1.50" and number(0.001, decimals=1, signed=True) == "0.0" and number(-0.001, decimals=1) == "0.0"
    assert number(2, decimals=2) == "2.00" and number(4.5678, 2) == "4.6"


def back(text: str) -> float:
    return float(text.replace(GROUP, "").replace(MINUS, "-"))


@given(st.integers(-(10**12), 10**12))
def test_a_whole_number_is_never_rounded(value):
    assert back(number(value)) == value


@given(st.floats(min_value=1e-4, max_value=1e8), st.integers(2, 5))
def test_a_fraction_keeps_its_significant_digits(value, digits):
    assert back(number(value, digits)) == pytest.approx(value, rel=0.5 * 10.0 ** (1 - digits) * (1 + 1e-9))


@given(st.lists(st.floats(min_value=1e-3, max_value=1e4), min_size=1, max_size=20))
def test_a_column_has_one_number_of_decimals_and_hides_no_value(values):
    texts = column(values)
    decimals = {len(text.partition(".")[2]) for text in texts}
    assert len(decimals) == 1 or max(len(text.replace(".", "").replace(GROUP, "")) for text in texts) <= LONGEST
    for value, text in zip(values, texts, strict=True):
        assert back(text) == pytest.approx(value, rel=0.05), "the smallest has two digits"


def test_columns_of_every_kind():
    assert column([3762, 40, None]) == ["3762", "40", NOTHING]
    assert column([40.0, 500.0, 3010.0]) == ["40", "500", "3010"]
    assert column([0.048, 1.09, 0.67]) == ["0.048", "1.090", "0.670"]
    assert column([4700.0, 0.048]) == ["4700", "0.0480"], "too far apart for one number of decimals"
    assert column([0.5, 0.25], decimals=1, signed=True) == ["+0.5", "+0.2"]


# Tables


def test_a_table_marks_the_best_and_names_its_units():
    rows = [{"model": "a", "error_mm": 0.2, "share": 0.5}, {"model": "b", "error_mm": 0.1, "share": 0.25}]
    rows.append({"model": "c", "error_mm": None})
    table = make_table(rows, ["model", Column.of("error_mm", best="least"), Column("share", "share", "%", decimals=0, scale=100)])
    assert [tuple(head.values()) for head in table["heads"]] == [("model", "", False), ("error", "mm", True), ("share", "%", True)]
    texts = [[cell["text"] for cell in row] for row in table["body"]]
    assert texts == [["a", "0.200", "50"], ["b", "0.100", "25"], ["c", NOTHING, NOTHING]]
    assert ["best" in row[1]["style"] for row in table["body"]] == [False, True, False]


def test_a_single_value_is_not_the_best():
    table = make_table([{"a": 1.0}, {"a": None}], [Column("a", "a", best="most")])
    assert "best" not in table["body"][0][0]["style"]


def test_rows_are_written_for_machines(tmp_path):
    path = write_rows(tmp_path / "rows.csv", [{"a": 1 / 3, "b": 'x,"y"'}])
    assert list(csv.DictReader(path.open(newline=""))) == [{"a": repr(1 / 3), "b": 'x,"y"'}]
    path = write_table(tmp_path / "table.csv", [{"a": 1 / 3}, {"a": None, "b": 3010}])
    assert path.read_bytes() == b"a,b\r\n0.333333,\r\n,3010\r\n"


def test_the_interval_of_a_simulated_force_has_its_size_in_the_middle_of_both_factors():
    force_n, factor = (1.0, -2.0, 2.0), 1.6
    low, high = force_interval(force_n, factor)
    assert low * high == pytest.approx(3.0**2) and high / low == pytest.approx(factor**2)
    assert force_interval(force_n, 1.0) == (3.0, 3.0)
