"""Entry point of `python -m cpjax`, the same as the command `cpjax`."""

import sys

from cpjax.cli import command

if __name__ == "__main__":
    sys.exit(command())
