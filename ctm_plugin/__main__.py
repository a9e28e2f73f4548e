"""``python -m ctm_plugin``."""

import sys

from ctm_plugin.cli import main

sys.exit(main())
