"""Ablations of the comparison: the words and the changed options of each."""


def by(acquisition: str) -> dict:
    """Return the options that replace Algorithm 1 by the rule `acquisition`."""
    return {"acquisition": acquisition}


PLANNED, UNCORRECTED = {"speeds": "planned"}, {"correction": False}
ZERO_MEAN = {"gp": {"effects": ()}}  # the paper's GP
NO_GP = ZERO_MEAN | {"layers": "none"}
BARE = NO_GP | {"measured_arrival": False, "explore": {"num_sets": 0}}  # not explored
ABLATIONS: dict[str, tuple[str, dict]] = {  # name: (words, change)
    "as_it_is": ("as in the main comparison, all laps driven", {}),
    "extended": ("the nominal car extended by `diagnose`", {}),
    "nominal": ("nothing learnt, as many laps", BARE | {"gp": {"effects": (), "lags": False}}),
    "lags": ("no GP, planned arrival: learnt lags only", BARE),
    "arrival": ("no GP: learnt lags and measured arrival; explored at the planned speed", NO_GP | {"explore": PLANNED}),
    "gp_reference": ("GP of zero mean in the reference only", ZERO_MEAN | {"layers": "reference"}),
    "gp_mpc": ("GP of zero mean in the MPC only", ZERO_MEAN | {"layers": "mpc"}),
    "zero_mean": ("GP of zero mean in both, as in the paper", ZERO_MEAN),
    "parameters": ("fitted tyre and drive parameters, no GP", {"layers": "none"}),
    "step": ("the paper's step to the equilibrium as reference", {"reference": "step"}),
    "no_lags": ("no lags: bare commands in the GP's inputs", {"gp": {"lags": False}}),
    "unbounded": ("the GP's bare mean, however far from data", {"gp": {"bounded": False}}),
    "points_50": ("dictionary of 50 points", {"gp": {"size": 50, "num_fit": 50}}),
    "points_400": ("dictionary of 400 points", {"gp": {"size": 400}}),
    "variance": ("lambda 1: variance only", {"explore": {"lam": 1.0}}),
    "nearness": ("lambda 0: nearness only", {"explore": {"lam": 0.0}}),
    "equal_P": ("P of ones", {"explore": {"P": (1.0, 1.0, 1.0)}}),
    "random": ("explored at random speeds", {"explore": {"speeds": "random"}}),
    "uniform": ("explored at evenly spaced speeds", {"explore": {"speeds": "uniform"}}),
    "planned": ("as many laps at the planned speed", {"explore": PLANNED}),
    "knowledge_gradient": ("chosen by predicted error and knowledge gradient", {"explore": by("knowledge_gradient")}),
    "expected_improvement": ("chosen by expected improvement", {"explore": by("expected_improvement")}),
    "thompson": ("chosen by one sample of the GP", {"explore": by("thompson")}),
    "random_grid": ("drawn at random from the same grid", {"explore": by("random")}),
    "sets_uncorrected": ("V-sets, the aimed path not corrected", {"explore": UNCORRECTED}),
    "planned_uncorrected": (
        "as many laps at the planned speed, the aimed path not corrected", {"explore": PLANNED | UNCORRECTED}
    ),
}  # fmt: skip
