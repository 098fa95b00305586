"""`python -m cpjax` is `cpjax`."""

import sys

from cpjax.cli import main

if __name__ == "__main__":
    sys.exit(main())
