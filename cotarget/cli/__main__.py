"""`python -m cotarget.cli COMMAND`."""

import sys

from cotarget.cli import main

sys.exit(main())
