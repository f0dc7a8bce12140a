"""Serve the page on loopback, from a thread of its own, to browsers that have the link with the token.

The page moves a machine. So: a request must name this server as its Host, which a rebound name does not; a socket must
come from the page itself; its first message must hold the token within 2 s; and of sockets without it the oldest gives
way to a new one, so that nobody can lock the operator out. No GET changes anything. A browser gets the newest picture
after it has drawn the last, so that a slow one delays nobody. docs/page.md says what is protected against what.
"""

import asyncio
import errno
import hmac
import http
import ipaddress
import json
import logging
import re
import secrets
import socket
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic, time
from typing import Any

from cotarget.control.orders import MANUAL_S
from cotarget.errors import ConfigError, CotargetError, DeviceError
from cotarget.operate.session import Session
from cotarget.page.html import policy, render
from cotarget.page.messages import (
    MAX_BYTES,
    BadMessageError,
    Drawn,
    Follow,
    Hello,
    Incoming,
    Manual,
    Record,
    Simple,
    ToHead,
    Zoom,
    pack,
    parse,
)
from cotarget.pipeline import Step
from cotarget.rig import RigSpec

LOOPBACK = "127.0.0.1"
PORT = 8080
SOCKET = "/socket"  # path of the page's socket
HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9.-]+)(:\d{1,5})?")
TOKEN_BYTES = 16
HELLO_S = 2.0  # time for the first message, and for a request
MOST_STRANGERS = 32  # connections without the token
MOST_SENTENCES = 16  # that wait for a slow line
TICK_S = 0.1  # period of ticks
RATE_HZ, BURST = 60.0, 120.0  # messages of one browser: in the long run, and at once
REFUSED, ENDED, TOO_MUCH = 4401, 4410, 1008  # closing codes: without the token; with the run; against the rules
CLOSE_S = 1.0  # time for a closing handshake
PING_S = 2.0  # period of asking whether a browser is there, and time for its answer
LINE_S = 3.0  # time for the thread to start and to end


def listen(host: str, port: int) -> socket.socket:
    """Open a socket.

    Args:
        host: address to listen at.
        port: port number; 0 for any free one.

    Raises:
        ConfigError: the address stands for all addresses, whose names are not known.
        DeviceError: the address is not one of this machine, or the port is in use or not permitted.
    """
    try:
        family, kind, _, _, address = socket.getaddrinfo(host or "::", port, type=socket.SOCK_STREAM)[0]
    except UnicodeError:
        raise ConfigError(f"--page-host {host}: is no name of a machine") from None
    except OSError as error:
        raise DeviceError(f"--page-host {host}: {error.strerror}") from None
    if ipaddress.ip_address(address[0]).is_unspecified:
        raise ConfigError(f"--page-host {host or repr('')}: give the one name or address that browsers will use")
    listener = socket.socket(family, kind)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(address)
        listener.listen()  # listen now, before another program can take the port
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRNOTAVAIL:
            raise DeviceError(f"--page-host {host}: is no address of this machine; give one of its own") from None
        raise DeviceError(
            f"--page-port {port}: {error.strerror}; give another one, or 0 for any that is free"
        ) from None
    return listener


@dataclass(eq=False)
class Client:
    """A browser with the token.

    Attributes:
        socket: its connection.
        who: name that its page has chosen; only its equality counts.
        wake: set when there may be a picture to send.
        drawn: whether it has drawn the last picture.
        sentences: why orders were refused, until they are sent.
        allowance: messages that it may send now.
        counted_t: time of the last message [s].
    """

    socket: Any
    who: str
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    drawn: bool = True
    sentences: asyncio.Queue[str] = field(default_factory=lambda: asyncio.Queue(MOST_SENTENCES))
    allowance: float = BURST
    counted_t: float = field(default_factory=monotonic)

    def may_send(self) -> bool:
        """Count a message; return whether it is within the rate."""
        now = monotonic()
        self.allowance = min(self.allowance + RATE_HZ * (now - self.counted_t), BURST) - 1
        self.counted_t = now
        return self.allowance >= 0


class Page:
    """The page's server; a context manager whose thread ends with it.

    Args:
        session: the session that browsers steer.
        listener: socket to serve on, see `listen`; closed with the page.
        host: the name that it was given to listen at.

    Attributes:
        link: address of the page, with the token.
        token: what a browser has to know.
    """

    def __init__(self, session: Session, listener: socket.socket, host: str = LOOPBACK) -> None:
        self._session, self._listener = session, listener
        self._hosts = {"localhost", LOOPBACK, "[::1]", host.lower(), f"[{host.lower()}]"}
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        name = f"[{host}]" if ":" in host else host
        self.link = f"http://{name}:{listener.getsockname()[1]}/#{self.token}"
        self._html = render("page.html")
        self._clients: set[Client] = set()
        self._strangers: OrderedDict[Any, None] = OrderedDict()  # connections without the token, the oldest first
        self._ticks: OrderedDict[int, float] = OrderedDict()
        self._tick = 0
        self._newest: tuple[int, Step, RigSpec, int, float] | None = None
        self._packed: tuple[int, bytes] = (-1, b"")
        self._packing = asyncio.Lock()
        self._skipped = 0
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        # A stop never waits for a picture.
        self._packer, self._stopper = ThreadPoolExecutor(1, "page-pictures"), ThreadPoolExecutor(1, "page-stop")
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cotarget-page", daemon=True)

    def __enter__(self) -> "Page":
        """Start to serve.

        Raises:
            DeviceError: the server does not start.
        """
        self._thread.start()
        if not self._started.wait(LINE_S):
            raise DeviceError("the page's server does not start")
        return self

    def __exit__(self, *_: object) -> None:
        """End the server and its thread."""
        with suppress(RuntimeError):  # it has ended by itself
            self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(LINE_S)
        self._packer.shutdown(wait=False, cancel_futures=True)
        self._stopper.shutdown(wait=False)

    def show(self, step: Step, spec: RigSpec) -> None:
        """Show a step; called on the run's thread, and returns at once."""
        self._skipped += step.skipped
        self._newest = (step.index, step, spec, self._skipped, time())
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        for client in self._clients:
            client.wake.set()

    # The server's thread

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        from websockets.asyncio.server import ServerConnection, serve

        page = self

        class Connection(ServerConnection):
            """A connection that counts as a stranger's until it has shown the token."""

            def connection_made(self, transport: Any) -> None:
                super().connection_made(transport)
                page._admit(self)

            def connection_lost(self, error: Exception | None) -> None:
                page._strangers.pop(self, None)
                super().connection_lost(error)

        quiet = logging.getLogger("cotarget.page.sockets")
        quiet.disabled = True  # what strangers send is no message of ours
        async with serve(
            self._handle,
            sock=self._listener,
            create_connection=Connection,
            process_request=self._answer,
            compression=None,
            max_size=MAX_BYTES,
            max_queue=16,
            open_timeout=HELLO_S,
            close_timeout=CLOSE_S,
            ping_interval=PING_S,
            ping_timeout=PING_S,
            server_header=None,
            logger=quiet,
        ):
            ticking = asyncio.create_task(self._count_ticks())
            self._started.set()
            await self._ended.wait()
            ticking.cancel()
            ending = (client.socket.close(ENDED, "the run has ended") for client in list(self._clients))
            await asyncio.gather(*ending, return_exceptions=True)
            for stranger in list(self._strangers):  # a browser's spare connection would be awaited for `HELLO_S`
                stranger.transport.abort()

    def _admit(self, connection: Any) -> None:
        """Note a new connection; beyond the most of them, the oldest without the token is closed."""
        self._strangers[connection] = None
        if len(self._strangers) > MOST_STRANGERS:
            oldest, _ = self._strangers.popitem(last=False)
            oldest.transport.abort()

    async def _count_ticks(self) -> None:
        while True:
            self._tick += 1
            self._ticks[self._tick] = monotonic()
            if len(self._ticks) > MANUAL_S / TICK_S + 2:
                self._ticks.popitem(last=False)
            await asyncio.sleep(TICK_S)

    # Requests

    def _answer(self, connection: Any, request: Any) -> Any:
        """Answer a request: the page, or a refusal; None lets a socket open."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        found = HOST.fullmatch(hosts[0].lower()) if len(hosts) == 1 else None
        if found is None or found[1] not in self._hosts:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "This host is not known here.\n")
        host = found[0]
        if getattr(request, "method", "GET") != "GET":  # older versions of websockets refuse others themselves
            return connection.respond(http.HTTPStatus.METHOD_NOT_ALLOWED, "Only GET is answered.\n")
        if request.path == SOCKET:
            if len(origins) != 1 or origins[0].lower() not in (f"http://{host}", f"https://{host}"):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "Only the page itself may open this.\n")
            return None
        if request.path != "/":
            return connection.respond(http.HTTPStatus.NOT_FOUND, "There is only one page: /\n")
        # A policy has no addresses of IPv6; 'self' is the page's own socket too, but not in every browser.
        own = "'self'" if host.startswith("[") else f"ws://{host} wss://{host}"
        response = connection.respond(http.HTTPStatus.OK, self._html)
        del response.headers["Content-Type"]
        response.headers.update(
            {
                "Content-Type": "text/html; charset=utf-8",
                "Content-Security-Policy": f"{policy(self._html)}; connect-src {own}; frame-ancestors 'none'",
                "X-Content-Type-Options": "nosniff",
                "Referrer-Policy": "no-referrer",
                "Cache-Control": "no-store",
            }
        )
        return response

    # Sockets

    async def _handle(self, connection: Any) -> None:
        """Serve one socket from its first message to its end."""
        from websockets.exceptions import ConnectionClosed

        client = None
        with suppress(ConnectionClosed):
            client = await self._greet(connection)
            if client is None:
                await connection.close(REFUSED, "the link is not the newest")
                return
            self._clients.add(client)
            client.wake.set()  # the newest picture may be there already
            parts = self._listen, self._send_pictures, self._send_status, self._send_sentences
            tasks = [asyncio.create_task(part(client)) for part in parts]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)  # a page in parts would look alive
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                self._forget(client)

    async def _greet(self, connection: Any) -> Client | None:
        """Wait for the first message; None if it does not come in time or has not the token."""
        try:
            message = parse(await asyncio.wait_for(connection.recv(), HELLO_S))
        except (TimeoutError, BadMessageError):
            return None
        if not (isinstance(message, Hello) and self._is_token(message.token)):
            return None
        self._strangers.pop(connection, None)
        return Client(connection, message.who)

    def _is_token(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())

    async def _listen(self, client: Client) -> None:
        """Obey a browser's messages until its socket ends or it breaks the rules."""
        async for data in client.socket:
            try:
                message = parse(data)
            except BadMessageError as error:
                await client.socket.close(TOO_MUCH, str(error))
                return
            answers = isinstance(message, Drawn) and not client.drawn  # as often as there are pictures
            stops = isinstance(message, Simple) and message.do == "stop"
            if not (answers or stops or client.may_send()):
                await client.socket.close(TOO_MUCH, "too many messages")
                return
            try:
                await self._obey(client, message)
            except CotargetError as error:
                with suppress(asyncio.QueueFull):  # not sent from here: a stop does not wait for a slow line
                    client.sentences.put_nowait(str(error))

    async def _obey(self, client: Client, message: Incoming) -> None:
        """Carry out a message.

        Raises:
            CotargetError: what is asked for cannot be done; nothing moves.
        """
        session, who = self._session, client.who
        match message:
            case Drawn():
                client.drawn = True
                client.wake.set()
            case Simple(do="stop"):
                await self._loop.run_in_executor(self._stopper, session.stop, "stopped from the page")
            case Simple(do="clear"):
                session.clear(by=who)
            case Simple(do="take"):
                session.take(who)
            case Record():
                session.record(message.on, by=who)
            case ToHead(do="stand"):
                session.stand(message.of, by=who)
            case ToHead():
                session.home(message.of, by=who)
            case Follow():
                session.follow(message.of, message.click if message.track is None else message.track, by=who)
            case Manual() if self._is_fresh(message.tick):
                session.manual(message.of, message.rates, by=who)
            case Zoom() if self._is_fresh(message.tick):
                session.zoom(message.of, message.factor, by=who)

    def _is_fresh(self, tick: int) -> bool:
        """Whether a quoted tick is not too old to move anything."""
        sent = self._ticks.get(tick)
        return sent is not None and monotonic() - sent <= MANUAL_S

    def _forget(self, client: Client) -> None:
        """Do what the end of a browser's socket means for the heads."""
        self._clients.discard(client)
        if not any(each.who == client.who for each in self._clients):
            self._session.leave(client.who)
        if not self._clients:
            self._session.left_alone()

    async def _send_status(self, client: Client) -> None:
        """Send tick, stop and control every `TICK_S`."""
        session = self._session
        while True:
            control = session.control
            status = {
                "tick": self._tick,
                "stopped": session.stopped,
                "control": "nobody" if control is None else "you" if control == client.who else "another",
                "pages": len(self._clients),
                "recording": session.recording,
                "notice": session.notice,
            }
            await client.socket.send(json.dumps(status))
            await asyncio.sleep(TICK_S)

    async def _send_sentences(self, client: Client) -> None:
        """Send why orders were refused."""
        while True:
            await client.socket.send(json.dumps({"say": await client.sentences.get()}))

    async def _send_pictures(self, client: Client) -> None:
        """Send the newest picture each time that the browser has drawn the last."""
        sent = -1
        while True:
            await client.wake.wait()
            client.wake.clear()
            if self._newest is None or not client.drawn or self._newest[0] == sent:
                continue
            sent, data = await self._pack()
            client.drawn = False
            await client.socket.send(data)

    async def _pack(self) -> tuple[int, bytes]:
        """Pack the newest step's pictures, once for all browsers."""
        async with self._packing:
            assert self._newest is not None, "who asks has seen it"
            n, step, spec, skipped, made = self._newest
            if self._packed[0] != n:
                data = await self._loop.run_in_executor(self._packer, pack, step, n, spec, skipped, made)
                self._packed = n, data
            return self._packed
