"""Outcomes of iterative solvers, each with a sentence (extends `optimistix.RESULTS`, so inner failures keep theirs)."""

import optimistix as optx


class RESULTS(optx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """Outcome of an iterative solver; compare with `==`, never by text."""

    not_converged = "The solver stopped before its tolerance; give it a closer guess or more iterations."
    stalled = "The line search found no descent; the last feasible iterate is returned."
    non_finite = "The iterates became non-finite; check the guess and the bounds."
    off_branch = "Converged to another branch than the one asked for; start nearer to it."
    no_root = "No equilibrium exists at this point of the model."
    infeasible = "No feasible point was found; loosen the limits."
    not_positive_definite = "The covariance is not positive definite; check the kernel, or raise the least noise."
