"""Ports of an emulated device: each client is served in a thread of its own, and all connections can be lost at once."""

import contextlib
import socket
import socketserver
import struct
from collections.abc import Callable
from threading import Thread

CHECK_S = 0.05
"""Interval, s, at which a port checks whether it was closed."""


class PortServer(socketserver.ThreadingTCPServer):
    """A bound port, which serves clients from the start.

    Parameters
    ----------
    address : (str, int)
    serve : callable
        Serves a client until it has gone. Then, and if it fails, the client is hung up on.
    deaf : bool
        Whether the port takes no clients. It is bound nevertheless, so that nobody else listens there.

    Attributes
    ----------
    clients : set of socket
        The clients that are served.

    Raises
    ------
    OSError
        The port is taken, or the address is not this machine's.
    """

    allow_reuse_address = daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], serve: Callable[[socket.socket], None], *, deaf: bool = False) -> None:
        super().__init__(address, socketserver.BaseRequestHandler, bind_and_activate=False)
        self.clients: set[socket.socket] = set()
        self._serve, self._deaf = serve, deaf
        try:
            self.server_bind()
        except OSError:
            self.server_close()
            raise
        if not deaf:
            self.server_activate()
            Thread(target=self.serve_forever, args=(CHECK_S,), daemon=True, name="emulated port").start()

    def process_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Begin to serve a client."""
        self.clients.add(request)
        super().process_request(request, client_address)

    def finish_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        """Serve a client, in its thread."""
        with contextlib.suppress(OSError, ValueError, struct.error):
            request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._serve(request)

    def shutdown_request(self, request: socket.socket) -> None:  # type: ignore[override]
        """Hang up on a client."""
        self.clients.discard(request)
        super().shutdown_request(request)

    def lose(self, *, abruptly: bool = False) -> None:
        """Lose every connection and take no more; ``abruptly``: they are reset, as after a power loss."""
        if not self._deaf:
            self.shutdown()
        self.server_close()
        for client in self.clients.copy():
            with contextlib.suppress(OSError):
                if abruptly:
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    client.close()
                else:
                    client.shutdown(socket.SHUT_RDWR)
