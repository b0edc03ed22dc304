"""The page to watch a trial on: one file, nothing fetched from elsewhere, server-sent events, 127.0.0.1."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Iterable
from importlib.resources import files
from types import TracebackType
from typing import Any, Self

from tiptrace.errors import MissingExtraError, OutputError
from tiptrace.snapshot import Snapshot
from tiptrace.viewers.page_data import Row, path_row, state

_PERIOD_S = 0.08  # pictures and numbers at 12 Hz are smooth enough
_START_S = 10.0
_MAX_ROWS = 100_000


class PageServer:
    """Serves the page from a thread of its own; :meth:`show` only keeps the snapshot and returns at once.

    Args:
        host: Address to listen on; another than this machine's own only if the user asks for it.
        port: 0 takes a free one.
        title: Heading, for example the recording's name; it is data and never markup.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8321, title: str = "tiptrace") -> None:
        self.host, self.title = host, title
        self._port = port
        self._lock = threading.Lock()
        self._latest: Snapshot | None = None
        self._version = 0
        self._start_ns: int | None = None
        self._path: list[Row] = []
        self._server: Any = None
        self._thread: threading.Thread | None = None
        self._socket: socket.socket | None = None

    @property
    def url(self) -> str:
        """Address for a browser."""
        host = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host
        return f"http://[{host}]:{self._port}/" if ":" in host else f"http://{host}:{self._port}/"

    def show(self, snapshot: Snapshot) -> None:
        """Show a pair to whoever watches."""
        with self._lock:
            if self._start_ns is None:
                self._start_ns = snapshot.estimate.stamp_ns
            self._path.append(path_row(snapshot, self._start_ns))
            if len(self._path) > _MAX_ROWS:
                self._path = self._path[::2]
            self._latest = snapshot
            self._version += 1

    def __enter__(self) -> Self:
        """Listen.

        Raises:
            OutputError: the port is taken, or the address is not this machine's.
            MissingExtraError: the web server is not installed.
        """
        try:
            import uvicorn
        except ImportError:
            raise MissingExtraError("uvicorn", "serve") from None
        family = socket.AF_INET6 if ":" in self.host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind((self.host, self._port))
        except (OSError, UnicodeError) as error:  # a name that can be none is a UnicodeError
            self._socket.close()
            why = getattr(error, "strerror", None) or "no such name"
            raise OutputError(
                f"page: cannot listen on {self.host}:{self._port} ({why}); "
                "give another address, such as 127.0.0.1:8322"
            ) from None
        self._port = int(self._socket.getsockname()[1])
        config = uvicorn.Config(
            self._application(), log_level="error", lifespan="off", timeout_graceful_shutdown=1
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="page", daemon=True
        )
        self._thread.start()
        deadline = time.monotonic() + _START_S
        while not self._server.started and self._thread.is_alive() and time.monotonic() < deadline:
            time.sleep(0.01)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop listening."""
        self._server.should_exit = True
        assert self._thread is not None
        assert self._socket is not None
        self._thread.join(timeout=3.0)
        self._socket.close()

    # --- the application -----------------------------------------------------------------------------------

    def _application(self) -> Any:
        from starlette.applications import Starlette
        from starlette.requests import Request
        from starlette.responses import HTMLResponse, PlainTextResponse, Response, StreamingResponse
        from starlette.routing import Route

        page = (files("tiptrace") / "viewers" / "page.html").read_text(encoding="utf-8")

        async def home(request: Request) -> Response:
            if not host_is_ours(request.headers.get("host", ""), self.host):
                return PlainTextResponse("this page answers to its own address only", 421)
            nonce = secrets.token_urlsafe(16)
            return HTMLResponse(page.replace("NONCE", nonce), headers=_headers(nonce))

        async def stream(request: Request) -> Response:
            if not host_is_ours(request.headers.get("host", ""), self.host):
                return PlainTextResponse("this page answers to its own address only", 421)
            return StreamingResponse(
                self._messages(), media_type="text/event-stream", headers={"cache-control": "no-store"}
            )

        return Starlette(routes=[Route("/", home), Route("/stream", stream)])

    async def _messages(self) -> AsyncIterator[str]:
        """What one browser is sent: everything so far, then what is new."""
        rows, version, first, idle = 0, -1, True, 0.0
        while not self._server.should_exit:
            with self._lock:
                latest, now, start_ns = self._latest, self._version, self._start_ns
                thinned = len(self._path) < rows
                path = self._path[:] if thinned else self._path[rows:]
                rows = len(self._path)
            if now != version or first:
                message: dict[str, Any] = {"path": path}
                if first or thinned:
                    message |= {"title": self.title, "first": True}
                if latest is not None and start_ns is not None:
                    message |= state(latest, start_ns)
                yield f"data: {json.dumps(message, allow_nan=False)}\n\n"
                version, first, idle = now, False, 0.0
            elif idle > 5.0:
                yield ": still here\n\n"
                idle = 0.0
            idle += _PERIOD_S
            await asyncio.sleep(_PERIOD_S)


def serve(
    snapshots: Iterable[Snapshot], host: str = "127.0.0.1", port: int = 8321, title: str = "tiptrace"
) -> None:
    """Serve the page while snapshots come.

    Raises:
        OutputError: the port is taken.
        MissingExtraError: the web server is not installed.
    """
    with PageServer(host, port, title) as page:
        for snapshot in snapshots:
            page.show(snapshot)


def host_is_ours(header: str, listening: str) -> bool:
    """Whether a request names the address that it was meant for.

    A page elsewhere may point a name of its own at 127.0.0.1 and so read what is served here (DNS rebinding): then
    the Host header carries that name. Names are refused but ``localhost`` and the one given; addresses only pass
    where the server was told to listen on them.
    """
    name = header.rsplit(":", 1)[0] if not header.endswith("]") else header
    name = name.strip("[]").lower()
    if name in ("localhost", "127.0.0.1", "::1", listening.lower()):
        return True
    if listening not in ("0.0.0.0", "::"):
        return False
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name == socket.gethostname().lower()
    return True


def _headers(nonce: str) -> dict[str, str]:
    policy = (
        f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return {
        "content-security-policy": policy,
        "x-content-type-options": "nosniff",
        "referrer-policy": "no-referrer",
        "cache-control": "no-store",
    }
