"""A process that stops a device when the program that moves it dies, as by SIGKILL.

`Guardian` starts it with a pipe. The program writes what stops the device: addresses, and the bytes to send there. The
pipe ends when the program does, whatever ended it; then the process sends the last of these by connections of its own.
A program that ends as it should takes the orders back first.

The process is this file, run by itself: it imports only what little it needs, so that it is there in 30 ms and holds no
more than the device's stop. The login is part of it where the device asks for HTTP digest: a device that takes each
nonce once refuses a stop that was signed before.

Source of the digest: RFC 7616.
"""

import contextlib
import hashlib
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple


class StopOrder(NamedTuple):
    """What is sent to stop a device.

    Attributes:
        is_udp: whether by UDP; else by TCP.
        host: of the device.
        port: of the device.
        messages: in Latin-1.
        login: user and password, where the message is an HTTP request that may be signed; else empty.
    """

    is_udp: bool
    host: str
    port: int
    messages: Sequence[str]
    login: Sequence[str] = ()


SEND_S = 0.5  # for a connection, and for its answer [s]
TRIES, PAUSE_S = 3, 0.05  # how often all orders are sent, and the time between datagrams [s]
LONGEST = 1 << 16  # bytes of a pipe: more cannot be written at once


class Guardian:
    """A process that sends orders if this program dies.

    Attributes:
        pid: number of the process.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self) -> None:
        reads, self._pipe = os.pipe()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", __file__],
                stdin=reads,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C and the end of a terminal are the program's own
            )
        except OSError:
            os.close(self._pipe)
            raise
        finally:
            os.close(reads)
        self.pid = self._process.pid
        os.set_blocking(self._pipe, False)  # a process that is suspended must not hold up the head
        self._held = list[StopOrder]()
        self._is_closed = False

    def hold(self, orders: list[StopOrder]) -> None:
        """Replace what is sent if this program dies; nothing for a device that stands.

        Raises:
            OSError: the process has ended, or does not listen; it then sends nothing any more.
        """
        if self._is_closed or orders == self._held == []:
            return
        line = json.dumps(orders).encode() + b"\n"
        try:
            written = os.write(self._pipe, line)
        except OSError:
            written = -1
        if written < len(line):
            self._end()
            raise OSError("the process that would stop it has ended or was suspended")
        self._held = orders

    def close(self) -> None:
        """Take the orders back, and end the process; never raises, and may be called again."""
        with contextlib.suppress(OSError):
            self.hold([])
        if not self._is_closed:
            self._end()

    def _end(self) -> None:
        self._is_closed = True
        if self._held:  # it could not be told
            self._process.kill()
        os.close(self._pipe)
        self._process.wait()


def watch(pipe: int) -> None:
    """Read orders until the pipe ends, then send the last whole ones."""
    rest, orders = b"", list[StopOrder]()
    while data := os.read(pipe, LONGEST):
        *lines, rest = (rest + data).split(b"\n")
        if lines:
            orders = json.loads(lines[-1])
    for _ in range(TRIES):
        orders = [order for order in orders if not send(*order)]


def send(is_udp: bool, host: str, port: int, messages: Sequence[str], login: Sequence[str] = ()) -> bool:
    """Send messages, one datagram each, or one after the other by TCP; return whether there was an answer.

    An HTTP request that is refused is sent once more, with a digest of the nonce in the refusal.
    """
    try:
        if is_udp:
            kind = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            with socket.socket(*kind[:2]) as line:
                for message in messages:
                    line.sendto(message.encode("latin-1"), kind[4])
                    time.sleep(PAUSE_S)
            return False  # a datagram may be lost
        message = "".join(messages)
        answer = ask(host, port, message, is_http=bool(login))
        if login and (signed := sign(message, answer, login)):
            answer = ask(host, port, signed, is_http=True)
        return bool(answer)
    except OSError:
        return False


def ask(host: str, port: int, message: str, *, is_http: bool) -> str:
    """Send a message by TCP; return what is answered first, of HTTP at least the header."""
    with socket.create_connection((host, port), SEND_S) as line:
        line.sendall(message.encode("latin-1"))
        answer = line.recv(LONGEST)
        while is_http and b"\r\n\r\n" not in answer and (more := line.recv(LONGEST)):
            answer += more
    return answer.decode("latin-1")


def sign(message: str, refusal: str, login: Sequence[str]) -> str | None:
    """Sign an HTTP request in Latin-1 as its refusal asks for; None if that asks for no digest."""
    challenge = re.search(r"(?im)^www-authenticate: *digest (.*)", refusal)
    if challenge is None or not re.match(r"HTTP/\S+ 401", refusal):
        return None
    asked = {name: quoted or bare for name, quoted, bare in re.findall(r'(\w+)=(?:"([^"]*)"|([^\s,]+))', challenge[1])}
    kind = "sha256" if asked.get("algorithm", "").upper() == "SHA-256" else "md5"

    def digest(*parts: str) -> str:
        return hashlib.new(kind, ":".join(parts).encode("latin-1"), usedforsecurity=False).hexdigest()

    user, password = (word.encode().decode("latin-1") for word in login)  # UTF-8 on the wire
    head, _, body = message.partition("\r\n\r\n")
    method, path, _ = head.split(" ", 2)
    realm, nonce = asked.get("realm", ""), asked.get("nonce", "")
    fields = {"username": user, "realm": realm, "nonce": nonce, "uri": path}
    once, more = [], ""
    if "qop" in asked:
        once = ["00000001", os.urandom(8).hex(), "auth"]
        more = f', qop=auth, nc={once[0]}, cnonce="{once[1]}"'
    fields["response"] = digest(digest(user, realm, password), nonce, *once, digest(method, path))
    if "opaque" in asked:
        fields["opaque"] = asked["opaque"]
    if "algorithm" in asked:
        more += f", algorithm={asked['algorithm']}"
    said = ", ".join(f'{name}="{field}"' for name, field in fields.items())
    lines = [line for line in head.split("\r\n") if not line.lower().startswith("authorization:")]
    return "\r\n".join([*lines, f"Authorization: Digest {said}{more}", "", body])


if __name__ == "__main__":
    watch(0)
