"""``twin doctor``: what is there, what is missing, and the remedy."""

from twin.cli import app


@app.command("doctor")
def doctor() -> None:
    """Say what is there and what is missing, with the remedy.

    Covers Mitsuba's variants and which one will be used and why, LLVM, GPU, offscreen 3D, camera and serial devices. Exit
    code 1 if nothing can be rendered on this machine.
    """
    from hardware.doctor import examine_machine
    from twin.cli.output import say

    machine = examine_machine()
    say(machine.lines())
    if not machine.can_render:
        raise SystemExit(1)
