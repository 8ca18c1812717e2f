"""Command line `driftjax VERB`: every verb parses its flags, calls the package and prints."""

from driftjax.cli.front import main as main
