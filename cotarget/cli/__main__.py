"""Run the commands with `python -m cotarget.cli COMMAND`."""

import sys

from cotarget.cli.main import main

sys.exit(main())
