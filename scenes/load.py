"""Reading specification files: finding and listing them, and errors that name the key and the remedy."""

import difflib
import hashlib
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from scenes.base import Section, SpecError, problem_text
from scenes.experiment import ExperimentSpec
from scenes.files import LONGEST_PATH, LONGEST_SHOWN, quote, read_toml
from scenes.object import MeshShape, ObjectSpec
from scenes.plugins import other_files
from scenes.randomisation import RandomisationSpec
from scenes.sensor import SensorSpec
from scenes.servo import ServoSpec
from scenes.tables import fill_in_tables

SHIPPED = Path(__file__).parent
MESH_SUFFIXES = (".stl", ".obj", ".ply")
OLD_WIDE = "-wide"
"""End of the names that wide experiments had in version 1."""
UNLISTED = ("servos",)
"""Kinds of specifications that no command lists. Errors name them all."""
# Largest number of problems that a message names. For further problems it states only their number.
MOST_PROBLEMS = 5
Spec = TypeVar("Spec", bound=BaseModel)


def user_spec_dir() -> Path:
    """Folder of a user's own specifications: ``sensors/*.toml``, ``objects/``, ``experiments/``, ``randomisations/``, ``servos/``.

    ``TACTIP_SPECS`` if set, else ``$XDG_CONFIG_HOME/tactip-twin`` (``~/.config``).
    """
    if own := os.environ.get("TACTIP_SPECS"):
        return Path(own)
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "tactip-twin"


def list_specifications(kind: str) -> dict[str, Path]:
    """Names and files of a kind, which is also the name of their folders: a user's own, others', and shipped ones, in this precedence."""
    shipped, own = ({path.stem: path for path in sorted(folder.glob("*.toml"))} for folder in (SHIPPED / kind, user_spec_dir() / kind))
    return shipped | other_files(kind, shipped) | own


def load_sensor(name_or_path: str | Path | SensorSpec) -> SensorSpec:
    """Load a sensor by name or by the path of its TOML file; as the other loaders, it returns a specification as it is.

    Raises
    ------
    SpecError
        There is no such sensor, or its file is not valid. The message names the file, the key and the remedy.
    """
    return _load(name_or_path, "sensors", SensorSpec)


def load_object(name_or_path: str | Path | ObjectSpec) -> ObjectSpec:
    """Load an object by name, by the path of its TOML file, or a mesh file itself (in mm).

    Raises
    ------
    SpecError
        There is no such object, or its file is not valid. The message names the file, the key and the remedy.
    """
    if isinstance(name_or_path, ObjectSpec):
        return name_or_path
    path = Path(name_or_path) if isinstance(name_or_path, str | os.PathLike) else Path()
    if path.suffix.lower() in MESH_SUFFIXES:
        if not os.path.isfile(path):  # unlike ``Path.is_file`` it is also False for a text that can't be a path
            raise SpecError(f"{quote(path, LONGEST_PATH)}: no such mesh file; give the path of an existing STL, OBJ or PLY")
        mesh = MeshShape(kind="mesh", file=str(path.resolve()), sha256=_digest(path))
        return _validate({"name": path.stem, "description": f"mesh {path.name}", "shape": mesh}, path, ObjectSpec)
    place = _find(name_or_path, "objects")
    spec = read_section(place, ObjectSpec)
    if isinstance(spec.shape, MeshShape):
        file = place.parent / spec.shape.file
        if not os.path.isfile(file):
            raise SpecError(f"{place}: shape.file: no such mesh file '{quote(spec.shape.file)}'; the path is relative to the specification")
        digest = _digest(file)
        if spec.shape.sha256 not in ("", digest):
            raise SpecError(f"{place}: shape.sha256: {file} has another content ({digest}); put the right file there, or leave the key out")
        spec = spec.alter(shape={"file": str(file.resolve()), "sha256": digest})
    return spec


def _digest(mesh: Path) -> str:
    try:
        with mesh.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise SpecError(f"{mesh}: can't be read ({error.strerror}); give a mesh file that may be read") from error


def load_experiment(name_or_path: str | Path | ExperimentSpec, *, wide: bool = False) -> ExperimentSpec:
    """Load an experiment by name or by the path of its TOML file.

    Parameters
    ----------
    wide : bool
        The experiment with its slightly larger ranges, in which models are trained.

    Raises
    ------
    SpecError
        There is no such experiment, its file is not valid, or it has no larger ranges. The message names the file, the key and the remedy.
    """
    name = str(name_or_path).removesuffix(OLD_WIDE)
    known = {} if name == str(name_or_path) else list_specifications("experiments")
    if name in known and str(name_or_path) not in known:
        warnings.warn(f"experiment '{name_or_path}' is now '{name}' with `wide`", RuntimeWarning, stacklevel=2)
        return load_experiment(name, wide=True)
    spec = _load(name_or_path, "experiments", ExperimentSpec)
    if wide and spec.wider:
        return load_experiment(spec.wider)
    if wide and spec.wide is None:
        raise SpecError(f"experiment '{spec.name}' has no larger ranges; leave `wide` out, or give its file a section [wide]")
    return spec.widen() if wide else spec


def load_randomisation(name_or_path: str | Path | RandomisationSpec) -> RandomisationSpec:
    """Load a randomisation by name or by the path of its TOML file.

    Raises
    ------
    SpecError
        There is no such randomisation, or its file is not valid. The message names the file, the key and the remedy.
    """
    return _load(name_or_path, "randomisations", RandomisationSpec)


def load_servo(name_or_path: str | Path | ServoSpec) -> ServoSpec:
    """Load servo parameters by name or by the path of their TOML file; ``SpecError`` as the others."""
    return _load(name_or_path, "servos", ServoSpec)


def _load(given: str | Path | Spec, kind: str, model: type[Spec]) -> Spec:
    return given if isinstance(given, model) else read_section(_find(given, kind), model)


_LISTED: dict[str, tuple[Callable[[str], Any], Callable[[Any], str]]] = {
    "sensors": (load_sensor, lambda spec: f"{spec.pins.count} pins, {spec.camera.channels}"),
    "objects": (load_object, lambda spec: spec.shape.kind),
    "experiments": (load_experiment, lambda spec: ", ".join(spec.targets)),
    "randomisations": (load_randomisation, lambda spec: f"{len(spec.sensor)} numbers of the sensor"),
}
"""Of each kind that a command lists: the function that loads a specification, and a detail of it that its line states."""


def catalog_lines(kind: str) -> list[str]:
    """A line for each specification of a kind that a command lists, then the folder of the shipped files, and that for own files."""
    load, detail = _LISTED[kind]
    lines, own = [], user_spec_dir() / kind
    for name, path in list_specifications(kind).items():
        try:
            spec = load(name)
        except SpecError as error:
            lines.append(f"{name:16} BROKEN: {error}")
            continue
        place = "" if path.is_relative_to(SHIPPED) else f"  [{path}]"
        lines.append(f"{name:16} {spec.description} ({detail(spec)}){place}")
    return [*lines, "", f"Shipped files: {SHIPPED / kind}", f"Your own: copy one to {own}/NAME.toml and edit it (or give a path: my.toml)"]


def _find(name_or_path: object, kind: str) -> Path:
    if not isinstance(name_or_path, str | os.PathLike):
        raise SpecError(f"expected a name or a file of {kind}, got {name_or_path!r}")
    path, known = Path(name_or_path), list_specifications(kind)
    listed = f"known: {', '.join(known)}" if kind in UNLISTED else f"'twin {kind}' lists them"
    if path.suffix != ".toml" and os.path.isfile(path):
        suffixes = ", ".join((".toml", *MESH_SUFFIXES) if kind == "objects" else (".toml",))
        raise SpecError(f"{path}: files ending in '{path.suffix}' are not understood here; give one of {suffixes}")
    if path.suffix == ".toml":
        if not os.path.isfile(path):
            raise SpecError(f"{quote(path, LONGEST_PATH)}: no such file; give the path of a TOML specification, or a name ({listed})")
        return path
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    near = difflib.get_close_matches(str(name_or_path), known, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
    raise SpecError(f"no {kind[:-1]} named '{quote(name_or_path)}': {hint} ({listed}; own files go to {user_spec_dir() / kind})")


def read_section(path: Path, model: type[Spec]) -> Spec:
    """Section of the type ``model`` from a TOML file. The default of the key ``name`` is the file's stem.

    Raises
    ------
    SpecError
        If the file can't be read or is not valid. The message names the file, the key and the remedy, on one line.
    """
    name = {"name": path.stem} if "name" in model.model_fields else {}
    return _validate(name | read_toml(path), path, model)


def _validate(data: dict[str, object], path: Path, model: type[Spec]) -> Spec:
    try:
        return model.model_validate(fill_in_tables(data, path.parent))
    except ValueError as error:
        problem = explain_problems(error, model) if isinstance(error, ValidationError) else error
        raise SpecError(f"{path}: {problem}") from error


def explain_problems(error: ValidationError, model: type[BaseModel]) -> str:
    """The problems of a validation, key by key, in one line."""
    problems = []
    found = sorted(error.errors(include_url=False), key=lambda item: item["type"] != "extra_forbidden")  # a misspelt key is missing, too
    for item in found[:MOST_PROBLEMS]:
        key = ".".join(quote(part) for part in item["loc"])
        if item["type"] == "extra_forbidden":
            known = _keys_at(model, item["loc"][:-1])
            near = difflib.get_close_matches(quote(item["loc"][-1]), known, n=1)
            problems.append(f"unknown key '{key}'; " + (f"did you mean '{near[0]}'?" if near else f"known here: {', '.join(known)}"))
        elif item["type"] == "missing":
            problems.append(f"key '{key}' is missing; add it (see the shipped specifications for examples)")
        else:
            came = "" if isinstance(item["input"], dict) else f", got {quote(repr(item['input']))}"
            said = quote(problem_text(item), 4 * LONGEST_SHOWN)
            between = "" if not key else " " if said.startswith("must be") else ": "
            problems.append(f"{key}{between}{said}{came}")
    if len(found) > MOST_PROBLEMS:
        problems.append(f"and {len(found) - MOST_PROBLEMS} more")
    return "; ".join(problems)


def _keys_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Known keys of the section at ``loc``; the tag of a tagged union is a part of ``loc``."""
    candidates = [model]
    for part in loc:
        stepped = [m for c in candidates if part in c.model_fields for m in _models_in(c.model_fields[part].annotation)]
        tagged = [c for c in candidates if part in _tags(c)]
        candidates = stepped or tagged or candidates
    return sorted({key for c in candidates for key in (c.file_keys() if issubclass(c, Section) else c.model_fields)})


def _models_in(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in getattr(annotation, "__args__", ()) for m in _models_in(arg)]


def _tags(model: type[BaseModel]) -> tuple[str, ...]:
    kind = model.model_fields.get("kind")
    return getattr(kind.annotation, "__args__", ()) if kind else ()
