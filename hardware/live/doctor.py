"""Lists what this machine has, what is missing, and the remedy: packages, renderer, 3D pictures, cameras, serial ports, ROS 2 topics.

Opens no device.
"""

import importlib.metadata
import importlib.util
import platform
import sys
from dataclasses import dataclass, field
from pathlib import Path

from serial.tools import list_ports

from hardware.cameras.source import PICTURES, SYSFS_CAMERAS, port_of
from hardware.errors import DeviceError
from hardware.ros2.dds import Participant
from scenes import list_specifications
from scenes.plugins import plugin_lines
from twin.errors import EXTRAS, ExtraError, RenderError
from twin.optics.variant import report
from twin.report.skin3d import probe_offscreen
from twin.store import cache_folder
from twin.types import ReadableResult

# Packages whose versions are listed.
PACKAGES = ("mitsuba", "drjit", "pyvista", "vtk", "trimesh", "torch", "scikit-image", "pyserial", "opencv-python-headless", "numba")
# The program's own packages. They are checked, because another project may have a package of the same name.
OWN = ("scenes", "twin", "training", "hardware")
# Kinds of devices, each with the remedy if none is found.
DEVICES = {
    "camera": "plug in the sensor's USB camera; in a container pass --device /dev/video0; on Windows and macOS try '--camera 0'",
    "serial": "plug in the arm's USB cable; on Linux the user must be in the group 'dialout'",
    "ROS 2": "pip install 'tactip-twin[ros2]', start what publishes pictures, and set ROS_DOMAIN_ID to its domain",
}


@dataclass(frozen=True)
class Device:
    """A device node and its description by the system."""

    node: str
    description: str


def cameras(sysfs: Path = SYSFS_CAMERAS) -> list[Device]:
    """UVC cameras the Linux kernel knows (``/dev/video*`` with their names), without opening them."""
    found = []
    for entry in sorted(sysfs.glob("video*")):
        name = entry / "name"
        described = name.read_text(encoding="utf-8").strip() if name.is_file() else "camera"
        found.append(Device(f"/dev/{entry.name}", ", ".join(filter(None, [described, port_of(entry)]))))
    return found


def serial_ports() -> list[Device]:
    """Serial ports (a Dobot Magician shows as a CP210x or CH340 USB adapter)."""
    return [Device(port.device, port.description or "serial port") for port in sorted(list_ports.comports())]


def ros2_topics() -> list[Device]:
    """Topics of the domain that somebody publishes, pictures as texts for ``camera``; none without the package ``cyclonedds``."""
    try:
        found = Participant().topics()
    except (DeviceError, ExtraError):
        return []
    return [Device(f"ros2:{topic}" if kind in PICTURES else topic, kind) for topic, kind in found.items()]


@dataclass(frozen=True, repr=False)
class Machine(ReadableResult):
    """What this machine has.

    Attributes
    ----------
    packages : dict of str to str
        Versions; "" for a package that is missing.
    rendering : list of str
        Lines on Mitsuba's variants, LLVM and the GPU.
    can_render : bool
        Whether this machine can render.
    plain_pictures : str
        Reason why VTK draws no 3D pictures ("" if it does). Simpler pictures are then drawn.
    devices : dict of str to list of Device
        Devices by kind: ``camera``, ``serial`` and ``ROS 2`` (topics).
    places : dict of str to Path
        The folder from which each of the program's own packages is imported.
    kept : Path or None
        The folder of stored results; None if nothing is stored.
    plugins : list of str
        Lines on the parts that other packages offer.
    """

    packages: dict[str, str]
    rendering: list[str]
    can_render: bool
    plain_pictures: str
    devices: dict[str, list[Device]]
    places: dict[str, Path]
    kept: Path | None
    plugins: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = [f"Python      {platform.python_version()} ({sys.executable}) on {platform.system()} {platform.machine()}"]
        lines += [f"{name:11} {version or _remedy(name)}" for name, version in self.packages.items()]
        lines += ["", *self._own_lines(), f"kept results {self.kept or 'none: the cache is off'}"]
        lines += ["", "Rendering (Mitsuba)", *(f"  {line}" for line in self.rendering)]
        lines += ["", "3D pictures (VTK offscreen)", f"  {'PLAIN ONLY: ' + self.plain_pictures if self.plain_pictures else 'works'}"]
        lines += ["", "Devices"]
        for kind, found in self.devices.items():
            lines += [f"  {kind}: {device.node} ({device.description})" for device in found]
            if not found:
                lines.append(f"  {kind}: none found; {DEVICES[kind]}")
        if self.plugins:
            lines += ["", "Parts of other packages", *(f"  {line}" for line in self.plugins)]
        return [*lines, "", self._verdict()]

    def _verdict(self) -> str:
        """What can be done here, in a sentence."""
        missing = [name for name, version in self.packages.items() if not version and name not in EXTRAS]
        if missing or not self.can_render:
            lacking = [*(["a way to render (see above)"] if not self.can_render else []), *missing]
            return f"Not ready: this machine does not have {', '.join(lacking)}."
        plain = " Pictures of the deformed skin are plain ones." if self.plain_pictures else ""
        models = "" if self.packages.get("torch") else " Models need PyTorch (torch): pip install 'tactip-twin[models]'."
        return f"Ready: frames can be rendered and read.{models}{plain} Next: twin demo --out out/demo"

    def _own_lines(self) -> list[str]:
        """The place of the program's own packages, or a line for each package if they lie in different places."""
        if len(set(self.places.values())) == 1:
            return [f"{', '.join(self.places)} in {next(iter(self.places.values()))}"]
        said = [f"{name} in {place}" for name, place in self.places.items()]
        return [*said, "MIXED: another project has a package of the same name; install this program into an environment of its own"]


def examine_machine() -> Machine:
    """Look for packages, Mitsuba's variants, LLVM, a GPU, offscreen 3D, cameras, serial ports and ROS 2 topics. Opens no device."""
    rendering, can_render = _rendering()
    for kind in ("sensors", "objects", "experiments", "randomisations"):
        list_specifications(kind)  # so that a clash of names is known
    devices = dict(zip(DEVICES, (cameras(), serial_ports(), ros2_topics()), strict=True))
    versions = {name: _version(name) for name in PACKAGES}
    return Machine(versions, rendering, can_render, probe_offscreen(), devices, _places(), cache_folder(), plugin_lines())


def _remedy(package: str) -> str:
    """What is said of a package that is missing."""
    return f"not installed: pip install 'tactip-twin[{EXTRAS[package]}]'" if package in EXTRAS else "MISSING; run 'make setup'"


def _places() -> dict[str, Path]:
    """The folder from which each of the program's own packages is imported."""
    found = {name: importlib.util.find_spec(name) for name in OWN}
    return {name: Path(spec.origin).parents[1] for name, spec in found.items() if spec is not None and spec.origin}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _rendering() -> tuple[list[str], bool]:
    try:
        found = report()
    except RenderError as error:
        return [f"NOT POSSIBLE: {error}"], False
    lines = [f"variants installed: {', '.join(found['variants'])}"]
    lines += [f"for {channels} cameras: {used['variant'] or 'NONE'} ({used['reason']})" for channels, used in found["used"].items()]
    llvm = found["llvm"]
    lines.append(f"LLVM: {llvm['version']} at {llvm['path']}" if llvm else f"LLVM: none that works; {found['remedy']}")
    lines += [f"  not used: {rejected['path']}: {rejected['reason']}" for rejected in found["llvm_rejected"]]
    lines.append(f"GPU: {'yes' if found['gpu'] else 'none used'} ({found['gpu_reason']})")
    if found["override"]:
        lines.append(f"TACTIP_VARIANT={found['override']} is set")
    return lines, any(used["variant"] for used in found["used"].values())
