"""Basic and digest authentication of the emulated devices' HTTP and RTSP servers, as in RFC 2617."""

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol
from urllib.request import parse_http_list, parse_keqv_list

Scheme = Literal["digest", "basic"]
QOP = "auth"


class Headers(Protocol):
    """Headers of a request, whose names are found in any case."""

    def get(self, name: str, default: str, /) -> str:
        """Return the value of a header."""


def _md5(*words: str) -> str:
    return hashlib.md5(":".join(words).encode(), usedforsecurity=False).hexdigest()


@dataclass(frozen=True)
class Authenticator:
    """Check the authorization of requests."""

    user: str  # empty if everyone may connect
    password: str
    scheme: Scheme
    realm: str
    nonce: str  # of digest authentication; it never expires
    qop: bool = True  # whether digest authentication has a quality of protection, which RTSP cameras leave out

    @property
    def challenge(self) -> str:
        """Header line that demands authentication."""
        if self.scheme == "basic":
            return f'WWW-Authenticate: Basic realm="{self.realm}"'
        more = f', algorithm=MD5, qop="{QOP}"' if self.qop else ""
        return f'WWW-Authenticate: Digest realm="{self.realm}", nonce="{self.nonce}"{more}'

    def allows(self, method: str, target: str, headers: Headers | Mapping[str, str]) -> bool:
        """Return whether a request is allowed; ``target`` is as in the request line, with the arguments."""
        if not self.user:
            return True
        scheme, _, rest = headers.get("Authorization", "").partition(" ")
        if scheme.lower() != self.scheme:
            return False
        if self.scheme == "basic":
            return rest.strip() == base64.b64encode(f"{self.user}:{self.password}".encode()).decode()
        try:
            fields = parse_keqv_list(parse_http_list(rest))
        except (ValueError, IndexError):
            return False
        names = ("username", "realm", "uri", "qop", "nonce", "nc", "cnonce", "response")
        user, realm, uri, qop, nonce, count, cnonce, response = (fields.get(name, "") for name in names)
        if (user, realm, uri, qop, nonce) != (self.user, self.realm, target, QOP if self.qop else "", self.nonce):
            return False
        # RFC 2617, 3.2.2.1
        secret, asked = _md5(user, realm, self.password), _md5(method, uri)
        return response == (_md5(secret, nonce, count, cnonce, qop, asked) if self.qop else _md5(secret, nonce, asked))
