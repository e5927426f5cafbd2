"""``python -m derender``: the command line."""

import sys

from derender.cli import main

if __name__ == "__main__":
    sys.exit(main())
