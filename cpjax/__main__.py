"""`python -m cpjax` is `cpjax`."""

import sys

from cpjax.cli import command

if __name__ == "__main__":
    sys.exit(command())
