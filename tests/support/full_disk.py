"""A disk that is full, as every writing to a file finds it, whatever the library."""

import contextlib
import resource

SAID = "File too large"  # what the system says to this limit, where a full disk has "No space left on device"


@contextlib.contextmanager
def full_disk(room=0):
    """Let no file of this process grow beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
