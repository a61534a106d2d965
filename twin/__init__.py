"""Digital twin of the TacTip: simulate contacts of the skin, render the frames of its camera, find the pins, and build their graph."""

from importlib.util import find_spec
from pathlib import Path


def require_own(*names: str) -> None:
    """Raise ``ImportError`` if a module of another program is found under the name of a package that belongs to this one."""
    home = Path(__file__).parent.parent
    for name in names:
        spec = find_spec(name)
        if spec is not None and spec.origin and Path(spec.origin).parent.parent != home:
            hiding = Path(spec.origin).parent if spec.submodule_search_locations else spec.origin
            raise ImportError(f"{hiding} hides {home / name} of tactip-twin; rename it, or start in another folder")


require_own("scenes")
