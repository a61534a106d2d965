"""What is wrong now, by the name of the entry: a part of what its test reports. Each mend removes its line."""

KNOWN: dict[str, str] = {}
