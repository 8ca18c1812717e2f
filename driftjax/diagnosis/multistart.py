"""Search for effects from several starts: more process noise, a large steering delay, late sensors, a power limit."""

from collections.abc import Callable

import numpy as np

from driftjax.core import BadInput
from driftjax.diagnosis.fit import (
    Fit,
    Problem,
    evaluate_fit,
    evaluate_fits,
    initial_noise,
    with_estimated_noise,
    with_noise,
)
from driftjax.diagnosis.noise import observed_channels
from driftjax.diagnosis.noise_model import Noise
from driftjax.diagnosis.observer import samples_in_run
from driftjax.diagnosis.refine import refit_to_convergence
from driftjax.diagnosis.select import MAX_EFFECTS, Selection, penalised_cost, search

LOST_MISFIT = (
    200.0  # cost per measurement from which the observer of the nominal car has lost it: 14 standard deviations
)
DELAYS = (0.5, 0.75, 1.0)  # of the steering, from which a search begins too [sqrt(L/g)]
LATE = 0.05  # share of the cost that such a delay must save by itself
TIMING = ("steer_delay", "steer_lag", "drive_lag", "channel_delay")  # effects that late sensors are taken for
SENSORS_LATE = ((1, 1, 0), (0, 0, 1), (1, 1, 1))  # of V, beta, r: by satellites and motion capture, the gyro, all
SENSOR_DELAYS = (0.05, 0.1, 0.2)  # of which the search begins [sqrt(L/g)]
POWER_LIMITS = (0.5, 0.75, 1.0, 1.25, 1.5)  # of which the search begins [typical sizes]
LEAST_DISTURBANCE = 0.5  # variance of the estimated disturbances, over that assumed: less at a fit is too much noise
CLOSER = (0.25, 0.5, 0.75, 1.0)  # to the noise assumed before any is estimated, where an observer loses the car
POOR_MISFIT = 1.5  # and from which a fit is not one: noise is what no effects explain, so a right one ends near 1


def nominal_fit(problem: Problem) -> Fit:
    """Return the fit of the nominal car, with no effect named."""
    return evaluate_fit(problem, problem.start)


def misfit(problem: Problem, fit: Fit) -> float:
    """Return the cost per measurement: 1 for a right model."""
    return fit.cost / problem.num_measurements


def require_finite_cost(fit: Fit) -> Fit:
    """Return `fit` if its cost is finite; raise `BadInput` where its observer diverged."""
    if not np.isfinite(fit.cost):
        raise BadInput("log: the observer of the nominal car loses these data; check units, signs and the vehicle.")
    return fit


def search_multistart(
    problem: Problem, seed: int = 0, most: int = MAX_EFFECTS, report: Callable[[str], None] = lambda text: None
) -> tuple[Problem, Selection]:
    """Search for effects, from other starts if that fails; return the problem and the selection.

    With strong effects and little disturbance the observer of the nominal car diverges, because its noise is what no
    effect explains: then the search starts with the noise that the nominal car needs. With a steering delay as long as
    a manoeuvre, the derivative at no delay says little and less grip seems to explain more: then the search also
    starts from a large delay, and from late sensors; a limit of power that is not reached has hardly a derivative, so
    that it starts from some of these, too. Where the fitted car needs far less process noise than was assumed, since
    strong effects exceed what their derivatives at the nominal car predict, the search is repeated with its noise.
    """
    start = nominal_fit(problem)
    close = search(problem, start, seed, most=most, report=report) if misfit(problem, start) < LOST_MISFIT else None
    if close and misfit(problem, close.fit) < POOR_MISFIT:
        late = search_from_late(problem, close, seed, most, report)
        penalised = lambda one: penalised_cost(problem, one.fit, one.selected)
        sensors = search_from_late_sensors(problem, close, seed, most, report)
        best = min((one for one in (close, late, sensors) if one), key=penalised)
        limited = search_from_power_limit(problem, best, seed, most, report)
        best = min((one for one in (best, limited) if one), key=penalised)
        too_noisy = bool(best.selected) and disturbance_ratio(problem, best).min() < LEAST_DISTURBANCE
        return search_with_own_noise(problem, best, seed, most, report) if too_noisy else (problem, best)
    repeated, selection = search_from_far(problem, seed, most, report)
    if close and misfit(problem, close.fit) <= misfit(repeated, selection.fit):
        return problem, close
    return repeated, selection


def search_from_late(
    problem: Problem, close: Selection, seed: int, most: int, report: Callable[[str], None]
) -> Selection | None:
    """Search from the best of `DELAYS`; None if none saves the share `LATE` of the cost, or `close` has a delay."""
    late = _effect_if_active(problem, "steer_delay")
    if not late or late[0] in close.selected:
        return None
    starts = _in_typical_sizes(problem, late, np.array(DELAYS)[:, None])
    return _search_from_delays(problem, close, late, starts, seed, most, report)


def search_from_late_sensors(
    problem: Problem, close: Selection, seed: int, most: int, report: Callable[[str], None]
) -> Selection | None:
    """Search from the best of `SENSORS_LATE` by `SENSOR_DELAYS`; None where none is better.

    All sensors late by several samples look like a steering that is late; from there the derivatives at no delay lead
    to a local optimum. Where `close` names no lag or delay, they may say too little of a delay beside its effects.
    """
    if not (late := _effect_if_active(problem, "channel_delay")):
        return None
    delays = [delay * np.array(which) for which in SENSORS_LATE for delay in SENSOR_DELAYS]
    starts = _in_typical_sizes(problem, late, np.array(delays))
    if set(TIMING) & {problem.effects[i].name for i in close.selected}:
        return _search_from_delays(problem, close, late, starts, seed, most, report)
    return _search_beside(problem, close, close.selected, late, starts, seed, most, report)


def search_from_power_limit(
    problem: Problem, close: Selection, seed: int, most: int, report: Callable[[str], None]
) -> Selection | None:
    """Search from the best of `POWER_LIMITS` in the place of a limit of traction, which imitates one, or beside all.

    None where that fits no better.
    """
    limit = _effect_if_active(problem, "power_limit")
    if not limit or limit[0] in close.selected:
        return None
    others = tuple(i for i in close.selected if problem.effects[i].name != "traction_limit")
    return _search_beside(problem, close, others, limit, np.array(POWER_LIMITS)[:, None], seed, most, report)


def _search_beside(
    problem: Problem, close: Selection, others: tuple[int, ...], added: tuple[int, ...], starts: np.ndarray, seed: int,
    most: int, report: Callable[[str], None],
) -> Selection | None:  # fmt: skip
    """Search from the effects `others` of `close` and the best of `starts` of `added`; None where it fits no better."""
    if len(others) >= most:
        return None
    better = _better_fit_beside(problem, close, others, added, starts)
    return _with_nominal_of(close, search(problem, better[1], seed, better[0], most, report)) if better else None


def _search_from_delays(
    problem: Problem, close: Selection, late: tuple[int, ...], starts: np.ndarray, seed: int, most: int,
    report: Callable[[str], None],
) -> Selection | None:  # fmt: skip
    """Search from the best of `starts` (n, k) of the delay `late`, in typical sizes.

    None if none saves the share `LATE`, or does better than lags and delays of `close` beside its other effects.
    """
    best = _best_start(problem, problem.start, late, starts)
    if best.cost > (1 - LATE) * close.nominal.cost:
        return None
    others = tuple(i for i in close.selected if problem.effects[i].name not in TIMING)
    if others != close.selected and not _better_fit_beside(problem, close, others, late, starts):
        return None
    fit = refit_to_convergence(problem, best, problem.columns(late))[0]
    return _with_nominal_of(close, search(problem, fit, seed, late, most, report))


def _effect_if_active(problem: Problem, name: str) -> tuple[int, ...]:
    """Return the effect `name` as a set; the empty set where the problem lacks it or a part of it is not active."""
    selected = tuple(i for i, effect in enumerate(problem.effects) if effect.name == name)
    return selected if problem.active[problem.columns(selected)].all() else ()


def _with_nominal_of(close: Selection, selection: Selection) -> Selection:
    """Return the selection with the nominal car's results of `close`."""
    return selection._replace(nominal=close.nominal, nominal_scores=close.nominal_scores)


def _better_fit_beside(
    problem: Problem, close: Selection, others: tuple[int, ...], added: tuple[int, ...], starts: np.ndarray
) -> tuple[tuple[int, ...], Fit] | None:
    """Return the effects `others` of `close` with `added` beside them, and their fit; None where `close` is better.

    The fit begins at the best of `starts`. Beside all effects of `close` it is made only where it begins below it.
    """
    theta, kept = problem.start.copy(), problem.columns(others)
    theta[kept] = close.fit.theta[kept]
    beside = _best_start(problem, theta, added, starts)
    if others == close.selected and beside.cost >= close.fit.cost:
        return None
    together = tuple(sorted((*others, *added)))
    fit = refit_to_convergence(problem, beside, problem.columns(together))[0]
    better = penalised_cost(problem, fit, together) < penalised_cost(problem, close.fit, close.selected)
    return (together, fit) if better else None


def _best_start(problem: Problem, theta: np.ndarray, added: tuple[int, ...], starts: np.ndarray) -> Fit:
    """Return the fit of the lowest cost with one of `starts` (n, k) of the effect `added` in `theta` (K,)."""
    thetas = np.tile(theta, (len(starts), 1))
    thetas[:, problem.columns(added)] = starts
    return min(evaluate_fits(problem, list(thetas)), key=lambda fit: fit.cost)


def _in_typical_sizes(problem: Problem, late: tuple[int, ...], delays: np.ndarray) -> np.ndarray:
    """Return `delays` (n, k) [sqrt(L/g)] of the effect `late` in typical sizes."""
    return delays * float(problem.model.base.unit_time) / np.asarray(problem.model.scale)[problem.columns(late)]


def with_nominal_noise(problem: Problem) -> Problem:
    """Return the problem with the noise estimated for the nominal car, with all parameters fixed.

    Without a sideslip sensor the observer may lose the nominal car with that noise, whose disturbances hold all that
    this car gets wrong. It is then taken closer to the noise assumed before, by the logarithm, until it does not.
    """
    loose = with_estimated_noise(problem, problem.start, np.zeros_like(problem.active))
    if not problem.data.skip:
        return loose
    assumed, estimated = (np.log(one.as_vector()) for one in (initial_noise(problem.data), loose.noise))
    for share in CLOSER:
        if np.isfinite(nominal_fit(loose).cost):
            break
        noise = Noise.from_vector(np.exp(share * assumed + (1 - share) * estimated))
        loose = with_noise(loose, problem.start, noise)
    return loose


def search_from_far(
    problem: Problem, seed: int = 0, most: int = MAX_EFFECTS, report: Callable[[str], None] = lambda text: None
) -> tuple[Problem, Selection]:
    """Search with the noise of the nominal car, then search again with that of the fitted car."""
    loose = with_nominal_noise(problem)
    start = require_finite_cost(nominal_fit(loose))
    rough = search(loose, start, seed, most=most, report=report)
    return search_with_own_noise(loose, rough, seed, most, report)


def disturbance_ratio(problem: Problem, selection: Selection) -> np.ndarray:
    """Return the variances of the disturbances estimated at the fit over those assumed, of informative channels.

    The mean of the squared estimate and its variance is 1 over the assumed one in the stationary state of a right
    model (the update of expectation maximisation; Shumway and Stoffer 1982, Eq. 12).
    """
    path, data = selection.linearisation.path, problem.data
    valid = np.asarray(path.valid)
    used = samples_in_run(valid)
    variance = np.asarray(problem.gains.P)[..., range(3, 6), range(3, 6)]
    second = (np.asarray(path.d) ** 2 + variance)[used].mean(axis=0)
    return (second / problem.noise.disturbance**2)[observed_channels(valid, data.informative)]


def search_with_own_noise(
    problem: Problem, rough: Selection, seed: int, most: int, report: Callable[[str], None]
) -> tuple[Problem, Selection]:
    """Search again with the noise of the car fitted in `rough`, starting from its effects; keep its nominal results.

    Where the observer with that noise loses the fitted car, `problem` and `rough`, the result of its search, stay.
    """
    own = with_estimated_noise(problem, rough.fit.theta, problem.active)
    fit = refit_to_convergence(own, evaluate_fit(own, rough.fit.theta), own.columns(rough.selected))[0]
    if not np.isfinite(fit.cost):
        return problem, rough
    selection = search(own, fit, seed, rough.selected, most, report)
    kept = {name: getattr(rough, name) for name in ("base", "nominal", "nominal_scores", "free")}
    return own, selection._replace(**kept)
