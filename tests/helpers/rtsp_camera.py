"""A small RTSP server (RFC 2326) with JPEG over RTP (RFC 2435) inside the same connection, as IP cameras have it."""

import socketserver
import struct
import threading
import time
from contextlib import contextmanager, suppress

import cv2
import numpy as np

SIZE = (64, 48)
CHUNK = 1000


def payloads(number: int):
    """The RTP payloads of a noisy colour picture, and whether each is its last one."""
    image = np.random.default_rng(number).integers(40, 220, (SIZE[1], SIZE[0], 3), np.uint8)
    flags = [cv2.IMWRITE_JPEG_QUALITY, 80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    data = cv2.imencode(".jpg", image, flags)[1].tobytes()
    tables, at = b"", 2
    while data[at + 1] != 0xDA:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xDB:
            tables += data[at + 5 : at + 2 + length]
        at += 2 + length
    scan = data[at + 2 + int.from_bytes(data[at + 2 : at + 4], "big") : -2]
    for begin in range(0, len(scan), CHUNK):
        head = struct.pack(">I", begin) + bytes([1, 255, SIZE[0] // 8, SIZE[1] // 8])
        head += struct.pack(">BBH", 0, 0, len(tables)) + tables if not begin else b""
        yield head + scan[begin : begin + CHUNK], begin + CHUNK >= len(scan)


class Handler(socketserver.StreamRequestHandler):
    def handle(self):
        with suppress(OSError, ValueError):
            while True:
                method, _, number = self.request_of()
                body, more = "", ""
                if method == "OPTIONS":
                    more = "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN\r\n"
                elif method == "DESCRIBE":
                    body = "v=0\r\no=- 1 1 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\nm=video 0 RTP/AVP 26\r\na=control:track1\r\n"
                    more = f"Content-Type: application/sdp\r\nContent-Length: {len(body)}\r\n"
                elif method == "SETUP":
                    more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 7\r\n"
                elif method == "PLAY":
                    more = "Session: 7\r\n"
                self.wfile.write(f"RTSP/1.0 200 OK\r\nCSeq: {number}\r\n{more}\r\n{body}".encode())
                if method == "PLAY":
                    self.play()

    def request_of(self):
        """Method, address and number of the next request."""
        first = self.rfile.readline().decode().split()
        headers = {}
        while line := self.rfile.readline().decode().strip():
            name, _, value = line.partition(":")
            headers[name.lower()] = value.strip()
        return first[0], first[1], headers["cseq"]

    def play(self):
        sequence = 0
        for picture in range(10**6):
            for payload, last in payloads(picture):
                packet = struct.pack(">BBHII", 0x80, 26 | (0x80 if last else 0), sequence % 65536, picture * 3000, 1) + payload
                self.wfile.write(b"$\0" + struct.pack(">H", len(packet)) + packet)
                sequence += 1
            time.sleep(1 / 30)


@contextmanager
def rtsp_camera():
    """The address of a server."""
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        yield f"rtsp://admin:s3cret@127.0.0.1:{server.server_address[1]}/live"
        server.shutdown()
