"""What devices are attached to this machine: cameras and serial ports. Opens none of them."""

from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

SYSFS_CAMERAS = Path("/sys/class/video4linux")


@dataclass(frozen=True)
class Device:
    """A device node and what the system says it is."""

    node: str
    description: str


def cameras(sysfs: Path = SYSFS_CAMERAS) -> list[Device]:
    """UVC cameras the Linux kernel knows (``/dev/video*`` with their names), without opening them."""
    found = []
    for entry in sorted(sysfs.glob("video*")):
        name = entry / "name"
        found.append(Device(f"/dev/{entry.name}", name.read_text().strip() if name.is_file() else "camera"))
    return found


def serial_ports() -> list[Device]:
    """Serial ports (a Dobot Magician shows as a CP210x or CH340 USB adapter)."""
    return [Device(port.device, port.description or "serial port") for port in sorted(list_ports.comports())]
