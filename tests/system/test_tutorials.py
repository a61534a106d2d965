"""Tutorials and pages on how to add things run as they stand and print what they say: Python in one namespace, commands by the program."""

import ast
import re
import shlex
from pathlib import Path

import pytest
from command import run_twin
from generators.notebooks import DOCS, Block, blocks, cells, require_commands_done, run_pages, tutorials

from training.models import MODELS

TUTORIALS = DOCS / "tutorials"
QUICK = {"first-contact", "five-scripts", "arm", "camera", "object", "sensor", "degradation", "material-law"}
"""Pages that take a few seconds at most."""


def run_block(block: Block, names: dict[str, object], capsys: pytest.CaptureFixture[str]) -> str:
    """What a block prints."""
    capsys.readouterr()
    if block.language == "python":
        exec(compile(block.code, f"line {block.line}", "exec"), names)
        return capsys.readouterr().out
    said = ""
    for line in re.sub(r"\\\n\s*", "", block.code).strip().splitlines():
        done = run_twin(*shlex.split(line)[1:])
        assert line.startswith("twin ") and done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        said += done.stdout
    return said


def agrees(stated: str, printed: str) -> bool:
    """Whether a text has been printed; ``...`` stands for anything, runs of blanks for one."""
    parts = [re.escape(" ".join(part.split())) for part in stated.split("...")]
    return re.fullmatch(r"\s*" + ".*?".join(parts) + r"\s*", " ".join(printed.split()), re.DOTALL) is not None


@pytest.mark.parametrize(
    "page", [pytest.param(path, id=path.stem, marks=() if path.stem in QUICK else pytest.mark.slow) for path in run_pages()]
)
def test_a_page_runs_as_it_stands(page: Path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("training.models.MODELS", MODELS.copy())
    names: dict[str, object] = {"__name__": "__main__"}
    printed = ""
    for block in blocks(page.read_text(encoding="utf-8")):
        if block.language in ("python", "bash"):
            printed = run_block(block, names, capsys)
        elif block.language == "toml" and (named := re.match(r"# (\S+\.toml)\n", block.code)):
            Path(named[1]).write_text(block.code, encoding="utf-8")
        elif block.language == "text":
            assert agrees(block.code, printed), f"{page.name}, line {block.line}: it printed\n{printed}"


def test_every_tutorial_has_code_that_runs():
    assert {path.stem for path in run_pages()} >= QUICK
    for path in tutorials():
        languages = [block.language for block in blocks(path.read_text(encoding="utf-8"))]
        assert "python" in languages, path.name


def test_a_notebook_holds_the_pages_code_as_one_kernel_runs_it():
    pytest.importorskip("nbformat")
    for path in tutorials():
        text = path.read_text(encoding="utf-8")
        found = [cell["source"] for cell in cells(text) if cell["cell_type"] == "code"]
        assert len(found) == sum(block.language in ("python", "bash") for block in blocks(text))
        for code in found:
            assert code.startswith("!twin ") or ast.parse(code), path.name
            assert "%%" not in code and all(line.startswith("!twin ") for line in code.splitlines() if code.startswith("!"))
    page = "# T\n\nWrite:\n\n```toml\n# a.toml\nx = 1\n```\n\n```bash\ntwin new a \\\n    --out b\n```\n"
    assert [cell["source"] for cell in cells(page)] == ["# T\n\nWrite:", "%%writefile a.toml\n# a.toml\nx = 1", "!twin new a --out b"]
    require_commands_done("T", {"source": "", "outputs": [{"text": "wrote a"}, {"data": {}}]})
    with pytest.raises(RuntimeError, match="T: !twin x"):
        require_commands_done("T", {"source": "!twin x", "outputs": [{"text": "twin: error: no such command"}]})


def test_every_picture_of_the_gallery_has_its_ten_lines():
    text = (DOCS / "gallery.md").read_text(encoding="utf-8")
    shown, made = re.findall(r"\(pictures/gallery/(\w+)\.jpg\)", text), re.findall(r'savefig\("(\w+)\.png"\)', text)
    assert shown == made and len(made) == 12 == len(set(made)) == len(blocks(text))
    assert {path.stem for path in (DOCS / "pictures" / "gallery").glob("*.jpg")} == set(made)
    for block in blocks(text):
        assert len([line for line in block.code.splitlines() if line and not line.startswith("import")]) <= 10


def test_the_five_scripts_are_short_and_need_one_import():
    """The last block of Python of each section is the script; what stands before it makes its files."""
    sections = (TUTORIALS / "five-scripts.md").read_text(encoding="utf-8").split("\n## ")[1:]
    scripts = [[block.code for block in blocks(section) if block.language == "python"][-1] for section in sections]
    for code, most in zip(scripts, (8, 6, 6, 5, 6), strict=True):
        statements = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.stmt)]
        imported = {alias.name for node in statements if isinstance(node, ast.Import) for alias in node.names}
        assert len(statements) <= most and imported <= {"twin", "numpy", "cv2", "trimesh", "gymnasium"}
        assert not any(isinstance(node, ast.ImportFrom) for node in statements)


@pytest.mark.parametrize(
    ("stated", "printed", "same"),
    [
        ("a ... c\n", "a b c\n", True),
        ("a ... c", "a b d", False),
        ("[1.0 ... 2]", "[ 1.0  0 2]", False),
        ("x", "x y", False),
        ("...", "", True),
    ],
)
def test_what_is_stated_is_compared(stated, printed, same):
    assert agrees(stated, printed) is same
