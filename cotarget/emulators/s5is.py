"""A Canon PowerShot S5 IS behind PTP/IP, with ready pictures and a lens behind it.

It announces all that a real one announces, and does what remote shooting needs; the rest is answered with "operation
not supported". There is no card in it: a still lies in its memory until the next one, or until it is switched off.
Stills have their full size whatever the image size is set to; settings of exposure are kept and have no effect.

Positions of the zoom beyond the lens's last are digital: they are accepted, the lens stays at its last, and nothing is
cropped. The zoom reads back as it was set, whether the lens is there yet or not, and may be set while it moves. The
viewfinder gives each of its pictures once and waits for the next one; it answers "busy" during a still and where no
picture comes for a second. Nobody measured any of this on a real camera, nor whether leaving the shooting mode draws
the lens in (here it does not). Faults of USB are not covered: PTP/IP is another transport.
"""

import threading
from collections.abc import Callable
from types import TracebackType

from cotarget.emulators.faults import Faults
from cotarget.emulators.plant import Feed, LensPlant
from cotarget.emulators.ptpserver import LINE_FAULTS, PtpIpServer
from cotarget.emulators.s5is_camera import S5isCamera
from cotarget.emulators.s5is_pictures import Shutter, Viewfinder
from cotarget.emulators.s5is_tables import MODEL
from cotarget.rig import Image

# "busy" refuses what shoots or sets; "gone" is unplugged, "power-off" what the camera's timer does: both for as long as
# they are on. The others are the line's.
S5IS_FAULTS = (*LINE_FAULTS, "busy", "gone", "power-off")
GUID = bytes.fromhex("00000000000010008000000085c50148")


class S5isServer:
    """The camera on a TCP port that serves command and event connections of one initiator at a time.

    Args:
        preview: pictures of the viewfinder.
        still: takes a picture at full size now, or a feed of such pictures.
        lens: the zoom.
        host: where to listen.
        port: where to listen; 0 for any.
        preview_size: of the viewfinder's pictures [px]; they are scaled by averaging areas.
        quality: of JPEG, 1 to 100.
        faults: knows those of `S5IS_FAULTS`; None for a camera that has none.
        shutter_s: from the request of a still to its exposure, mostly focusing [s].

    Raises:
        DeviceError: nobody can listen there.
    """

    def __init__(
        self,
        preview: Feed,
        still: Callable[[], Image] | Feed,
        lens: LensPlant,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        preview_size: tuple[int, int] = (320, 240),
        quality: int = 90,
        faults: Faults | None = None,
        shutter_s: float = 0.4,
    ) -> None:
        self._faults = Faults(S5IS_FAULTS) if faults is None else faults
        self._closing = threading.Event()
        self._shutter = Shutter(still, quality, shutter_s, self._closing)
        viewfinder = Viewfinder(preview, preview_size, quality, self._closing)
        self._camera = S5isCamera(viewfinder, self._shutter, lens, self._faults)
        self._server = PtpIpServer(self._camera, GUID, MODEL, self._faults, self._absent, host, port)
        self._camera.interrupt_by(self._server.send_event)

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.port

    def close(self) -> None:
        """Break the connections and end every thread."""
        self._closing.set()
        self._server.close()
        self._shutter.join()

    def _absent(self) -> bool:
        if "power-off" in self._faults:
            self._camera.switch_off()
            return True
        if "gone" in self._faults:
            self._camera.unplugged()
            return True
        return False

    def __enter__(self) -> "S5isServer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
