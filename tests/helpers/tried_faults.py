"""Which faults a parametrised test tries."""


def tried_in(test, *more: str) -> set[str]:
    """Names of the faults in the first parameter of each case of ``test``, and of ``more`` (``NAME`` or ``NAME=VALUE``)."""
    mark = test.pytestmark[0]
    return {fault.split("=")[0] for case in mark.args[1] for fault in case[0]} | {fault.split("=")[0] for fault in more}
