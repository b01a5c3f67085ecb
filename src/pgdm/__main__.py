"""``python -m pgdm`` is ``pgdm``."""

import sys

from pgdm.cli.main import main

sys.exit(main())
