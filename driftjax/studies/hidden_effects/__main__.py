"""`python -m driftjax.studies.hidden_effects`."""

import sys

if __name__ == "__main__":
    import tyro

    from driftjax.core import BadInput
    from driftjax.studies.hidden_effects.bench import Config, main

    try:
        main(tyro.cli(Config, prog="python -m driftjax.studies.hidden_effects"))
    except BadInput as error:
        sys.exit(f"hidden_effects: {error}")
