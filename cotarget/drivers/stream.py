"""A camera whose stream FFmpeg reads through PyAV: RTSP, HTTP, a V4L2 device, or a film played in real time.

A thread drains the stream and decodes every picture, because most pictures are coded as changes of the ones before.
The newest is converted to BGR when it is read. Its time is the stream's own, mapped to the rig's clock by
`StreamClock`; a stream without times of its own has those of arrival.

FFmpeg may open only the protocols and formats of the address's kind: a playlist would lead it to other addresses or
files. It follows no redirection. Measurements behind the numbers: docs/design-notes.md.
"""

import contextlib
import errno
import logging
import re
import socket
import ssl
import time
import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from os import environ
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from urllib.parse import quote, urlsplit

import av
import numpy as np

from cotarget.drivers.clock import MonotonicClock
from cotarget.drivers.frame_buffer import BufferedCamera, BusyError, FrameBuffer, LoginError, StreamRefusedError
from cotarget.errors import ConfigError, DeviceError
from cotarget.rig import CameraSpec, Clock, Image
from cotarget.schema import Check, Needed, NotNegative, Positive, Size, model

log = logging.getLogger(__name__)

EXAMPLE = "rtsp://192.168.0.92/stream1"
# Limit for a connection, and for opening the stream, which reads until it knows the pictures' size [s].
OPEN_S = 5.0
# Limit for the first picture [s]: cameras with "smart" codecs send a key frame every ten seconds.
FIRST_S = 15.0
# A stream has stalled after this time without a packet [s], or after this many frame periods where that is longer.
SILENCE_S, SILENCE_PICTURES = 2.0, 3.0
# A wait for a key frame that is worth a warning [s].
LONG_WAIT_S = 2.0
# Key frames of a live scene differ by their noise; a picture is frozen where they are equal to the bit for so long [s].
FROZEN_S = 2.0
# `doctor` looks at a stream for this time [s], or until it has seen two groups of pictures.
PROBE_S, LONGEST_PROBE_S = 4.0, 12.0
MEASURED = 1500  # number of pictures from which rate, groups and delays are measured: a minute at 25 a second


class Kind(NamedTuple):
    """What FFmpeg may open for an address of one kind."""

    protocols: str
    formats: str
    options: Mapping[str, str] = {}


FILES = "mpjpeg,mjpeg,mpegts,h264,hevc,flv,matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi"
# 100 ms of analysis, and no measuring of the rate, instead of FFmpeg's one second.
QUICK = {"analyzeduration": "100000", "fpsprobesize": "0", "probesize": "32768"}
RTSP = Kind("rtsp,tcp,tls,udp,rtp", "rtsp", QUICK | {"allowed_media_types": "video"})
# Proxies of the environment do not apply to a local device.
HTTP = Kind("http,https,tcp,tls", FILES, QUICK | {"max_redirects": "0", "http_proxy": "", "user_agent": "cotarget"})
V4L2, FILM = Kind("file", "v4l2,video4linux2"), Kind("file", FILES)
KINDS = {"rtsp": RTSP, "rtsps": RTSP, "http": HTTP, "https": HTTP}
# Formats whose times FFmpeg makes up from a nominal frame rate.
WITHOUT_CLOCK = ("mpjpeg", "mjpeg", "h264", "hevc")


def _kind(url: str) -> Kind:
    """Find what an address may open."""
    if url.startswith("/dev/"):
        return V4L2
    return KINDS[urlsplit(url).scheme] if "://" in url else FILM


def stream_address(url: str) -> str:
    """Check the address of a stream.

    Raises:
        ValueError: it is none, or has a password in it.
    """
    try:
        parts = urlsplit(url)
        valid = "://" not in url or (parts.scheme in KINDS and bool(parts.hostname) and parts.port != 0)
    except ValueError:  # an invalid address in brackets, or an invalid port
        raise ValueError(f"is not like {EXAMPLE}") from None
    if "@" in parts.netloc:
        raise ValueError("has a user or a password in it; write user = and give the password in COTARGET_PASSWORD")
    if not valid:
        raise ValueError(f"'{parts.scheme}://' is not like {EXAMPLE}, http://, /dev/video0 or the path of a film")
    return url


@model
class StreamSettings:
    """A camera with a stream that FFmpeg reads, such as an IP camera, a webcam, or a film that stands in for one.

    Attributes:
        url: address of the stream: rtsp, rtsps, http or https; or a V4L2 device, such as "/dev/video0"; or the path of
            a film, which is played in real time and begins again at its end.
        user: user name; empty where the camera asks for none.
        password: password; empty where an environment variable holds it.
        password_env: name of that variable.
        transport: how RTSP brings the pictures; UDP loses some on a busy network.
        size: image size that is expected; a V4L2 device is asked for it [px].
        rate_hz: frames per second; a V4L2 device is asked for it.
        latency_s: time from light to a frame's arrival, as measured [s].
    """

    url: Annotated[str, Needed(EXAMPLE), Check(stream_address)] = ""
    user: str = ""
    password: str = ""
    password_env: str = "COTARGET_PASSWORD"
    transport: Literal["tcp", "udp"] = "tcp"
    size: Size = (1920, 1080)
    rate_hz: Positive = 25.0
    latency_s: NotNegative = 0.3

    @property
    def spec(self) -> CameraSpec:
        """Describe the camera."""
        return CameraSpec(self.size, self.rate_hz, self.latency_s)


# Times

# Crystals of cameras and computers differ by less than this [s/s].
DRIFT = 1e-4
# A stream that is later than its earliest packets by so much, and for so long, has another clock now [s].
LATE_S, LATE_FOR_S = 0.5, 3.0
# The stream has no backlog where the thread waited so long for a packet [s].
WAITED_S = 1e-3
# A machine with a longer backlog decodes too slowly, and goes on at the next key frame [s].
BACKLOG_S = 2.0


class StreamClock:
    """Map a stream's own times to the rig's clock.

    The delay of a picture is its arrival less its own time. The smallest delay seen has the least of the network's
    jitter, so that mapping by it gives all of them evenly spaced times. It rises by `DRIFT` for clocks that run apart.
    A jump of the stream's clock restarts the mapping.

    Attributes:
        jumps: number of times that the mapping was restarted.
        late_s: by how much the newest picture is later than by the smallest delay [s].
    """

    def __init__(self) -> None:
        self.jumps, self.late_s = 0, 0.0
        self._delay: float | None = None  # the smallest [s]
        self._own = self._arrived = 0.0
        self._late_since: float | None = None  # arrival of the first of the pictures that are all late

    def map(self, own: float, arrived: float, waited: bool = True) -> float:
        """Return the time of a picture on the rig's clock, as if it had come with the smallest delay [s].

        Args:
            own: the picture's time on the stream's clock [s].
            arrived: time of arrival [s].
            waited: whether the thread waited for the packet. One that did not wait has a backlog of its own, which
                is no jump of the stream's clock.
        """
        delay = arrived - own
        if self._delay is None:
            self._delay = delay
        elif own < self._own or self._has_jumped(delay, arrived, waited):
            self._delay, self._late_since = delay, None
            self.jumps += 1
        else:
            self._delay = min(self._delay + DRIFT * (arrived - self._arrived), delay)
        self._own, self._arrived, self.late_s = own, arrived, delay - self._delay
        return own + self._delay

    def _has_jumped(self, delay: float, arrived: float, waited: bool) -> bool:
        """Whether every picture has been late for `LATE_FOR_S` though none had been queued here."""
        assert self._delay is not None
        if delay - self._delay < LATE_S or not waited:
            self._late_since = None
            return False
        if self._late_since is None:
            self._late_since = arrived
        return arrived - self._late_since > LATE_FOR_S


# Pictures

KEY_ADVICE = "set its key frame interval (GOP, I-frame interval) to one second and switch smart codecs off"
LOSS_ADVICE = "check its network, and that transport is tcp"
SLOW_ADVICE = "set a smaller size or rate in it, or H.264"


def to_bgr(picture: av.VideoFrame) -> Image:
    """Convert a decoded picture to BGR, (H, W, 3), read-only."""
    image: Image = picture.to_ndarray(format="bgr24")
    image.flags.writeable = False
    return image


@dataclass(frozen=True)
class _Arrival:
    """A picture that arrived."""

    arrived: float
    own: float | None  # its time on the stream's clock [s]
    is_key: bool
    waited: bool  # whether it was not queued


class StreamReader:
    """Decode the packets of one connection, put the pictures into the buffer, and measure the stream.

    Args:
        frames: the buffer.
        codec: decoder of the stream.
        clock: the rig's clock.
        has_times: whether the pictures have times of the stream's own.
    """

    def __init__(self, frames: FrameBuffer, codec: Any, clock: Clock, has_times: bool) -> None:
        self._frames, self._codec, self._clock, self._has_times = frames, codec, clock, has_times
        codec.thread_type = "SLICE"  # threads by frame add a frame of delay each
        self._times = StreamClock()
        self._key_since: float | None = None  # begin of the wait for a key frame [s]
        self._wait_for_key(clock.now(), f"{frames.name} has sent no key frame", KEY_ADVICE)
        self._arrivals: deque[_Arrival] = deque(maxlen=MEASURED)
        self._size = (0, 0)
        self._key_picture, self._same_since, self._frozen_s = 0, 0.0, 0.0
        self.real_time: float | None = None  # Unix time at 0 of the stream's clock, by its sender reports [s]

    def take(self, packet: Any, arrived: float, waited: bool = True) -> None:
        """Take a packet that arrived at a time [s]; ``waited`` as in `StreamClock.map`."""
        self._frames.heard()
        if not packet.size and packet.dts is not None:  # it repeats the picture before; the very last one has no time
            return
        if self._key_since is not None and packet.size:
            reason = f"{self._key_reason} for {arrived - self._key_since:.1f} s: {self._key_advice}"
            if not packet.is_keyframe:
                self._frames.remark(reason)
                return
            if arrived - self._key_since > LONG_WAIT_S:
                log.warning("%s", reason)
            self._key_since = None
        try:
            pictures = self._codec.decode(packet if packet.size else None)
            is_damaged = packet.is_corrupt or any(picture.is_corrupt for picture in pictures)
        except av.FFmpegError:
            is_damaged = True
        if is_damaged:  # what follows would be smeared
            self._frames.refuse()
            self._wait_for_key(arrived, f"{self._frames.name} has sent a broken picture, and no key frame", LOSS_ADVICE)
            return
        for picture in pictures:
            self._put(picture, packet, arrived, waited)

    def _put(self, picture: Any, packet: Any, arrived: float, waited: bool) -> None:
        if not self._has_times:
            self._measure(picture, arrived, None, waited)
            self._frames.put(picture, arrived, serial=bytes(packet))  # a frozen camera repeats its bytes
        elif picture.time is not None:  # the first picture of RTSP may come without
            own = float(picture.time)
            self._measure(picture, arrived, own, waited)
            t = self._times.map(own, arrived, waited) - self._frames.latency_s
            self._frames.put(picture, arrived, t=t, serial=picture.pts)
            if self._times.late_s > BACKLOG_S and not waited:
                self._wait_for_key(arrived, f"this machine skips pictures of {self._frames.name}", SLOW_ADVICE)

    def _wait_for_key(self, now: float, reason: str, advice: str) -> None:
        self._key_since, self._key_reason, self._key_advice = now, reason, advice

    def _measure(self, picture: Any, arrived: float, own: float | None, waited: bool) -> None:
        """Measure with a picture; warn of one that stays the same from key frame to key frame."""
        is_key = bool(picture.key_frame)
        self._arrivals.append(_Arrival(arrived, own, is_key, waited))
        self._size = (picture.width, picture.height)
        if not is_key:
            return
        was_frozen, before = self._frozen_s > FROZEN_S, self._key_picture
        self._key_picture = zlib.crc32(memoryview(picture.planes[0]))
        if self._key_picture != before:
            self._same_since = arrived
        self._frozen_s = arrived - self._same_since
        if self._frozen_s > FROZEN_S and not was_frozen:
            log.warning(
                "%s has sent the same picture for %.1f s: see that it is not frozen", self._frames.name, FROZEN_S
            )

    @property
    def groups(self) -> int:
        """Number of whole groups of pictures that were measured."""
        return max(sum(seen.is_key for seen in self._arrivals) - 1, 0)

    def describe(self) -> str:
        """Describe the stream in one line: size, codec, groups of pictures, rate, delay and its spread."""
        seen = list(self._arrivals)
        parts = [f"{self._size[0]}x{self._size[1]} {self._codec.name}"]
        times = np.array([each.arrived if each.own is None else each.own for each in seen])
        if len(seen) > 1 and times[-1] > times[0]:
            parts.append(f"{(len(seen) - 1) / (times[-1] - times[0]):.1f} frames a second")
        keys = np.flatnonzero([each.is_key for each in seen])
        if len(keys) > 1:
            length, seconds = np.diff(keys).mean(), np.diff(times[keys]).mean()
            every = f"a key frame every {length:.0f} frames ({seconds:.1f} s)"
            parts.append(every if length > 1 else "every frame is a key frame")
        elif seen:
            parts.append(f"fewer than two key frames in {times[-1] - times[0]:.0f} s: {KEY_ADVICE}")
        parts += self._delays(seen)
        if self._times.jumps:
            parts.append(f"jumps of its clock: {self._times.jumps}")
        if self._frozen_s > FROZEN_S:
            parts.append(f"the same picture for {self._frozen_s:.1f} s")
        return ", ".join(parts)

    def _delays(self, seen: list[_Arrival]) -> list[str]:
        delays = np.array([each.arrived - each.own for each in seen if each.own is not None and each.waited])
        if not self._has_times:
            return ["no times of its own, so those of arrival"]
        if not len(delays):
            return []
        said = "unknown delay, for it sends no time of day"
        if self.real_time is not None:
            late = delays.min() + time.time() - self._clock.now() - self.real_time
            said = f"{late:.2f} s late by the camera's time of day"
        return [said, f"arrivals spread by {1000 * delays.std():.0f} ms"]


# The camera


class StreamCamera(BufferedCamera):
    """A camera with a stream that FFmpeg reads; close it after use.

    Args:
        config: address of the stream, and the expected image size, rate and latency.
        clock: the rig's clock.

    Raises:
        ConfigError: the config has no address, or another image size than the stream.
        DeviceError: the stream cannot be opened, or brings no picture.
    """

    Settings = StreamSettings

    @staticmethod
    def probe(settings: StreamSettings) -> str:
        """Describe the stream in one line, after looking at it for some seconds.

        Raises:
            ConfigError: the settings have another image size than the stream.
            DeviceError: the stream cannot be opened, or brings no picture.
        """
        clock = MonotonicClock()
        with contextlib.closing(StreamCamera(settings, clock)) as camera:
            begin = clock.now()
            while (passed := clock.now() - begin) < PROBE_S or (camera.groups < 2 and passed < LONGEST_PROBE_S):
                clock.sleep_until(clock.now() + 0.1)
            return camera.describe()

    def __init__(self, config: StreamSettings, clock: Clock) -> None:
        self._config, self._clock, self._kind = config, clock, _kind(config.url)
        parts = urlsplit(config.url)
        # Addresses of some cameras hold a password in their path, so that messages show the host alone.
        where = f"{parts.scheme}://{parts.netloc}" if parts.scheme in KINDS else config.url
        self._name = f"the stream of {where}"
        silence_s = max(SILENCE_S, SILENCE_PICTURES / config.rate_hz)
        self._limits = (OPEN_S, silence_s)
        self._frames = FrameBuffer(self._name, clock, config.size, config.latency_s, silence_s)
        self._frames.decode = to_bgr
        self._reader: StreamReader | None = None
        try:
            self._frames.start(lambda: self._frames.keep_open(self._stream), "stream")
            width, height = self._frames.first(FIRST_S)
            if (width, height) != config.size:
                raise ConfigError(
                    f"hardware.fixed.size: {list(config.size)} is not what {where} sends: write size = "
                    f"[{width}, {height}]"
                )
        except BaseException:
            self.close()
            raise

    @property
    def groups(self) -> int:
        """Number of whole groups of pictures that this connection has brought."""
        return 0 if self._reader is None else self._reader.groups

    def describe(self) -> str:
        """Describe the stream in one line, see `StreamReader.describe`."""
        return "" if self._reader is None else self._reader.describe()

    def close(self) -> None:
        """End the stream and the thread; may be called again."""
        self._frames.close()
        self._frames.join()

    def _stream(self) -> None:
        """Open the stream and take its packets until it ends."""
        if self._kind is RTSP:
            refuse_redirection(self._config.url, self._name)
        try:
            with self._open() as container:
                self._drain(container)
        except (av.FFmpegError, OSError) as error:
            raise self._error_of(error) from None

    def _open(self) -> Any:
        """Open the stream by FFmpeg."""
        config, kind = self._config, self._kind
        options = {"protocol_whitelist": kind.protocols, "format_whitelist": kind.formats, **kind.options}
        if kind is RTSP:
            options |= {"rtsp_transport": config.transport, "timeout": f"{round(1e6 * self._limits[1])}"}
        if kind is V4L2:
            width, height = config.size
            options |= {"video_size": f"{width}x{height}", "framerate": f"{config.rate_hz:g}"}
            # At large sizes, most webcams have their full rate only in MJPEG.
            with contextlib.suppress(av.FFmpegError):
                jpeg = options | {"input_format": "mjpeg"}
                return av.open(config.url, format="v4l2", options=jpeg, timeout=self._limits)
            return av.open(config.url, format="v4l2", options=options, timeout=self._limits)
        return av.open(self._address(), options=options, timeout=self._limits)

    def _address(self) -> str:
        """Return the address for FFmpeg, with user and password."""
        config, parts = self._config, urlsplit(self._config.url)
        if self._kind is FILM:  # what leads a colon in a relative path would be taken for a protocol
            return str(Path(config.url).absolute())
        if not config.user:
            return config.url
        password = config.password or environ.get(config.password_env, "")
        return parts._replace(netloc=f"{quote(config.user, '')}:{quote(password, '')}@{parts.netloc}").geturl()

    def _drain(self, container: Any) -> None:
        if not container.streams.video or container.streams.video[0].codec_context is None:
            raise StreamRefusedError(f"{self._name} has no pictures that can be decoded: check its url")
        stream, clock = container.streams.video[0], self._clock
        has_times = container.format.name not in WITHOUT_CLOCK
        reader = self._reader = StreamReader(self._frames, stream.codec_context, clock, has_times)
        is_film = self._kind is not RTSP and container.duration is not None
        begin: float | None = None
        self._frames.opened()
        asked = clock.now()
        for packet in container.demux(stream):
            if is_film and packet.dts is not None:
                due = float(packet.dts * packet.time_base)
                begin = clock.now() - due if begin is None else begin
                self._wait_until(begin + due)
            if self._frames.closing:
                return
            arrived = clock.now()
            if container.start_time_realtime is not None:
                reader.real_time = container.start_time_realtime / 1e6
            reader.take(packet, arrived, arrived - asked > WAITED_S)
            asked = clock.now()

    def _wait_until(self, t: float) -> None:
        while not self._frames.closing and (now := self._clock.now()) < t:
            self._clock.sleep_until(min(t, now + 0.1))

    def _error_of(self, error: Exception) -> DeviceError:
        """Make the error for one of FFmpeg's, whose text may hold the password."""
        name, config, why = self._name, self._config, getattr(error, "strerror", None) or type(error).__name__
        errors = av.error
        match error:
            case errors.HTTPUnauthorizedError() | errors.HTTPForbiddenError():
                given = config.password or environ.get(config.password_env)
                missing = "" if config.user else "user and "
                remedy = "check" if config.user and given else "set"
                return LoginError(
                    f"{name} refuses the user '{config.user}': {remedy} {missing}the password, which may be in the "
                    f"environment variable {config.password_env}"
                )
            case errors.HTTPNotFoundError():
                return StreamRefusedError(f"{name} has no such stream (404): check the path in its url")
            case errors.HTTPServerError():
                return BusyError(
                    f"{name} is busy or fails, perhaps with too many viewers: close some, restart it, or check its url"
                )
            case errors.HTTPClientError():
                return StreamRefusedError(f"{name} refuses the stream ({why}): check its url")
            case errors.ExitError() | TimeoutError():
                return DeviceError(f"{name} has sent nothing for {self._limits[1]:.0f} s: check its power and network")
            case errors.ArgumentError() | errors.InvalidDataError() | OSError(errno=errno.EIO) if (
                self._kind is not RTSP
            ):
                return StreamRefusedError(
                    f"{name} is no stream that is read, but perhaps a playlist, a page or a redirection: give the "
                    "stream's own address as url"
                )
        keys = "url, transport" if self._kind is RTSP else "url"
        return DeviceError(f"{name} cannot be read ({why}): check {keys}, its power and the network")


def refuse_redirection(url: str, name: str) -> None:
    """Ask an RTSP camera for its stream without a password, and refuse one that sends on to another address.

    FFmpeg would follow it, with user and password.

    Raises:
        StreamRefusedError: the camera sends on; the message says where to.
        DeviceError: the camera cannot be reached.
    """
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or (322 if parts.scheme == "rtsps" else 554)
    ask = f"DESCRIBE {url} RTSP/1.0\r\nCSeq: 1\r\nAccept: application/sdp\r\nUser-Agent: cotarget\r\n\r\n"
    try:
        with socket.create_connection((host, port), OPEN_S) as line:
            if parts.scheme == "rtsps":
                context = ssl._create_unverified_context()  # cameras sign their certificates themselves
                line = context.wrap_socket(line, server_hostname=host)
            line.sendall(ask.encode())
            answer = line.recv(4096).decode("latin-1")
    except TimeoutError:
        raise DeviceError(f"{name} does not answer within {OPEN_S:g} s: check address, power and network") from None
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise DeviceError(f"{name} cannot be reached ({why}): check address, power and network") from None
    if re.match(r"RTSP/1\.\d 3\d\d", answer):
        found = re.search(r"^location:\s*(\S+)", answer, re.IGNORECASE | re.MULTILINE)
        to = urlsplit(found[1]).netloc.rpartition("@")[2] if found else ""
        raise StreamRefusedError(f"{name} sends on to {to or 'another address'}: set url to where the stream really is")
