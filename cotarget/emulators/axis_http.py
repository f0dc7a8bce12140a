"""Requests read and replies written: as much HTTP/1.0 as an Axis video server speaks. Bytes in, bytes out."""

import http.client
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from email.message import Message
from http import HTTPStatus
from typing import BinaryIO
from urllib.parse import parse_qsl, urlsplit

# Longest request line, largest body [bytes] and most arguments; beyond them a client is not one that we serve.
LINE_BYTES = 8192
BODY_BYTES = 65536
MAX_ARGUMENTS = 64
# How clients call a form that they send; PyPI's axis calls it plain text, and real units take it.
FORMS = ("application/x-www-form-urlencoded", "text/plain")


class HttpError(Exception):
    """A request that is answered by a status instead of what it asks for.

    Attributes:
        status: of the answer.
        headers: its further header lines.
    """

    def __init__(self, status: HTTPStatus, headers: Iterable[str] = ()) -> None:
        super().__init__(status.phrase)
        self.status = status
        self.headers = tuple(headers)


@dataclass(frozen=True)
class Request:
    """One request.

    Attributes:
        method: such as "GET".
        target: as it stands in the request line, with the arguments.
        path: of the target, without the arguments.
        arguments: of the target and of a form in the body; the last of a name counts.
        headers: case does not matter in their names.
    """

    method: str
    target: str
    path: str
    arguments: Mapping[str, str]
    headers: Message


def read_request(stream: BinaryIO) -> Request | None:
    """Read one request; None where the client closed without one.

    Raises:
        HttpError: it is no request that can be understood.
        OSError: the connection broke.
    """
    line = stream.readline(LINE_BYTES)
    if not line:
        return None
    words = line.decode("latin-1").split()
    if len(words) != 3 or not words[2].startswith("HTTP/1.") or not line.endswith(b"\n"):
        raise HttpError(HTTPStatus.BAD_REQUEST)
    try:
        headers: Message = http.client.parse_headers(stream)
        url = urlsplit(words[1])
        pairs = parse_qsl(url.query, keep_blank_values=True, max_num_fields=MAX_ARGUMENTS)
        pairs += _form(headers, stream)
    except (http.client.HTTPException, ValueError):
        raise HttpError(HTTPStatus.BAD_REQUEST) from None
    return Request(words[0], words[1], url.path, dict(pairs), headers)


def _form(headers: Message, stream: BinaryIO) -> list[tuple[str, str]]:
    # The body is read even where it is not used: closing a socket with bytes unread may lose the answer on its way.
    length = int(headers.get("Content-Length", "0"))
    if not 0 <= length <= BODY_BYTES:
        raise ValueError
    body = stream.read(length)
    if len(body) < length:
        raise ValueError
    if headers.get_content_type() not in FORMS:
        return []
    return parse_qsl(body.decode("latin-1"), keep_blank_values=True, max_num_fields=MAX_ARGUMENTS)


def reply_head(status: HTTPStatus, headers: Iterable[str] = ()) -> bytes:
    """Status line, headers and the empty line."""
    lines = [f"HTTP/1.0 {status.value} {status.phrase}", *headers, "", ""]
    return "\r\n".join(lines).encode("latin-1")


def text_reply(text: str) -> bytes:
    """An answer in plain text; as in the manual its end is the connection's."""
    return reply_head(HTTPStatus.OK, ["Content-Type: text/plain"]) + text.encode("latin-1", "replace")


def error_reply(error: HttpError) -> bytes:
    """The answer to a request that is refused: a page that says its status."""
    body = f"<HTML><BODY><H1>{error.status.value} {error.status.phrase}</H1></BODY></HTML>\r\n".encode("latin-1")
    headers = [*error.headers, "Content-Type: text/html", f"Content-Length: {len(body)}"]
    return reply_head(error.status, headers) + body
