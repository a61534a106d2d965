"""The field's words: names, help, studio and documents are free of private words, and a function's name is a verb phrase."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
import typer

from twin.cli import command_line

ROOT = Path(__file__).parents[2]
PACKAGES = ("scenes", "twin", "training", "hardware")

# Words of public names (functions, classes, parameters, fields), between underscores or capitals, and what to write.
NAMES = {
    "told": "estimated, or a verb phrase such as describe_run",
    "tell": "estimate, print, report or state",
    "tells": "estimates",
    "said": "a verb phrase such as messages_of",
    "asked": "requested, or a verb phrase",
    "felt": "reading",
    "stimulus": "obj",
    "worth": "effect, ablation or label_efficiency",
    "backwards": "model_inversion",
    "judge": "evaluate, assess or measure",
    "judged": "evaluated",
    "judgement": "evaluation",
    "rub": "update_friction",
    "rubbed": "friction_substeps",
    "mend": "fix or repair",
    "anew": "again or new",
    "untold": "not_assessed",
    "stories": "hypotheses",
    "shoot": "render",
    "shot": "frame",
}
# Names that stay for the time being: what files of results contain, and what belongs to other projects. This list may only shrink.
NAMES_ALLOWED = {("scenes/sensor.py", "shot_noise"), ("training/surrogate/reading.py", "felt")}

# A participle alone is no name of a function, except where it returns its argument changed, as ``sorted`` does.
PARTICIPLES_ALLOWED = {
    ("hardware/safety/safe_arm.py", "_ungated"),
    ("scenes/plugins.py", "offered"),
    ("training/environments/baselines.py", "seen"),
    ("training/environments/learn.py", "seen"),
    ("training/estimate/rest.py", "measured"),
    ("twin/calibration/light/ring.py", "fitted"),
    ("twin/camera/capture.py", "_scaled"),
    ("twin/camera/capture.py", "amplified"),
    ("twin/camera/capture.py", "blurred"),
    ("twin/camera/capture.py", "cleaned"),
    ("twin/camera/capture.py", "compressed"),
    ("twin/camera/capture.py", "decoded"),
    ("twin/camera/capture.py", "developed"),
    ("twin/camera/capture.py", "dispersed"),
    ("twin/camera/capture.py", "encoded"),
    ("twin/camera/capture.py", "hazed"),
    ("twin/camera/capture.py", "shared"),
    ("twin/camera/capture.py", "sharpened"),
    ("twin/camera/capture.py", "vignetted"),
    ("twin/cli/options.py", "_hidden"),
    ("twin/compiled.py", "compiled"),
    ("twin/evaluation/degradation/conditions/body.py", "broken"),
    ("twin/evaluation/degradation/conditions/body.py", "faded"),
    ("twin/evaluation/degradation/conditions/body.py", "softened"),
    ("twin/evaluation/degradation/conditions/body.py", "swollen"),
    ("twin/evaluation/degradation/conditions/body.py", "torn"),
    ("twin/evaluation/degradation/conditions/body.py", "yellowed"),
    ("twin/evaluation/degradation/conditions/electronics.py", "displaced"),
    ("twin/evaluation/degradation/conditions/electronics.py", "posterised"),
    ("twin/evaluation/degradation/conditions/optics.py", "dimmed"),
    ("twin/evaluation/degradation/conditions/optics.py", "reddened"),
    ("twin/evaluation/degradation/conditions/optics.py", "scratched"),
    ("twin/evaluation/degradation/conditions/placement.py", "distorted"),
    ("twin/evaluation/degradation/conditions/placement.py", "rolled"),
    ("twin/evaluation/degradation/conditions/placement.py", "shifted"),
    ("twin/evaluation/degradation/conditions/placement.py", "tilted"),
    ("twin/evaluation/degradation/conditions/placement.py", "torn"),
    ("twin/evaluation/degradation/conditions/placement.py", "vignetted"),
    ("twin/evaluation/degradation/conditions/placement.py", "zoomed"),
    ("twin/optics/preview.py", "defocused"),
    ("twin/pins/labelling/matching.py", "proven"),
    ("twin/types.py", "undeformed"),
}
IRREGULAR = {
    *("told", "said", "given", "seen", "asked", "felt", "made", "done", "drawn", "found", "known", "shown", "taken", "met"),
    *("gone", "kept", "left", "lost", "meant", "sent", "shot", "sold", "spent", "thought", "torn", "understood", "written", "bent"),
    *("built", "bought", "caught", "chosen", "frozen", "held", "hidden", "hung", "laid", "led", "lit", "proven", "sewn", "spoken"),
    *("stolen", "stuck", "swollen", "taught", "woken", "worn", "heard", "begun", "broken", "eaten", "grown", "learnt", "bound", "fed"),
    *("slid", "sought", "swept", "thrown", "won"),
}

# Phrases of help, messages of the studio and documents, and what to write.
PHRASES = {
    r"\banew\b": "again, new",
    r"\bmend(?:s|ed)?\b": "fix, repair",
    r"\bjudge[ds]?\b": "evaluate",
    r"\btells? (?:the (?:pose|depth|angle|slip|force)|slip|it)\b": "estimate",
    r"\btold (?:apart|right|rightly)\b": "distinguished, classified correctly",
    r"\b(?:is|are) told\b": "is printed, is estimated",
    r"\b(?:do|does|can) ?not tell\b": "do not determine",
    r"\bis worth\b|\bare worth\b": "effect of, ablation",
    r"\bput beside\b": "combined by co-kriging",
    r"\bread backwards\b": "model inversion",
    r"\bfriction (?:remembers|forgets)\b": "history-dependent friction",
    r"\bsensor is well\b|\bsensor well\b": "healthy",
    r"\bclaims? that (?:is|are) pins?\b": "precision",
    r"\bpins with another's name\b": "misidentified pins",
    r"\bframes that can be used\b": "valid frames",
    r"\bedges kept\b": "edges retained",
    r"\bFind the edge\b": "Find breaking point",
    r"\bNothing is wrong\b": "Reset",
    r"\bNext doubt\b(?!ful)": "Next doubtful label",
    r"\bPlay a way\b": "Play trajectory",
    r"\bobjects? never touched\b": "unseen objects",
    r"\bstand-in for (?:a sensor's |the )?finite elements\b": "surrogate model",
    r"\bwhere it ended\b": "resumes",
    r"\bframes (?:it was not|that were not) fitted(?: to)?\b": "held-out frames",
    r"(?:--form|--images) recording\b|pipeline\.recording\b|\brecording form\b": "processed",
    r"--across\b|--no-sight\b|--sight\b|--no-memory\b|--memory\b|--labels\b|--limits?\b": "the present option",
}
PHRASES_ALLOWED = {}
"""Occurrences in documents that stay: by file, the phrase's pattern. The change log and the page on version 2 name what was."""
HISTORY = {"CHANGELOG.md", "docs/from-1-to-2.md"}


def words_of(name: str) -> set[str]:
    """The lower-case words of a name."""
    return {word.lower() for part in name.split("_") for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", part)}


@cache
def trees() -> dict[str, ast.Module]:
    """Every module's syntax tree by its path."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text(encoding="utf-8")) for path in paths}


@pytest.fixture(scope="module", autouse=True)
def drop_trees():
    """The trees of all modules take much memory, which the tests after these do not need."""
    yield
    trees.cache_clear()


def public_names(tree: ast.Module) -> set[str]:
    """Names of functions, classes, parameters and fields, without those that begin with an underscore and what is below them."""
    found, stack = set(), [(tree, False)]
    while stack:
        node, inside = stack.pop()
        for each in ast.iter_child_nodes(node):
            if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef):
                if not each.name.startswith("_") and not inside:
                    arguments = each.args
                    found |= {each.name, *(arg.arg for arg in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs])}
            elif isinstance(each, ast.ClassDef):
                if not each.name.startswith("_"):
                    found |= {
                        each.name,
                        *(e.target.id for e in each.body if isinstance(e, ast.AnnAssign) and isinstance(e.target, ast.Name)),
                    }
                    stack.append((each, inside))
            else:
                stack.append((each, inside))
    return found


def forbidden_names() -> set[tuple[str, str]]:
    """File and name of each public name with a private word."""
    return {(file, name) for file, tree in trees().items() for name in public_names(tree) if words_of(name) & set(NAMES)}


def participles() -> set[tuple[str, str]]:
    """File and name of each function whose name is a participle alone, without properties."""
    found = set()
    for file, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and not any("property" in ast.unparse(mark) for mark in node.decorator_list):
                word = node.name.strip("_")
                verb = word in ("feed", "speed", "embed", "seed", "need")
                if "_" not in word and not verb and (word in IRREGULAR or word.endswith("ed")):
                    found.add((file, node.name))
    return found


def class_names() -> dict[str, list[str]]:
    """Files of each public class."""
    found: dict[str, list[str]] = {}
    for file, tree in trees().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found.setdefault(node.name, []).append(file)
    return found


def test_public_names_are_the_fields_words():
    new = {f"{file}: {name}: {words_of(name) & set(NAMES)}" for file, name in forbidden_names() - NAMES_ALLOWED}
    assert not new, f"write another name: {NAMES}"
    assert forbidden_names() >= NAMES_ALLOWED, "an allowed name is gone: take it from the list"


def test_a_functions_name_is_no_participle():
    assert not participles() - PARTICIPLES_ALLOWED, "a function is named by a verb phrase"
    assert participles() >= PARTICIPLES_ALLOWED, "an allowed name is gone: take it from the list"
    assert len(PARTICIPLES_ALLOWED) <= 60


def test_a_public_classs_name_stands_once():
    assert not [name for name, files in class_names().items() if len(files) > 1]


def documents() -> list[Path]:
    return [ROOT / "README.md", *sorted(path for path in (ROOT / "docs").rglob("*.md") if "generated" not in path.parts)]


def phrases_in(text: str) -> list[str]:
    text = re.sub(r"\s+", " ", text)
    return [f"{found[0]!r}: write {write}" for pattern, write in PHRASES.items() for found in re.finditer(pattern, text)]


@pytest.mark.parametrize("path", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_a_document_has_the_fields_words(path):
    name = str(path.relative_to(ROOT))
    if name not in HISTORY:
        found = phrases_in(path.read_text(encoding="utf-8"))
        assert len(found) <= PHRASES_ALLOWED.get(name, 0), found


def commands(command, name="twin"):
    yield name, command
    for each, below in getattr(command, "commands", {}).items():
        yield from commands(below, f"{name} {each}")


COMMANDS = dict(commands(typer.main.get_command(command_line())))


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_the_fields_words(name):
    command = COMMANDS[name]
    shown = [command.help or "", *(option.help or "" for option in command.params if not getattr(option, "hidden", False))]
    assert not phrases_in("\n".join(shown))


def test_the_studio_has_the_fields_words():
    texts = [
        node.value
        for file, tree in trees().items()
        if file.startswith("twin/studio/")
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    assert len(texts) > 1000 and not [phrase for text in texts for phrase in phrases_in(text)]


def test_a_forbidden_word_is_found():
    assert words_of("poses_told") & set(NAMES) == {"told"} and words_of("JudgeShot") & set(NAMES) == {"judge", "shot"}
    assert not words_of("shotgun_retold") & set(NAMES)
    assert phrases_in("the same contact,\nbegun anew") and not phrases_in("an untouched document")
