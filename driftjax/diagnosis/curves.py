"""Shape of an axle's side force over slip as fitted, over the slips that the log covers and no further."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.special import stdtrit

from driftjax.core import Control, State
from driftjax.diagnosis.fit import Problem
from driftjax.diagnosis.observer import samples_in_run
from driftjax.diagnosis.score import covariance
from driftjax.diagnosis.select import Selection
from driftjax.parallel import call
from driftjax.vehicle.effect.linear import GRIP
from driftjax.vehicle.effect.tyre_curve import FreeForm
from driftjax.vehicle.universal import Universal

POINTS = 60  # of a curve
FLAT = 0.01  # fall after the peak below which there is none to speak of [-]
COVERED = 0.99  # quantile of the slip's size up to which the log covers it


class AxleCurve(NamedTuple):
    """Side force over load of one axle at static load without drive, over the slips that the log covers."""

    axle: str  # front or rear
    slip: np.ndarray  # (n,) from 0 to the largest covered [rad]
    nominal: np.ndarray  # (n,) of the car before naming [-]
    fitted: np.ndarray  # (n,) with all effects named [-]
    band: np.ndarray  # (2, n) 95 % interval of `fitted`
    peak: float  # slip of the largest fitted force; the largest covered where it only rises [rad]
    peak_ci95: tuple[float, float]
    drop: float  # share of the largest fitted force lost from there to the largest slip covered [-]
    drop_ci95: tuple[float, float]
    nominal_drop: float  # the same of `nominal`

    def content(self) -> dict[str, Any]:
        """Return plain values for diagnosis.json."""
        return {name: one.tolist() if isinstance(one, np.ndarray) else one for name, one in self._asdict().items()}


def axle_curve(problem: Problem, selection: Selection, member: int) -> AxleCurve | None:
    """Return the force curve of the axle that the effect `member` gives a free form; None for any other effect.

    Band and intervals follow from the robust covariance of all named parameters to first order (delta method): single
    parameters of a form may be open where the curve is not.
    """
    free, columns = problem.effects[member].apply, problem.columns(selection.selected)
    if not isinstance(free, FreeForm):
        return None
    front = free.field == "curve_f"
    slip = np.linspace(0.0, covered_slips(problem, selection)[0 if front else 1], POINTS)
    at = lambda theta: map(np.asarray, call(_curve, problem.model, jnp.asarray(theta), jnp.asarray(slip), front))
    nominal, _ = at(problem.start)
    fitted, J = at(selection.fit.theta)
    spread, J = covariance(selection.scores.H, selection.scores.blocks, columns), J[:, columns]
    dof = max(len(selection.scores.blocks) - len(columns), 1)
    half = stdtrit(dof, 0.975) * np.sqrt(np.einsum("ij,jk,ik->i", J, spread, J))
    low, high = fitted - half, fitted + half
    interval = lambda i: (float(low[i]), float(high[i]))
    return AxleCurve(
        "front" if front else "rear", slip, nominal[:-2], fitted[:-2], np.stack([low, high])[:, :-2],
        float(fitted[-2]), interval(-2), float(fitted[-1]), interval(-1), float(nominal[-1]),
    )  # fmt: skip


def _curve(model: Universal, theta: Array, slip: Array, front: bool) -> tuple[Array, Array]:
    """Return force over load at `slip` (m,), slip of its peak, fall after that (m + 2,); derivatives (m + 2, K)."""

    def values(theta: Array) -> Array:
        named = model.with_parameters(theta)
        car, parameters = named.car, named.values()
        for effect in model.effects:
            if effect.name in GRIP:
                car = effect.apply(car, parameters[effect.name])
        tyre, unit = car.tyre_f if front else car.tyre_r, jnp.ones(())
        force, peak = tyre.lateral(-slip, unit), jnp.minimum(tyre.alpha_peak, slip[-1])
        return jnp.concatenate([force, jnp.stack([peak, 1 - force[-1] / tyre.lateral(-peak, unit)])])

    return values(theta), jax.jacfwd(values)(theta)


def covered_slips(problem: Problem, selection: Selection) -> tuple[float, float]:
    """Return the size of slip that 1 % of the samples exceed, of front and rear [rad]."""
    path = selection.linearisation.path
    x, u, within = np.asarray(path.z)[..., :3], np.asarray(path.u), samples_in_run(np.asarray(path.valid))
    nominal = problem.model.base.nominal
    each = nominal.slip_angles(State(*np.moveaxis(x[within], -1, 0)), Control(*u[within][:, :2].T))
    front, rear = (float(np.quantile(np.abs(one), COVERED)) for one in each)
    return front, rear


def describe_curve(curve: AxleCurve) -> str:
    """Describe the curve in words, over the slips covered."""
    last = f"{np.degrees(curve.slip[-1]):.0f} deg, the largest slip of these data"
    if max(curve.drop, curve.nominal_drop) > FLAT:
        at, low, high = np.degrees([curve.peak, *curve.peak_ci95])
        share, least, most, before = (100 * x for x in (curve.drop, *curve.drop_ci95, curve.nominal_drop))
        return (
            f"The {curve.axle} curve peaks at {at:.1f} deg [{low:.1f}, {high:.1f}] and falls off {share:.0f} % "
            f"[{least:.0f}, {most:.0f}] after its peak up to {last}; the model's falls off {before:.0f} %."
        )
    off = int(np.argmax(np.abs(curve.fitted - curve.nominal)))
    share, low, high = (100 * (one[off] / curve.nominal[off] - 1) for one in (curve.fitted, *curve.band))
    return (
        f"The {curve.axle} curve does not fall off up to {last}; at {np.degrees(curve.slip[off]):.1f} deg its force is "
        f"{share:+.0f} % [{low:+.0f}, {high:+.0f}] off the model's."
    )
