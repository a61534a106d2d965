"""Runs commands in one process; as a program, where nothing but the core is installed: no module of an extra is found.

It prints the exit code of each, and its errors.

python core_alone.py COMMAND... (each in quotes)
"""

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib.machinery import PathFinder

from twin.cli import main
from twin.errors import EXTRAS


class CoreFinder(PathFinder):
    """Finds modules, without those of the extras and of what only they bring."""

    @classmethod
    def find_spec(cls, fullname, path=None, target=None):
        return None if fullname.partition(".")[0] in {*EXTRAS, "filelock"} else super().find_spec(fullname, path, target)


def run(command: str) -> tuple[int, str, str]:
    """Exit code of a command, what it printed, and its errors."""
    sys.argv = ["twin", *command.split()]
    with redirect_stdout(io.StringIO()) as printed, redirect_stderr(io.StringIO()) as said:
        try:
            main()
        except SystemExit as end:
            return end.code or 0, printed.getvalue(), said.getvalue()
    return 0, printed.getvalue(), said.getvalue()


if __name__ == "__main__":
    assert not {*EXTRAS} & set(sys.modules)
    sys.meta_path[sys.meta_path.index(PathFinder)] = CoreFinder
    print(json.dumps([run(command)[::2] for command in sys.argv[1:]]))
