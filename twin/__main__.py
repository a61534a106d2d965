"""The program ``twin``, also as ``python -m twin``. It handles signals first, because the command line takes a while to import."""

import gc

from twin.signals import end_interrupted, end_on_sigterm


def main() -> None:
    """Run the command line (``twin.cli.main``)."""
    end_on_sigterm()
    gc.set_threshold(20_000)  # compilers make many objects that stay: a tenth of a first start was a search among them
    try:
        from twin.cli import main as run
    except KeyboardInterrupt as interrupt:
        end_interrupted(interrupt)
    run()


if __name__ == "__main__":
    main()
