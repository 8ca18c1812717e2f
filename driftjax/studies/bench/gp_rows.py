"""Measure the fit of a Gaussian process with three outputs and five inputs against scikit-learn."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from driftjax.gp import FitResult, Hyper, KernelGP, data_scales, fit_kernel, fit_masked
from driftjax.gp.fit import FINE, LOWER, UPPER
from driftjax.gp.likelihood import likelihood
from driftjax.gp.model import squared_differences
from driftjax.studies.bench.config import BenchConfig, missing
from driftjax.studies.bench.drift import residual_rows
from driftjax.studies.bench.rows import PartResult, RecordedCall, Row, TimingCurve, alternate, measure_curve, timed

TARGETS = {300: 8.0, 1000: 4.0}
ANY_SIZES = (50, 200, 500)  # rows of the fit with automatic gradient
SIZES = (50, 100, 200, 400, 1000)
START = (1.0, 1.0, 0.1)  # length scale, amplitude, noise: the first start of `driftjax.gp.fit`
NOISE = 0.05  # of the targets, over their root mean square
SAME = 1e-3  # by so much per data row our log likelihood may be below theirs and still count as the same


class Data(NamedTuple):
    """Training rows, raw and divided by their scales."""

    Z: jax.Array
    Y: jax.Array
    X: np.ndarray
    T: np.ndarray


def noisy_rows(num: int) -> Data:
    """Return `num` noisy rows of a car with less friction."""
    Z, Y = residual_rows(num)
    Y = Y + NOISE * np.sqrt(np.mean(Y**2, axis=0)) * np.random.default_rng(2).standard_normal(Y.shape)
    scale, output_scale = data_scales(jnp.asarray(Z), jnp.asarray(Y), jnp.ones(num, bool))
    return Data(jnp.asarray(Z), jnp.asarray(Y), Z / np.asarray(scale), Y / np.asarray(output_scale))


def gp_fit(rows: Data) -> Callable[[], FitResult]:
    """Return the fit on all `rows` from one start, ready to run."""
    num = len(rows.X)
    return lambda: fit_masked(rows.Z, rows.Y, jnp.ones(num, bool), num_restarts=1, num_fit=num, key=jax.random.key(0))


def measure_rows(cfg: BenchConfig) -> PartResult:
    """Measure all rows, and the curves if `cfg.plots`."""
    rows = [_row(cfg, num) for num in ((40,) if cfg.quick else TARGETS)]
    any_rows = [_any_row(cfg, num) for num in ((40,) if cfg.quick else ANY_SIZES)]
    return PartResult(rows + any_rows, _curves(cfg) if cfg.plots else [])


def _row(cfg: BenchConfig, num: int) -> Row:
    rows = noisy_rows(num)
    mine, theirs = RecordedCall(gp_fit(rows)), RecordedCall(_scikit_learn(rows))
    runs = {"ours": timed(mine, 1)} | ({} if missing("scikit-learn") else {"theirs": timed(theirs, 1)})
    times = alternate(cfg.repeats, runs)
    facts: dict[str, Any] = {"rows": num, "likelihood": _likelihoods(rows, _logs(mine.last.gp.hyper))}
    if "theirs" in times:
        facts["their_likelihood"] = _likelihoods(rows, theirs.last)
        ahead = (np.array(facts["likelihood"]) - np.array(facts["their_likelihood"])) / num
        facts["same_likelihood"] = bool(np.all(ahead >= -SAME))
        words = "the same likelihood" if facts["same_likelihood"] else "NOT the same likelihood"
        facts["remarks"] = f"{words}: ours less theirs per data row {', '.join(f'{a:.1e}' for a in ahead)}"
    return Row("gp", f"fit of 3 outputs, 5 inputs, {num} rows", "fit", times["ours"], "scikit-learn",
               times.get("theirs"), "faster", TARGETS.get(num), missing("scikit-learn"), facts)  # fmt: skip


def se_kernel(p: dict[str, jax.Array], a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the squared-exponential kernel of two points."""
    return p["amplitude"] ** 2 * jnp.exp(-0.5 * jnp.sum(((a - b) / p["length"]) ** 2))


def any_kernel(rows: Data) -> Callable[[], KernelGP]:
    """Return the fit of the first output with automatic gradient from one start, within the same bounds."""
    box = [{"amplitude": side[1], "length": np.full(rows.X.shape[1], side[0])} for side in (LOWER, UPPER)]
    X, y = jnp.asarray(rows.X), jnp.asarray(rows.T[:, 0])
    return lambda: fit_kernel(se_kernel, X, y, *box, noise=(LOWER[2], UPPER[2]), num_restarts=1,
                              tolerance=FINE, key=jax.random.key(0))  # fmt: skip


def _any_row(cfg: BenchConfig, num: int) -> Row:
    """Compare closed-form with automatic derivatives on one output."""
    rows = noisy_rows(num)
    one = rows._replace(Y=rows.Y[:, :1])
    mine, theirs = RecordedCall(gp_fit(one)), RecordedCall(any_kernel(rows))
    times = alternate(cfg.repeats, {"ours": timed(mine, 1), "theirs": timed(theirs, 1)})
    ahead = (float(mine.last.log_marginal_likelihood[0]) - float(theirs.last.log_marginal_likelihood)) / num
    facts = {"rows": num, "ahead": ahead, "remarks": f"likelihood of the closed form ahead per data row {ahead:.1e}"}
    return Row("gp", f"closed-form fit of 1 output, 5 inputs, {num} rows", "fit", times["ours"],
               "any kernel (automatic gradient)", times["theirs"], facts=facts)  # fmt: skip


def _scikit_learn(rows: Data) -> Callable[[], np.ndarray]:
    return lambda: fit_sklearn(rows.X, rows.T)


def fit_sklearn(X: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Fit scaled inputs (n, nf) and targets (n, D) by scikit-learn, same start and bounds, one output at a time.

    Returns the logarithms (D, nf + 2) of length scales, amplitude and noise.
    """
    from sklearn.gaussian_process import GaussianProcessRegressor  # an optional peer
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    (length, amplitude, noise), bounds = START, list(zip(LOWER, UPPER, strict=True))
    squared = lambda pair: (pair[0] ** 2, pair[1] ** 2)
    logs = []
    for y in T.T:
        signal = ConstantKernel(amplitude**2, squared(bounds[1])) * RBF(np.full(X.shape[1], length), bounds[0])  # pyright: ignore[reportArgumentType]
        kernel = signal + WhiteKernel(noise**2, squared(bounds[2]))
        fitted: Any = GaussianProcessRegressor(kernel, n_restarts_optimizer=0).fit(X, y).kernel_
        theta = fitted.theta
        logs.append([*theta[1:-1], theta[0] / 2, theta[-1] / 2])  # theirs are logarithms of variances
    return np.array(logs)


def _logs(hyper: Hyper) -> np.ndarray:
    columns = (hyper.log_lengthscale, hyper.log_amplitude[:, None], hyper.log_noise[:, None])
    return np.concatenate([np.asarray(column) for column in columns], axis=1)


def _likelihoods(rows: Data, logs: np.ndarray) -> list[float]:
    """Return the log marginal likelihood of each output at these hyper-parameters, by one formula for both sides."""
    pairs, present = squared_differences(jnp.asarray(rows.X)), jnp.ones(len(rows.X), bool)
    at = lambda x, y: likelihood("se", Hyper(x[:-2], x[-2], x[-1]), pairs, y, present)
    return [float(at(jnp.asarray(x), jnp.asarray(y))) for x, y in zip(logs, rows.T.T, strict=True)]


def _curves(cfg: BenchConfig) -> list[TimingCurve]:
    sizes, repeats = ((40,), 1) if cfg.quick else (SIZES, cfg.repeats)
    fits: dict[str, Callable[[Data], Callable[[], object]]] = {"driftjax": gp_fit}
    if not missing("scikit-learn"):
        fits["scikit-learn"] = _scikit_learn
    return [
        measure_curve(repeats, ("gp", label, "rows", "fit"), sizes, lambda n, make=make: timed(make(noisy_rows(n)), 1))
        for label, make in fits.items()
    ]
