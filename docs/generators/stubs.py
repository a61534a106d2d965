"""The stubs of ``twin`` and ``twin.extend``, for editors and type checkers: from their tables of names and the functions of commands.

python -m generators.stubs    # in docs/; writes twin/__init__.pyi and twin/extend.pyi
"""

import inspect
import re
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import twin
import twin.extend

ROOT = Path(__file__).parents[2]
STUBS = {ROOT / "twin" / "__init__.pyi": twin, ROOT / "twin" / "extend.pyi": twin.extend}
WIDER = {"AlsoFormat": "str", "Path": "Path | str", "Form": "Form | str"}
"""What a function takes in Python, by the type on the command line."""
SPECIFICATIONS = {"sensor": "SensorSpec", "obj": "ObjectSpec", "experiment": "ExperimentSpec", "servo": "ServoSpec"}
OTHERWISE = {"target": "str | Sequence[str]", "objects": "str | Sequence[str]", "source": "str | Path", "camera": "str | Path"}


def stub_of(module: ModuleType) -> str:
    """The stub of a module of lazily imported names."""
    places: dict[str, str] = module._PLACES
    commands = [name for name, place in places.items() if place.startswith("twin.cli.")]
    results = {name: inspect.signature(getattr(module, name)).return_annotation for name in commands}
    sources = dict(pair for name in commands for pair in _types_in(places[name]))
    imports = {(sources[kind], kind) for several in results.values() for kind in several.split(" | ")}
    for name, place in places.items():
        if name not in commands:
            source, _, other = place.partition(":")
            imports.add((source, other or name))
    renamed = {name: place.partition(":")[2] for name, place in places.items() if ":" in place}
    lines = [f'"""{(module.__doc__ or "").partition(chr(10))[0]} Made by docs/generators/stubs.py."""', ""]
    if commands:
        lines += ["from collections.abc import Sequence", "from pathlib import Path", "from typing import Literal", ""]
        imports |= {("scenes", kind) for kind in SPECIFICATIONS.values()} | {("twin.progress", "Progress")}
    lines += [f"from {source} import {name} as {name}" for source, name in sorted(imports)]
    lines += [f"from {module.__name__} import {name} as {name}" for name in getattr(module, "_MODULES", ())]
    lines += ["", *(f"{name} = {other}" for name, other in sorted(renamed.items()))]
    if hasattr(module, "require_own"):
        lines += ["", "__version__: str", "", "def require_own(*names: str) -> None: ..."]
    for name in commands:
        lines += _function(name, inspect.signature(getattr(module, name)))
    return "\n".join(lines) + "\n"


def _types_in(module: str) -> list[tuple[str, str]]:
    """The classes of results that a module of commands names, with the modules they come from."""
    source = inspect.getsource(import_module(module))
    block = re.search(r"^if TYPE_CHECKING:\n((?:    .*\n)+)", source, re.MULTILINE)
    found = re.findall(r"from (\S+) import (.+)", block[1]) if block else []
    return [(kind, place) for place, kinds in found for kind in kinds.split(", ")]


def _function(name: str, signature: inspect.Signature) -> list[str]:
    parts, starred = [], False
    for each in signature.parameters.values():
        if each.kind is each.KEYWORD_ONLY and not starred:
            parts, starred = [*parts, "*"], True
        kind = re.sub(r"\b(?:pathlib|twin\.types|twin\.progress|twin\.cli\.\w+|typing)\.", "", inspect.formatannotation(each.annotation))
        optional = kind.endswith(" | None") or kind.startswith("Optional[")
        kind = kind.removesuffix(" | None").removeprefix("Optional[").removesuffix("]" if kind.startswith("Optional[") else "")
        if several := re.fullmatch(r"list\[(.*)\]", kind):
            one = WIDER.get(several[1], several[1])
            kind = f"{one} | Sequence[{one}]"
        kind = WIDER.get(kind, kind)
        if each.name in SPECIFICATIONS and kind == "str":
            kind = f"str | Path | {SPECIFICATIONS[each.name]}"
        kind = OTHERWISE.get(each.name, kind) if kind == "str" else kind
        kind += " | None" if optional else ""
        parts.append(f"{each.name}: {kind}{'' if each.default is each.empty else ' = ...'}")
    return ["", f"def {name}(", *(f"    {part}," for part in parts), f") -> {signature.return_annotation}: ..."]


if __name__ == "__main__":
    for path, module in STUBS.items():
        path.write_text(stub_of(module), encoding="utf-8")
        sys.stdout.write(f"wrote {path}\n")
