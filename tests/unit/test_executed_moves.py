"""The file that says which moves were executed: read like the table, every row and every frame accounted for."""

import pytest

from twin.rig.labels import read_executed

NAMES = ["frame_1_0.png", "frame_2_0.png", "frame_3_0.png"]
PLAIN = "image_name,executed\nframe_1_0.png,1\nframe_2_0.png,0\nframe_3_0.png,0.25\n"
WANTED = {"frame_1_0.png": 1.0, "frame_2_0.png": 0.0, "frame_3_0.png": 0.25}


def read(folder, content: str | bytes):
    path, problems = folder / "move_executed.csv", []
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_executed(folder, NAMES, problems), problems


@pytest.mark.parametrize(
    "content",
    [
        PLAIN,
        PLAIN.encode("utf-8-sig"),
        PLAIN.encode("utf-16"),
        PLAIN.replace(",", ";").replace("0.25", "0,25"),
        PLAIN.replace(",", "\t"),
        PLAIN.replace("frame_", "C:\\data\\frames_bw\\frame_"),
        PLAIN.replace("image_name,executed", "Image_Name,Executed"),
        PLAIN.replace(",1\n", ",True\n").replace(",0\n", ",no\n"),
        PLAIN + "frame_2_0.png,0\n",
    ],
)
def test_forms_that_tables_have_mean_the_same(tmp_path, content):
    found, problems = read(tmp_path, content)
    assert found == WANTED
    assert not [problem for problem in problems if "not used" in problem or "count as executed" in problem]


@pytest.mark.parametrize(
    ("content", "said", "known"),
    [
        (PLAIN.replace(",0\n", ",maybe\n"), "1 row without a number from 0 to 1", 2),
        (PLAIN.replace(",0\n", ",2\n"), "1 row without a number from 0 to 1", 2),
        (PLAIN + "frame_2_0.png,1\n", "1 row against an earlier row", 2),
        (PLAIN + "frame_9_0.png,1\n", "1 row for no frame here (frame_9_0.png)", 3),
        (PLAIN[: PLAIN.index("frame_3")], "1 frame without a usable row, counted as executed (frame_3_0.png)", 2),
        ("image_name,done\nframe_1_0.png,1\n", "no column executed", 0),
        ("name,executed\nframe_1_0.png,1\n", "it is not used, and every move counts as executed", 0),
    ],
)
def test_what_is_not_used_is_said(tmp_path, content, said, known):
    found, problems = read(tmp_path, content)
    assert len(found) == known and all(WANTED[name] == share for name, share in found.items())
    assert any(said in problem for problem in problems), problems


def test_what_is_no_file_is_said(tmp_path):
    (tmp_path / "move_executed.csv").mkdir()
    problems: list[str] = []
    assert read_executed(tmp_path, NAMES, problems) == {}
    assert problems == ["move_executed.csv: not a regular file; it is not used, and every move counts as executed"]
