"""Reading of files with limits, because their content is not trusted: the size of any file, and the depth and numbers of a TOML file."""

import errno
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path

from scenes.base import SpecError

LARGEST_BYTES = 4_000_000  # largest size of a TOML file; the largest shipped specification, with measured light and caps, has 0.17 MB
DEEPEST = 16  # largest depth of nested tables and arrays; the shipped files have at most 5
INT64 = range(-(2**63), 2**63)  # integers of TOML (v1.0.0, "Integer")

LONGEST_SHOWN = 60  # largest number of characters of a wrong key or value in a message
LONGEST_PATH = 400  # largest number of characters of a path in a message


def quote(part: object, most: int = LONGEST_SHOWN) -> str:
    """A key or value of a file for a one-line message: its first ``most`` characters, with ``?`` for characters that can't be printed."""
    text = str(part)
    text = text if len(text) <= most else f"{text[:most]}..."
    return "".join(c if c.isprintable() else "?" for c in text)


def require_regular(path: Path) -> None:
    """Refuse everything except a regular file. Reading a named pipe, a device or a socket might never begin or never end.

    Raises
    ------
    OSError
        If there is no file, or if it is not a regular file; ``strerror`` states the reason.
    """
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, "a folder, not a file", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "a named pipe or a device, not a file", str(path))


def read_regular(path: Path, most_bytes: int) -> bytes:
    """The content of a regular file of at most ``most_bytes`` bytes.

    Raises
    ------
    OSError
        If the file can't be read, is larger, or is not a regular file; ``strerror`` states the reason.
    """
    require_regular(path)
    with path.open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {most_bytes / 1e6:g} MB", str(path))
    return content


def read_toml(path: Path) -> dict[str, object]:
    """The content of a TOML file. A byte order mark is ignored.

    Raises
    ------
    SpecError
        If the file can't be read, is not TOML, or exceeds the limits of this module. The message names the file and the remedy, on one
        line.
    """
    try:
        raw = read_regular(path, LARGEST_BYTES)
    except OSError as error:
        raise SpecError(f"{path}: can't be read ({error.strerror}); give the path of a TOML file") from error
    try:
        data = tomllib.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise SpecError(f"{path}: not readable as TOML: no UTF-8 text (byte {error.start}); save it as UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"{path}: not readable as TOML: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise SpecError(f"{path}: {_TOO_DEEP}") from error
    except ValueError as error:  # Python refuses to read thousands of decimal digits
        raise SpecError(f"{path}: {_TOO_LONG}") from error
    for key, problem in _beyond_bounds(data):
        raise SpecError(f"{path}: {quote(key)}: {problem}")
    return data


_TOO_DEEP = f"nested deeper than {DEEPEST} tables and arrays; write it flatter"
_TOO_LONG = "a whole number has more than 64 bits; write it as 1e20 if it is meant"


def _beyond_bounds(data: dict[str, object]) -> Iterator[tuple[str, str]]:
    """Keys that exceed the limits, and the reasons. The search is not recursive, because the depth may be too large for a recursion."""
    left: list[tuple[str, int, object]] = [("", 0, data)]
    while left:
        key, depth, value = left.pop()
        if isinstance(value, dict | list):
            if depth > DEEPEST:
                yield key, _TOO_DEEP
                return
            parts = value.items() if isinstance(value, dict) else ((key, part) for part in value)
            inner = f"{key}." if key and isinstance(value, dict) else ""
            left += [(f"{inner}{name}", depth + 1, part) for name, part in parts]
        elif isinstance(value, int) and value not in INT64:
            yield key, _TOO_LONG
