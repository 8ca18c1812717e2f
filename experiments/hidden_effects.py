"""Table and figures of hidden effects: which ones `diagnose` names in simulated logs.

`python -m experiments.hidden_effects` (`--help` lists the options).
"""

import sys

import tyro

import driftjax as dj
from driftjax.studies.hidden_effects.bench import StudyConfig, run_study

if __name__ == "__main__":
    try:
        run_study(tyro.cli(StudyConfig, prog="python -m experiments.hidden_effects"))
    except dj.BadInput as error:
        sys.exit(f"hidden_effects: {error}")
