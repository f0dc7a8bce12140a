"""Who may look: basic and digest authentication of RFC 2617 with qop=auth, from the server's side."""

import base64
import binascii
import hashlib
import hmac
import secrets
import threading
import time
from collections.abc import Callable
from typing import Literal
from urllib.request import parse_http_list, parse_keqv_list

from cotarget.emulators.axis_http import Request

Scheme = Literal["digest", "basic"]

# How long a nonce is good [s], and how many are remembered; an older one is answered by a new one and "stale".
NONCE_LIFE_S = 300.0
MAX_NONCES = 1000


def _md5(*words: str) -> str:
    return hashlib.md5(":".join(words).encode(), usedforsecurity=False).hexdigest()


def _same(a: str, b: str) -> bool:
    return hmac.compare_digest(a.encode(), b.encode())


class Guard:
    """Checks the authorization of requests; safe to use from any thread.

    Args:
        user: who may look; empty where everybody may.
        password: of that user.
        scheme: of authentication.
        realm: that the client is told.
        now: the time [s].
    """

    def __init__(
        self, user: str, password: str, scheme: Scheme, realm: str, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._user, self._password, self._scheme, self._realm, self._now = user, password, scheme, realm, now
        self._issued: dict[str, float] = {}
        self._used: dict[str, set[str]] = {}
        self._lock = threading.Lock()

    def refuse(self, request: Request) -> str | None:
        """The challenge that a request must be answered with; None where it is allowed."""
        if not self._user:
            return None
        scheme, _, rest = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() != self._scheme:
            return self.challenge()
        if self._scheme == "basic":
            return None if self._basic(rest) else self.challenge()
        try:
            fields = parse_keqv_list(parse_http_list(rest))
        except (ValueError, IndexError):
            return self.challenge()
        if not self._digest(request, fields):
            return self.challenge()
        return None if self._fresh(fields["nonce"], fields["nc"]) else self.challenge(stale=True)

    def challenge(self, stale: bool = False) -> str:
        """The line that asks a client to authenticate itself; ``stale`` where only its nonce is too old."""
        if self._scheme == "basic":
            return f'WWW-Authenticate: Basic realm="{self._realm}"'
        nonce, now = secrets.token_hex(16), self._now()
        with self._lock:
            self._issued[nonce], self._used[nonce] = now, set()
            while len(self._issued) > MAX_NONCES:
                oldest = next(iter(self._issued))
                del self._issued[oldest], self._used[oldest]
        tail = ", stale=true" if stale else ""
        return f'WWW-Authenticate: Digest realm="{self._realm}", nonce="{nonce}", algorithm=MD5, qop="auth"{tail}'

    def _basic(self, token: str) -> bool:
        try:
            told = base64.b64decode(token.strip(), validate=True).decode("utf-8")
        except (binascii.Error, ValueError):
            return False
        return _same(told, f"{self._user}:{self._password}")

    def _digest(self, request: Request, fields: dict[str, str]) -> bool:
        def field(name: str) -> str:
            return fields.get(name, "")

        count = field("nc")
        if field("qop") != "auth" or field("uri") != request.target or len(count) != 8 or not field("cnonce"):
            return False
        # RFC 2617, 3.2.2.1
        secret = _md5(self._user, self._realm, self._password)
        asked = _md5(request.method, field("uri"))
        wanted = _md5(secret, field("nonce"), count, field("cnonce"), "auth", asked)
        known = _same(field("username"), self._user) and _same(field("realm"), self._realm)
        return _same(field("response"), wanted) and known

    def _fresh(self, nonce: str, count: str) -> bool:
        # A nonce of ours, not too old, and not used with this count before: a request overheard is of no use.
        with self._lock:
            issued = self._issued.get(nonce)
            if issued is None or self._now() - issued > NONCE_LIFE_S or count in self._used[nonce]:
                return False
            self._used[nonce].add(count)
            return True
