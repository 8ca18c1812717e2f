"""Run `driftjax` as `python -m driftjax.cli`."""

import sys

from driftjax.cli.front import main

if __name__ == "__main__":
    sys.exit(main())
