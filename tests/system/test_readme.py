"""The Python examples of the README run as they stand and print what the README says."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"


@pytest.mark.slow
def test_the_first_examples_run_and_print_what_is_stated(capsys):
    text = README.read_text()
    first, second = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "SafeArm" not in block)
    names: dict[str, object] = {}
    exec(first, names)
    printed = capsys.readouterr().out.splitlines()
    stated = re.search(r"It prints `(.*?)` and `(.*?) px from the truth`", text)
    assert stated is not None and printed[0] == stated[1]
    assert f"{float(printed[1].split()[0]):.2f}" == stated[2]
    exec(second, names)
    assert capsys.readouterr().out.count("places slip") > 5
