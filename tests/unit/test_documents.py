"""Laws of the documents: links lead somewhere, code is code, figures are measured, nothing needs the changelog to be understood."""

import ast
import re
import shlex
import tomllib
from functools import cache
from pathlib import Path

import pytest
from figures import tables
from generators import api, commands
from generators.notebooks import blocks

import twin
import twin.extend
from twin.demo.make_demo import NEXT

ROOT = Path(__file__).parents[2]
DOCUMENTS = [path for path in tables.documents() if "generated" not in path.parts]
RESULTS = [path for path in DOCUMENTS if path.name == "README.md" or path.parent.name == "results"]
MOST_WORDS = 900
LARGEST_PICTURE = 200_000
COMMANDS = {command.name: command for group in commands.groups() for command in group.commands}
# Words by which a sentence speaks of an earlier version of the program.
HISTORY = (
    r"\bnow\b|\bno longer\b|\bnew in\b|\b(?:as|than) before\b|\bearlier versions?\b|\bsince version\b"
    r"|\bformerly\b|\bpreviously\b|\bnot yet\b|\bused to be\b"
)
# A number that looks measured, and what looks like one: versions, and the level of the intervals.
MEASURED = r"\d+\.\d+|\d+ ?%|\b\d+ times\b"
GIVEN = r"Python 3\.\d+(?: to 3\.\d+)?|Apache-2\.0|\b90 %|\b\d+\.\d+\.\d+\b"


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def prose(text: str) -> str:
    """A document without its code."""
    text = re.sub(r"^( *)```.*?^\1```$", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`|^    \S.*$", "", text, flags=re.MULTILINE)


@cache
def anchors(path: Path) -> set[str]:
    """The places of a page that a link can name."""
    titles = re.findall(
        r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


def dead_links(path: Path, text: str) -> list[str]:
    """Links of a document that lead nowhere, or from the built documentation to what is not built."""
    found, built = [], ROOT / "docs"
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(text)):
        place, _, anchor = target.partition("#")
        if "://" in target or target.startswith("mailto:"):
            continue
        file = (path.parent / place).resolve() if place else path
        outside = path.is_relative_to(built) and not file.is_relative_to(built)
        if outside or not file.exists() or (anchor and anchor not in anchors(file)):
            found.append(target)
    return found


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_links_lead_somewhere(path):
    assert not dead_links(path, path.read_text(encoding="utf-8"))


def test_a_dead_link_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# One place\n")
    text = "[a](page.md#one-place) [b](page.md#other) [c](none.md) [d](https://example.org) `[e](code.md)`"
    assert dead_links(page, text) == ["page.md#other", "none.md"]


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_nothing_is_told_of_earlier_versions(path):
    assert not re.findall(HISTORY, prose(path.read_text(encoding="utf-8")), re.IGNORECASE)


@pytest.mark.parametrize("name", COMMANDS)
def test_no_help_tells_of_earlier_versions(name):
    assert not re.findall(HISTORY, COMMANDS[name].help, re.IGNORECASE)


def unmeasured(text: str) -> list[str]:
    """Numbers in prose and tables that look measured and do not come from ``figures.json``."""
    text = re.sub(r"<!-- figures: .*?<!-- /figures -->|<!-- figure: .*?<!-- /figure -->", "", text, flags=re.DOTALL)
    text = re.sub(r"\]\([^)]*\)", "]", prose(text))
    return re.findall(MEASURED, re.sub(GIVEN, "", text))


@pytest.mark.parametrize("path", RESULTS, ids=name_of)
def test_every_figure_comes_from_a_measurement(path):
    assert not unmeasured(path.read_text(encoding="utf-8")), "mark it '<!-- figure: NAME FORMAT --><!-- /figure -->' and run 'make tables'"


@pytest.mark.parametrize("path", RESULTS, ids=name_of)
def test_no_line_begins_with_the_mark_of_a_figure(path):
    """Markdown would end the paragraph before it."""
    assert not re.findall(r"^<!-- figure: ", path.read_text(encoding="utf-8"), re.MULTILINE)


def test_a_figure_from_nowhere_is_found():
    marked = "<!-- figure: a.b .2f -->0.12<!-- /figure --> px with a 90 % interval, Python 3.11, `0.5`"
    assert unmeasured(marked) == [] and unmeasured(f"{marked}, 0.3 px, 7 %, 4 times") == ["0.3", "7 %", "4 times"]


def command_lines(text: str) -> list[str]:
    """Commands of the program in code blocks, indented lines and inline code."""
    code = [
        line
        for block in blocks(text)
        if block.language in ("bash", "console", "")
        for line in re.sub(r"\\\n\s*", "", block.code).splitlines()
    ]
    outside = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    code += [line.strip() for line in re.findall(r"^    (twin .*)$", outside, re.MULTILINE)]
    code += re.findall(r"`(twin [^`\n]*)`", outside)
    return [line.removesuffix("&").strip() for line in code if re.match(r"twin [a-z]", line)]


def wrong_words(line: str) -> list[str]:
    """Words of a command line that the program does not know: its command, or options."""
    words = shlex.split(line.split(" | ")[0])[1:]
    name = next((" ".join(words[:n]) for n in (2, 1) if " ".join(words[:n]) in COMMANDS), "")
    if not name:
        group = [known for known in COMMANDS if known.startswith(f"{words[0]} ")]
        return [] if group and (len(words) == 1 or not words[1][0].islower()) else [words[0]]
    known = {option for each in COMMANDS[name].options for option in re.findall(r"--[\w-]+", each.name)} | {"--help"}
    return [word for word in words if word.startswith("--") and word.partition("=")[0] not in known]


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_commands_are_those_of_the_program(path):
    lines = command_lines(path.read_text(encoding="utf-8"))
    wrong = {line: wrong_words(line) for line in lines if wrong_words(line)}
    assert not wrong


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_of_the_help_are_commands_of_the_program(name):
    lines = re.sub(r"\\\n\s*", "", COMMANDS[name].example).splitlines()
    wrong = {
        line: wrong_words(part.strip())
        for line in lines
        for part in re.split(r"\s&(?:\s|$)", line)
        if "twin " in part and wrong_words(part.strip())
    }
    assert not wrong


@pytest.mark.parametrize("line", [command for command, _ in NEXT])
def test_what_the_demo_says_to_try_are_commands_of_the_program(line):
    assert line == "twin --help" or not wrong_words(line)


def test_a_wrong_command_is_found():
    assert wrong_words("twin render --sensr a --out b") == ["--sensr"] and wrong_words("twin rendr --out b") == ["rendr"]
    assert wrong_words("twin emulate") == [] and wrong_words("twin emulate mg400 --fault help") == []
    assert command_lines("`twin doctor`\n\n    twin sensors\n\n```bash\ntwin check 0 \\\n  --sensor a\n```\n") == [
        "twin check 0 --sensor a",
        "twin sensors",
        "twin doctor",
    ]


OFFERED = {"twin": twin.__all__, "twin.extend": twin.extend.__all__}


@cache
def names_of(module: str) -> set[str]:
    """What a module of ours offers."""
    if module in OFFERED:
        return set(OFFERED[module])
    path = ROOT / Path(*module.split("."))
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    found: set[str] = {each.stem for each in path.iterdir()} if path.is_dir() else set()
    for node in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom | ast.Import):
            found |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            found |= {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
        elif hasattr(node, "name"):
            found.add(node.name)
    return found


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_python_is_python_and_what_it_imports_is_there(path):
    for block in blocks(path.read_text(encoding="utf-8")):
        for node in ast.walk(ast.parse(block.code)) if block.language == "python" else ():
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in api.PACKAGES:
                missing = {alias.name for alias in node.names} - names_of(node.module)
                assert not missing, f"line {block.line}: {node.module} has no {missing}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_users_import_twin_alone(path):
    """In the README and the tutorials; other pages may go deeper, but none takes the name for something else."""
    for block in blocks(path.read_text(encoding="utf-8")):
        for node in ast.walk(ast.parse(block.code)) if block.language == "python" else ():
            assert not (isinstance(node, ast.Name) and node.id == "twin" and isinstance(node.ctx, ast.Store)), f"line {block.line}"
            if path.name == "README.md" or path.parent.name == "tutorials":
                names = {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
                names |= {node.module} if isinstance(node, ast.ImportFrom) and node.module else set()
                assert {name for name in names if name.split(".")[0] in api.PACKAGES} <= {"twin", "twin.extend"}, f"line {block.line}"


def test_every_extra_is_told():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    text = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
    assert not [extra for extra in extras if f"| `{extra}` |" not in text]


def test_the_readme_is_short():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(re.sub(r"<!--.*?-->", "", text).split()) <= MOST_WORDS


def test_pictures_are_small_and_shown():
    shown = {
        (path.parent / target).resolve()
        for path in DOCUMENTS
        for target in re.findall(r"(?:!\[[^\]]*\]\(|```\{image\} )([^)\s]+)", path.read_text(encoding="utf-8"))
    }
    kept = {path for path in (ROOT / "docs" / "pictures").rglob("*") if path.is_file()}
    assert kept <= shown, f"no document shows {sorted(path.name for path in kept - shown)}"
    assert not [path.name for path in kept if path.stat().st_size > LARGEST_PICTURE]
