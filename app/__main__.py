"""`python -m dragrig`."""

import sys

from dragrig.cli import main

if __name__ == "__main__":
    sys.exit(main())
