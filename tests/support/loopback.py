"""What test servers on loopback share: they serve in a thread of their own for the length of a with block."""

import threading


class Loopback:
    """Before a server of `socketserver` among the bases of a class.

    Attributes:
        closing: set when the with block ends, for handlers that wait.
    """

    daemon_threads = False  # so that closing waits for them

    def __init__(self, *args):
        super().__init__(*args)
        self.closing = threading.Event()

    def __enter__(self):
        self._thread = threading.Thread(target=self.serve_forever, args=(0.01,))
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.closing.set()
        self.cut()
        self.shutdown()
        self._thread.join()
        self.cut()  # who came back while the server was ending
        self.server_close()

    def cut(self):
        """Close every client's connection."""
