"""What is wrong now: a part of what the test of an entry reports, and the names of the entries. Each mend removes its lines."""

WRONG: dict[str, tuple[str, ...]] = {
    "lines of error": (
        "audit, outputs: a full disk",
        "train, outputs: a full disk",
        "evaluate, outputs: a full disk",
        "study tac-vgnn, outputs: a full disk",
    ),
    "touched": (
        "evaluate, outputs: files of the user's own",
        "audit, outputs: files of the user's own",
        "preprocess, outputs: files of the user's own",
        "graph, outputs: files of the user's own",
        "tune, outputs: files of the user's own",
        "study tac-vgnn, outputs: files of the user's own",
        "tune, outputs: its own specification",
    ),
    "traceback: FileExistsError": (
        "train, outputs: a file",
        "train, outputs: a named pipe",
        "train, outputs: a link to nowhere",
        "calibrate optics, outputs: a link to nowhere",
        "calibrate contact, outputs: a link to nowhere",
        "live, outputs: a link to nowhere",
    ),
    "traceback: FileNotFoundError": (
        "train, outputs: where nothing can be made",
        "calibrate optics, outputs: where nothing can be made",
        "calibrate contact, outputs: where nothing can be made",
        "live, outputs: where nothing can be made",
    ),
    "traceback: NotADirectoryError": (
        "train, outputs: below a file",
        "calibrate optics, outputs: a file",
        "calibrate optics, outputs: below a file",
        "calibrate optics, outputs: a named pipe",
        "calibrate contact, outputs: a file",
        "calibrate contact, outputs: below a file",
        "calibrate contact, outputs: a named pipe",
        "live, outputs: a file",
        "live, outputs: below a file",
        "live, outputs: a named pipe",
    ),
    "traceback: OSError": (
        "train, outputs: a name too long",
        "graph, outputs: a full disk",
        "dataset, outputs: a name too long",
        "calibrate optics, outputs: a name too long",
        "calibrate contact, outputs: a name too long",
        "live, outputs: a name too long",
    ),
}
TOGETHER: tuple[str, ...] = ("train, two at once", "preprocess, two at once")  # both run in one folder and write over each other
KNOWN = {name: wrong for wrong, names in WRONG.items() for name in names} | dict.fromkeys(TOGETHER, "both ended well")
