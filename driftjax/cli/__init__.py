"""Command line: `driftjax learn | plan | equilibria | runs | report`."""

from driftjax.cli.front import main as main
