"""The Python examples of the README and of the page about mechanics run as they stand and print what is said."""

import re
from pathlib import Path

import pytest
from generators.notebooks import blocks

ROOT = Path(__file__).parents[2]
MECHANICS = ROOT / "docs" / "explanations" / "mechanics.md"


def example_of(document: Path) -> str:
    """The one Python example of a document."""
    (example,) = [block.code for block in blocks(document.read_text(encoding="utf-8")) if block.language == "python"]
    return example


@pytest.mark.slow
def test_the_example_runs_and_prints_what_is_stated(capsys):
    exec(example_of(ROOT / "README.md"), {})
    printed = capsys.readouterr().out.splitlines()
    stated = re.search(r"It prints `(.*?)` and `(.*?) px from the truth`", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert stated is not None and printed[0] == stated[1]
    assert f"{float(printed[1].split()[0]):.1f}" == stated[2]


@pytest.mark.slow
def test_the_example_of_a_path_prints_every_state(capsys):
    exec(example_of(MECHANICS), {})
    assert capsys.readouterr().out.count("places slip") > 5
