"""A server that answers one JSON object a line; what holds the board, and what switches faults, speak it."""

import json
import socketserver
import threading
from collections.abc import Callable
from typing import Any

from cotarget.errors import CotargetError, DeviceError

LONGEST_LINE = 65536  # bytes
HEARTBEAT = 0.1  # between looks whether the server shall end [s]


class JsonLines:
    """Serves any number of clients, each on a thread of its own. A context manager.

    Args:
        answer: what to say to an object; a `CotargetError`, and what a wrong object raises, becomes {"error": ...}.
        host: to listen at.
        port: to listen at; 0 for any that is free.

    Raises:
        DeviceError: the port cannot be had.
    """

    def __init__(self, answer: Callable[[Any], Any], host: str = "127.0.0.1", port: int = 0) -> None:
        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                while line := self.rfile.readline(LONGEST_LINE):
                    self.wfile.write(json.dumps(_answered(answer, line)).encode() + b"\n")

        try:
            self._server = _Server((host, port), Handler)
        except OSError as error:
            raise DeviceError(f"cannot listen at {host}:{port}: {error.strerror or error}") from None
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(HEARTBEAT,), name=f"JSON lines {self.port}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening and hang up; more than once does no harm."""
        self._server.shutdown()
        self._server.hang_up()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> "JsonLines":
        """Give the server itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()


class _Server(socketserver.ThreadingTCPServer):
    """Remembers its clients, so that it can hang up on them."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, *arguments: Any) -> None:
        self._clients: set[Any] = set()
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Remember the client."""
        self._clients.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Forget the client."""
        self._clients.discard(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that is gone is no error."""

    def hang_up(self) -> None:
        """End every conversation."""
        for request in list(self._clients):
            self.shutdown_request(request)


def _answered(answer: Callable[[Any], Any], line: bytes) -> Any:
    try:
        return answer(json.loads(line))
    except CotargetError as error:
        return {"error": str(error)}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return {"error": f"not understood: {type(error).__name__}: {error}"}
