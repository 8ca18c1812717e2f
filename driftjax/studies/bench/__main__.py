"""`python -m driftjax.studies.bench` is `driftjax bench`."""

import sys

from driftjax.cli.front import main

if __name__ == "__main__":
    sys.exit(main(["bench", *sys.argv[1:]]))
