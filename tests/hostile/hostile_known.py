"""What is wrong now: a part of what the test of an entry reports, and the names of the entries. Each repair removes its lines."""

WRONG: dict[str, tuple[str, ...]] = {}
TOGETHER: tuple[str, ...] = ()  # both run in one folder and write over each other
KNOWN = {name: wrong for wrong, names in WRONG.items() for name in names} | dict.fromkeys(TOGETHER, "both ended well")
