"""Devices emulated on this machine, over real sockets and pseudo-terminals."""
