"""`python -m driftjax.studies.paper` is `driftjax paper`."""

import sys

from driftjax.cli.front import main

if __name__ == "__main__":
    sys.exit(main(["paper", *sys.argv[1:]]))
