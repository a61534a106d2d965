"""What made a result, as a small record that every output carries."""

from datetime import UTC, datetime
from importlib import metadata

from twin.store.fingerprint import Maker, fingerprint, name_of
from twin.store.inputs import inputs_digest

PROGRAM = "tactip-twin"


def made_by(*by: Maker, inputs: object = None, dated: bool = True) -> dict[str, str]:
    """The record of a result.

    Parameters
    ----------
    by : functions, classes or names of modules
        What made it, the first one above all.
    inputs : object, optional
        What it was made of, as ``inputs_digest`` takes it.
    dated : bool
        Whether it tells when: not where the same work is to leave the same bytes.

    Returns
    -------
    dict of str to str
        ``by`` (name), ``version`` (of the program), ``code`` (fingerprint), ``inputs`` (digest, where there are any) and ``date``
        (UTC).
    """
    record = {"by": name_of(by[0]), "version": program_version(), "code": fingerprint(*by)}
    if inputs is not None:
        record["inputs"] = inputs_digest(inputs)
    return record | ({"date": datetime.now(UTC).isoformat(timespec="seconds")} if dated else {})


def program_version() -> str:
    """Version of this program; what it says of itself where it isn't installed."""
    try:
        return metadata.version(PROGRAM)
    except metadata.PackageNotFoundError:
        return "not installed"
