"""MJPEG over HTTP: ``multipart/x-mixed-replace``, read part by part."""

from __future__ import annotations

import contextlib
import http.client
import socket
from urllib.parse import urlsplit

from tiptrace.drivers.camera import RawFrame, SourceLostError
from tiptrace.drivers.timeline import NS, ClockMap, Timeline
from tiptrace.errors import DeviceError

_CONNECT_S = 1.5
_SILENCE_S = 1.0
_MAX_PART = 16 * 1024 * 1024
_MAX_HEADERS = 50


class MjpegSource:
    """Frames of an MJPEG server.

    A frame is stamped by the part's ``X-Timestamp`` header (seconds on the server's clock, as mjpg-streamer sends it),
    brought to our timeline by the least delay; without one, by the arrival of the part's first line.

    Args:
        url: ``http://HOST:PORT/PATH``.
        timeline: The session's.
    """

    def __init__(self, url: str, timeline: Timeline) -> None:
        self.name = url
        self._timeline = timeline
        try:
            self._url = urlsplit(url)
        except ValueError:  # brackets that enclose no address
            self._url = urlsplit("")
        if self._url.scheme not in ("http", "https") or not self._url.hostname:
            raise DeviceError(f"{url}: is no address of a camera; expected http://HOST:PORT/PATH")
        self._connection: http.client.HTTPConnection | None = None
        self._response: http.client.HTTPResponse | None = None
        self._boundary = b""
        self._clock = ClockMap()

    def connect(self) -> None:
        """Ask for the stream.

        Raises:
            DeviceError: refused, or not an MJPEG stream.
        """
        url = self._url
        kind = http.client.HTTPSConnection if url.scheme == "https" else http.client.HTTPConnection
        try:
            connection = kind(url.hostname or "", url.port, timeout=_CONNECT_S)
            self._connection = connection
            connection.request("GET", (url.path or "/") + (f"?{url.query}" if url.query else ""))
            response = connection.getresponse()
            if connection.sock is not None:
                connection.sock.settimeout(_SILENCE_S)
        except (OSError, http.client.HTTPException, ValueError) as error:
            self.disconnect()
            raise DeviceError(
                f"{self.name}: cannot be reached ({_why(error)}): check the address, and that the camera's server runs"
            ) from None
        kind_of = response.getheader("Content-Type", "")
        if response.status != 200 or "multipart" not in kind_of.lower():
            self.disconnect()
            raise DeviceError(
                f"{self.name}: is no MJPEG stream (answer {response.status}, {kind_of or 'no type'}): give the "
                "address of the stream, such as http://HOST:8080/?action=stream"
            )
        boundary = response.headers.get_boundary("") or ""
        self._boundary = boundary.lstrip("-").encode("latin-1", "replace")
        self._response = response
        self._clock = ClockMap()

    def read(self) -> RawFrame:
        """The next part.

        Raises:
            SourceLostError: disconnected, silent for a second, or bytes that are no parts.
        """
        if self._response is None:
            raise SourceLostError(f"{self.name}: not connected")
        try:
            first_ns, headers = self._headers(self._response)
            jpeg = self._body(self._response, headers)
        except TimeoutError:
            raise SourceLostError(f"{self.name}: silent for {_SILENCE_S:g} s") from None
        except (OSError, http.client.HTTPException, ValueError, AttributeError) as error:
            raise SourceLostError(f"{self.name}: disconnected ({_why(error)})") from None
        arrived_ns = self._timeline.now_ns()
        stamp_ns, settled = self._stamp(headers, first_ns)
        return RawFrame(stamp_ns, arrived_ns, jpeg=jpeg, settled=settled)

    def abort(self) -> None:
        """Close the socket under a read."""
        connection = self._connection
        if connection is not None and connection.sock is not None:
            with contextlib.suppress(OSError):
                connection.sock.shutdown(socket.SHUT_RDWR)

    def disconnect(self) -> None:
        """Close."""
        if self._response is not None:
            with contextlib.suppress(OSError):
                self._response.close()
        if self._connection is not None:
            self._connection.close()
        self._response = self._connection = None

    # --- parts ---------------------------------------------------------------------------------------------

    def _headers(self, response: http.client.HTTPResponse) -> tuple[int, dict[bytes, bytes]]:
        """Arrival of the part's first line, and its headers."""
        skipped = 0
        while True:
            line = _line(response)
            name = line.strip().lstrip(
                b"-"
            )  # some servers count the delimiter's own hyphens among the name's
            if line.startswith(b"--") and name.startswith(self._boundary):
                break
            skipped += len(line)
            if skipped > _MAX_PART:
                raise ValueError("no boundary between images")
        if name == self._boundary + b"--":
            raise ConnectionError("the server ended the stream")
        first_ns = self._timeline.now_ns()
        headers: dict[bytes, bytes] = {}
        for _ in range(_MAX_HEADERS):
            line = _line(response).strip()
            if not line:
                return first_ns, headers
            key, _, value = line.partition(b":")
            headers[key.strip().lower()] = value.strip()
        raise ValueError("an image without end of headers")

    def _body(self, response: http.client.HTTPResponse, headers: dict[bytes, bytes]) -> bytes:
        """Bytes of the part: by its length, or up to the next boundary."""
        if b"content-length" in headers:
            length = int(headers[b"content-length"])
            if not 0 <= length <= _MAX_PART:
                raise ValueError(f"an image of {length} bytes")
            data = response.read(length)
            if len(data) < length:
                raise ConnectionError("cut off in an image")
            return data
        data = b""
        while len(data) < _MAX_PART:
            end = data.find(b"\xff\xd9")
            if end >= 0:
                return data[: end + 2]  # an entropy-coded scan never holds these two bytes
            data += _line(response)
        raise ValueError("an image without end")

    def _stamp(self, headers: dict[bytes, bytes], first_ns: int) -> tuple[int, bool]:
        """Capture on our timeline, and whether the server's clock is known well enough by now."""
        try:
            device_ns = round(float(headers[b"x-timestamp"]) * NS)
        except (KeyError, ValueError, OverflowError):
            return first_ns, True
        return self._clock.stamp_ns(device_ns, first_ns), self._clock.settled


def _line(response: http.client.HTTPResponse) -> bytes:
    line = response.readline(65536)
    if not line:
        raise ConnectionError("the server closed the connection")
    return line


def _why(error: BaseException) -> str:
    return getattr(error, "strerror", None) or (str(error).splitlines() or [""])[0] or type(error).__name__
