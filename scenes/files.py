"""Reading files from anywhere, bounded: any file in size; a TOML file also in depth and numbers, whatever was written into it."""

import errno
import stat
import tomllib
from collections.abc import Iterator
from pathlib import Path

from scenes.base import SpecError

LARGEST_BYTES = 4_000_000  # of a TOML file; the largest shipped specification, with measured light and caps, has 0.17 MB
DEEPEST = 16  # tables and arrays within each other; the shipped ones have at most 5
INT64 = range(-(2**63), 2**63)  # the whole numbers of TOML (v1.0.0, "Integer")

LONGEST_SHOWN = 60  # characters of a wrong key or value that a message shows
LONGEST_PATH = 400  # characters of a path that a message shows


def shown(part: object, most: int = LONGEST_SHOWN) -> str:
    """What a file holds as a part of a one-line message: its beginning, and ``?`` for what would not print."""
    text = str(part)
    text = text if len(text) <= most else f"{text[:most]}..."
    return "".join(c if c.isprintable() else "?" for c in text)


def require_regular(path: Path) -> None:
    """Refuse what would never end or never begin to be read: named pipes, devices, sockets; and folders.

    Raises
    ------
    OSError
        There is no file, or it is none of these; ``strerror`` says which.
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
        It can't be read, is larger, or is no regular file; ``strerror`` says why.
    """
    require_regular(path)
    with path.open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"larger than {most_bytes / 1e6:g} MB", str(path))
    return content


def read_toml(path: Path) -> dict[str, object]:
    """The content of a TOML file; a byte order mark is no part of it.

    Raises
    ------
    SpecError
        It can't be read, is no TOML, or goes beyond the bounds above; names the file and the remedy, on one line.
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
        raise SpecError(f"{path}: {shown(key)}: {problem}")
    return data


_TOO_DEEP = f"nested deeper than {DEEPEST} tables and arrays; write it flatter"
_TOO_LONG = "a whole number has more than 64 bits; write it as 1e20 if it is meant"


def _beyond_bounds(data: dict[str, object]) -> Iterator[tuple[str, str]]:
    """Keys beyond the bounds, and what is wrong with them; without recursion, whose depth is what may be wrong."""
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
