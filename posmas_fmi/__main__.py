"""``python -m posmas_fmi`` is the command ``posmas-fmi``."""

import sys

from posmas_fmi.cli import main

if __name__ == "__main__":
    sys.exit(main())
