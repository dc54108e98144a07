"""`python -m acquisition`: the program `robot-acquire`."""

import sys

from .commands import main

if __name__ == "__main__":
    sys.exit(main())
