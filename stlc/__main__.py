"""`python -m stlc` is `stlc`."""

import sys

from stlc.cli.app import main

sys.exit(main())
