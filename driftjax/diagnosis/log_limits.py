"""Find what a log leaves unidentifiable for want of a channel, or where the observer loses the car."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from driftjax.diagnosis.evidence import FIRM
from driftjax.diagnosis.fit import Problem, information, time_lost
from driftjax.diagnosis.noise import PRIOR
from driftjax.diagnosis.runs import gains_along, whitened_derivatives
from driftjax.diagnosis.select import Selection

SENSOR = 0.01  # standard deviation of the sideslip sensor whose gain is stated [rad]
WORTHWHILE = 1.5  # times by which an interval must be wider without it to be stated
DISTINGUISHED = 3.0  # half the fall of the cost, by one effect beside the other, from which P exceeds 0.95


class Unidentifiable(NamedTuple):
    """Unidentifiable quantities of a log, and the reasons."""

    channels: tuple[str, ...]  # of the log format that it lacks
    wider: dict[str, float]  # named effect: its interval over that with a sideslip sensor
    ruled_out: dict[str, tuple[str, ...]]  # named effect: rivals that such a sensor would rule out
    not_judged: tuple[str, ...]  # effects on the drive force, which was estimated
    lost_s: float = 0.0  # in which the observer loses the car [s]

    @property
    def sentence(self) -> str:
        """Return the limits of the log in words; empty without any."""
        words = []
        if "beta" in self.channels:
            words.append("The log has no sideslip; it was inferred from speed and yaw rate.")
            sensor = f"a sensor with {SENSOR:g} rad of noise"
            words += [f"The interval of {name} would be {ratio:.1f} times narrower with {sensor}."
                      for name, ratio in self.wider.items()]  # fmt: skip
            words += [
                f"Such a sensor would tell {name} from {', '.join(rivals)}." for name, rivals in self.ruled_out.items()
            ]
        if "r" in self.channels:
            words.append("The log has no yaw rate; the rate of the heading was used, which is less sharp: small "
                         "delays and inertias may stand for that.")  # fmt: skip
        if "Fxr" in self.channels:
            words.append("The log has no drive force; the one that explains the measured speed was used, so that "
                         "drive, brakes and drag are not judged.")  # fmt: skip
        if {"beta", "Fxr"} <= set(self.channels):
            words.append("Without both, small effects of tyres and chassis may stand for errors of that force: "
                         f"one of less than {FIRM:.0f} times its uncertainty is exploratory.")  # fmt: skip
        if "psi" in self.channels:
            words.append("The log has no heading; wind and slopes of the road are judged by the integral of the yaw "
                         "rate, as if all drives began in one direction.")  # fmt: skip
        if self.lost_s:
            words.append(f"The observer loses the car in {self.lost_s:.1f} s of the log, which do not count.")
        return " ".join(words)


def find_unidentifiable(problem: Problem, selection: Selection, rivals: dict[int, tuple[int, ...]]) -> Unidentifiable:
    """Find what missing channels leave unidentifiable; `rivals` are those of each named effect."""
    data, names = problem.data, [effect.name for effect in problem.effects]
    known = {"beta": not data.skip, "r": data.yaw_rate_measured, "Fxr": data.force_known,
             "psi": "psi" in problem.extra_columns}  # fmt: skip
    lacks = [name for name, there in known.items() if not there]
    not_judged = () if data.force_known else tuple(names[i] for i in problem.unidentifiable_effects)
    lost_s = time_lost(problem, selection.linearisation)
    if not data.skip or not rivals:
        return Unidentifiable(tuple(lacks), {}, {}, not_judged, lost_s)
    H, better = information(selection.linearisation.J), information_with_sideslip(problem, selection)
    columns = problem.columns(tuple(rivals))
    deviation = lambda H: np.sqrt(np.diag(np.linalg.inv(H[np.ix_(columns, columns)] + np.eye(len(columns)) / PRIOR**2)))
    ratio = dict(zip(columns, deviation(H) / deviation(better), strict=True))
    wider = {names[i]: float(max(ratio[k] for k in problem.columns((i,)))) for i in rivals}
    apart = {
        names[i]: tuple(
            names[j] for j in others
            if separation(problem, selection.fit.theta, H, i, j) < DISTINGUISHED
            <= separation(problem, selection.fit.theta, better, i, j)
        )
        for i, others in rivals.items()
    }  # fmt: skip
    return Unidentifiable(tuple(lacks), {name: one for name, one in wider.items() if one >= WORTHWHILE},
                {name: one for name, one in apart.items() if one}, not_judged, lost_s)  # fmt: skip


def separation(problem: Problem, theta: np.ndarray, H: np.ndarray, one: int, other: int) -> float:
    """Return half the cost that remains if the effect `other` replaces `one`, whose size is that in `theta`."""
    mine, theirs = problem.columns((one,)), problem.columns((other,))
    moved = (theta - problem.start)[mine]
    shared = H[np.ix_(theirs, mine)] @ moved
    own = H[np.ix_(theirs, theirs)] + np.eye(len(theirs)) / PRIOR**2
    return 0.5 * float(moved @ H[np.ix_(mine, mine)] @ moved - shared @ np.linalg.solve(own, shared))


def information_with_sideslip(problem: Problem, selection: Selection) -> np.ndarray:
    """Return the information (K, K) of the log if the sideslip were measured too."""
    data, steps = problem.data, selection.linearisation.steps
    valid = np.array(steps.valid)
    valid[..., 1] = valid.max(axis=-1)
    noise = problem.noise.as_vector()
    noise[1] = SENSOR
    steps = steps._replace(valid=jnp.asarray(valid))
    gains = gains_along(data, steps, valid, noise)
    of_pose = information(np.asarray(selection.linearisation.J)[:, :, 3:])
    return information(np.asarray(whitened_derivatives(steps, gains, data))) + of_pose
