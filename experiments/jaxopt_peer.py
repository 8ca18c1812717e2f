"""Table of our bounded Newton method beside jaxopt's L-BFGS-B: `python -m experiments.jaxopt_peer`."""

from driftjax.studies.bench.jaxopt_peer import compare_fits, compare_speed_sets

if __name__ == "__main__":
    compare_speed_sets()
    compare_fits()
