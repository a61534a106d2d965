"""``twin demo``: the main job on the shipped specifications."""

from pathlib import Path

from twin.cli import app
from twin.cli.options import Out, writable_folder


@app.command("demo")
def demo(out: Out = Path("out/demo")) -> None:
    """Press, render, detect, graph: two sensors and more, as pictures and one page (index.html)."""
    from twin.cli.output import say, tell
    from twin.cli.progress import shown
    from twin.demo.make_demo import run_demo

    with shown() as progress:
        made = run_demo(writable_folder(out), progress=progress)
    tell(made)
    say([f"open {out / 'index.html'} in a browser"])
