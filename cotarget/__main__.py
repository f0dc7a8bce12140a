"""Run the commands with `python -m cotarget COMMAND`."""

import cotarget.cli.__main__  # noqa: F401
