"""``twin doctor``: what is there, what is missing, and the remedy."""

import importlib.metadata
import platform
import sys

from twin.cli import app

PACKAGES = ("mitsuba", "drjit", "pyvista", "vtk", "trimesh", "torch", "scikit-image", "pyserial", "opencv-python-headless", "numba")


@app.command("doctor")
def doctor() -> None:
    """Say what is there and what is missing, with the remedy.

    Covers Mitsuba's variants and which one will be used and why, LLVM, GPU, offscreen 3D, camera and serial devices. Exit
    code 1 if nothing can be rendered on this machine.
    """
    print(f"Python      {platform.python_version()} ({sys.executable}) on {platform.system()} {platform.machine()}")
    for name in PACKAGES:
        try:
            print(f"{name:11} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            print(f"{name:11} MISSING; run 'make setup'")
    can_render = _rendering()
    _pictures()
    _devices()
    if not can_render:
        raise SystemExit(1)


def _rendering() -> bool:
    from twin.errors import RenderError
    from twin.optics.variant import report

    print("\nRendering (Mitsuba)")
    try:
        found = report()
    except RenderError as error:
        print(f"  NOT POSSIBLE: {error}")
        return False
    print(f"  variants installed: {', '.join(found['variants'])}")
    for channels, used in found["used"].items():
        print(f"  for {channels} cameras: {used['variant'] or 'NONE'} ({used['reason']})")
    llvm = found["llvm"]
    print(f"  LLVM: {llvm['version']} at {llvm['path']}" if llvm else f"  LLVM: none that works; {found['remedy']}")
    for rejected in found["llvm_rejected"]:
        print(f"    not used: {rejected['path']}: {rejected['reason']}")
    print(f"  GPU: {'yes' if found['gpu'] else 'none used'} ({found['gpu_reason']})")
    if found["override"]:
        print(f"  TACTIP_VARIANT={found['override']} is set")
    return any(used["variant"] for used in found["used"].values())


def _pictures() -> None:
    from twin.report.skin3d import probe_offscreen

    print("\n3D pictures (VTK offscreen)")
    reason = probe_offscreen()
    print(f"  {'works' if not reason else 'PLAIN ONLY: ' + reason}")


def _devices() -> None:
    from hardware.devices import cameras, serial_ports

    print("\nDevices")
    for kind, devices, remedy in (
        ("camera", cameras(), "plug in the sensor's USB camera; in a container pass --device /dev/video0"),
        ("serial", serial_ports(), "plug in the arm's USB cable; the user must be in the group 'dialout'"),
    ):
        for device in devices:
            print(f"  {kind}: {device.node} ({device.description})")
        if not devices:
            print(f"  {kind}: none found; {remedy}")
