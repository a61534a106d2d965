"""Makes an arm of any kind from its specification: ``open_arm("mg400:192.168.1.6")``."""

from hardware.arms.arm import Arm, SimulatedArm
from hardware.arms.magician import Magician, attached_port
from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.arms.mg400_wire import DEFAULT_HOSTS, address_of
from hardware.arms.ros2 import ARM_FORM, ros2_arm
from hardware.arms.ur.driver import UR
from hardware.errors import DeviceError
from scenes.files import quote
from scenes.plugins import others

KINDS = ("simulated", "mg400", "mg400-lenient", "magician", "ros2", "ur")
ARM_SPECS = (
    "mg400 or mg400:ADDRESS[:DASHBOARD_PORT] (an arm, or 127.0.0.1 with 'twin emulate mg400'), mg400-lenient:ADDRESS[:DASHBOARD_PORT] "
    f"(a controller that is not an MG400's), magician or magician:/dev/ttyUSB0, {ARM_FORM}, ur:ADDRESS, "
    "simulated (six axes) or simulated:4"
)


def open_arm(spec: str) -> Arm:
    """An arm from its specification. Nothing is opened before ``connect``.

    Parameters
    ----------
    spec : str
        See ``ARM_SPECS``. Without an address the MG400 is expected at that of its first network port (192.168.1.6). Without a
        port the Magician is expected at the only USB adapter of its kind.

    Raises
    ------
    DeviceError
        The specification is not understood, or no Magician is attached.
    """
    kind, _, rest = spec.partition(":")
    if kind == "simulated" and rest in ("", "4", "6"):
        return SimulatedArm(axes=int(rest or 6))
    if kind in ("mg400", "mg400-lenient"):
        host, offset = address_of(rest)
        return MG400(host or DEFAULT_HOSTS["LAN1"], ports=Mg400Ports().shift_ports(offset), lenient=kind == "mg400-lenient")
    if kind == "magician":
        return Magician(rest or attached_port())
    if kind == "ros2":
        return ros2_arm(rest)
    if kind == "ur" and rest:
        return UR(rest)
    there = others("arms", KINDS)
    if kind in there:
        arm: Arm = there[kind](rest)
        return arm
    raise DeviceError(f"no arm '{quote(spec)}'; there are: {', '.join((ARM_SPECS, *there))}")


def kind_of(spec: str) -> str:
    """The kind of an arm by its specification: ``mg400``, ``magician``, ``ros2``, ``ur`` or ``simulated``."""
    return spec.partition(":")[0].removesuffix("-lenient")
