"""`python -m driftjax.studies.hidden_effects`."""

import sys

from driftjax.cli.front import set_up_jax

if __name__ == "__main__":
    set_up_jax()
    import tyro

    from driftjax.core import BadInput
    from driftjax.studies.hidden_effects.bench import Config, main

    try:
        main(tyro.cli(Config, prog="python -m driftjax.studies.hidden_effects"))
    except BadInput as error:
        sys.exit(f"hidden_effects: {error}")
