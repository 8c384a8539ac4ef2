"""Starts the application on a socket and ends it in order."""

import asyncio
import contextlib
import socket
from typing import Any, TextIO

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from cosim.errors import BadInput
from cosim.files import cannot
from cosim.service.app import create
from cosim.service.confined import lacking
from cosim.service.monitor import log_json
from cosim.service.settings import TOKEN, DataFolder, Settings

MESSAGE = 4096  # bytes of a page's request over the WebSocket
KEEP_ALIVE = 120  # s: a driver may think for a while between two decisions
HEAD, HEAD_TIME = 1 << 16, 30.0  # bytes, s


class Bounded(HttpToolsProtocol):
    """A request's head has at most `HEAD` bytes and `HEAD_TIME` s; then the connection is closed."""

    _left = HEAD
    _timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the timer of the first head."""
        super().connection_made(transport)
        self._expect()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._arrived()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Count the bytes of a head."""
        super().data_received(data)
        if self._timer is not None:
            self._left -= len(data)
            if self._left < 0:
                self.transport.close()

    def on_message_begin(self) -> None:
        """Called by the parser when a head begins."""
        super().on_message_begin()
        self._expect()

    def on_headers_complete(self) -> None:
        """Called by the parser when a head is complete."""
        self._arrived()
        super().on_headers_complete()

    def _expect(self) -> None:
        self._arrived()
        self._left = HEAD
        self._timer = self.loop.call_later(HEAD_TIME, self.transport.close)

    def _arrived(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def serve(data: str, *, host: str, port: int, said: TextIO, **settings: Any) -> int:
    """Serve until Ctrl-C or SIGTERM; prints the address on `said` before.

    Raises BadInput: folder, database or address cannot be used.
    """
    with DataFolder(data) as folder:
        token, file = folder.token(host)
        listening = _bind(host, port)
        with listening:
            port = listening.getsockname()[1]
            app = create(Settings(folder.path, host=host, port=port, token=token, **settings))
            log_json()
            shown = f"[{host}]" if ":" in host else host
            asks = (
                "no token is needed"
                if token is None
                else f"the token is in {file or 'the variable ' + TOKEN}"
            )
            if problem := lacking():
                print(f"cosim: no uploads are accepted: {problem}", file=said, flush=True)
            print(f"cosim: http://{shown}:{port} ({asks})", file=said, flush=True)
            config = uvicorn.Config(
                app,
                http=Bounded,
                log_config=None,
                access_log=False,
                server_header=False,
                timeout_keep_alive=KEEP_ALIVE,
                timeout_graceful_shutdown=5,
                ws_max_size=MESSAGE,
            )
            with contextlib.suppress(KeyboardInterrupt):  # raised again by uvicorn after the shutdown
                uvicorn.Server(config).run(sockets=[listening])
    return 0


def _bind(host: str, port: int) -> socket.socket:
    """The listening socket. Raises BadInput for an unknown address, or an address in use."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    except OSError as error:
        raise BadInput(f"no such address: {error.strerror}", field="--host", value=host) from None
    # asyncio sets TCP_NODELAY only for a named protocol; otherwise an answer's body is delayed by 40 ms
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        with cannot("listen there", field="--port", value=port):
            listening.bind((host, port))
            listening.listen(128)
    except BaseException:
        listening.close()
        raise
    return listening
