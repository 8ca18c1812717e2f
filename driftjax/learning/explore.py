"""Explore corner speeds for a batch: candidates from the V-sets, the next one by Algorithm 1."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from driftjax.control.table import ReferenceTable
from driftjax.core import RESULTS, Control, State, features
from driftjax.equilibrium import SlipSpeed, continuation
from driftjax.explore import select, v_sets
from driftjax.learning.config import ExploreConfig
from driftjax.learning.reference import AIM_POINTS
from driftjax.learning.scenario import SPEEDS, Scenario
from driftjax.parallel import vmap_batch
from driftjax.sim import Trace, where_tree
from driftjax.vehicle import AnyCar, Residual


class Candidates(eqx.Module):
    """Candidate speeds per batch entry (leading axis), and which of them have been driven."""

    s: Array  # (batch, AIM_POINTS) arc length of the curves [m]
    origin: Array  # (batch, AIM_POINTS) planned speed, from which they start [m/s]
    target: Array  # (batch, AIM_POINTS) r_b e, where they tend to [m/s]
    e: Array  # (batch, AIM_POINTS) measured lateral error that they correct [m]
    aimed: Array  # (batch, AIM_POINTS) target offset from the path of the lap with this error [m]
    widest: Array  # (batch,) largest bound on gamma, both signs [m/s]
    V: Array  # (batch, K, AIM_POINTS) generated curves [m/s]
    V_ep: Array  # (batch, K) cornering speeds: the planned one, changed by as much as the curves on average [m/s]
    visited: Array  # (batch, K) driven or excluded: a duplicate, or no equilibrium
    current: Array  # (batch,) cornering speed of the reference driven last [m/s]


class Drifts(eqx.Module):
    """Drift states of a corrected car at the corner's sideslip, over speed.

    At fixed V and yaw rate a car with a friction circle has two drifts, very close in speed, or none; at fixed sideslip
    it has one. E(V_ep, .) is therefore solved at the sideslip of the corner, starting from the nominal drift.
    """

    nominal: AnyCar
    beta: Array
    x_eq: State
    u_eq: Control
    branch: Array  # the kind of all

    def __call__(self, V: Array, residual: Residual) -> tuple[Array, Array]:
        """Return the GP input z (5,) of the drift at speed `V`, and whether it exists."""
        fixed, guess = SlipSpeed(self.beta, V), (self.x_eq, self.u_eq)
        equilibrium = continuation(self.nominal, residual, fixed, guess, branch=self.branch)
        return features(equilibrium.x, equilibrium.u), equilibrium.result == RESULTS.successful


def drifts(scenario: Scenario) -> Drifts:
    """Build the drift states of the corner."""
    beta, branch = jnp.asarray(scenario.corner.beta), jnp.asarray(scenario.branch)
    return Drifts(scenario.nominal, beta, scenario.x_eq, scenario.u_eq, branch)


def candidates(
    scenario: Scenario, trace: Trace, residual: Residual, aimed: Array, current: Array, number: int
) -> Candidates:
    """Compute candidates from the lateral errors in `trace`, which tracked `aimed` (batch, AIM_POINTS) in a stage.

    Speeds come from the V-sets (Eq. 9) or, to compare with, from `speeds`, and are the planned one where another
    acquisition than the paper's chooses them; those drawn at random are new in every stage
    `number`. All kinds have the same bounds, the same number of candidates and the same corrections of the path.
    """
    table, config, V_b = scenario.table, scenario.config.explore, scenario.corner.V_b
    shares, most = jnp.asarray(np.arange(1, config.num_sets + 1) / config.num_sets), config.gamma_share * V_b
    weights = (jnp.asarray(config.w1), jnp.asarray(config.w2))
    shaped = scenario.executor.map(
        speed_sets_batch, (trace, aimed, current), table, shares, jnp.asarray(most), weights,
        jnp.asarray(V_b), jnp.asarray(abs(scenario.corner.R)),
    )  # fmt: skip
    if config.kind != "sets":
        V_ep = V_b + shaped.widest[:, None] * _offsets(config, scenario.keys, number)
        level = jnp.broadcast_to(V_ep[..., None], shaped.V.shape)
        shaped = eqx.tree_at(lambda c: (c.V, c.V_ep), shaped, (level, V_ep))
    if config.kind != "sets" or config.fixed_laps:  # candidates of equal speed differ in their correction
        shaped = eqx.tree_at(lambda c: c.visited, shaped, jnp.zeros_like(shaped.visited))
    _, exists = _states(scenario, shaped, residual)
    return eqx.tree_at(lambda c: c.visited, shaped, shaped.visited | ~exists[:, :-1])


def offset(scenario: Scenario, sets: Candidates, index: Array) -> Array:
    """Return the offset from the path (batch, AIM_POINTS) [m] to track with candidate `index` (batch,).

    Iterative learning control of the reference (Arimoto, Kawamura and Miyazaki 1984): the target of the lap before
    minus a learning gain times its measured error e. The gain of candidate k of K is k/K, at any kind of speeds; e is
    limited to the error that the largest allowed gamma could remove in a steady turn by gamma = r_b e. The speed curve
    alone is not enough: where the planned speed is curved, as in a corner with braking, its smoothness weight outweighs
    r_b e. Without `correction` the target does not change.
    """
    config, corner = scenario.config.explore, scenario.corner
    if not config.correction:
        return sets.aimed
    most = config.gamma_share * corner.V_b / abs(corner.r_b)
    share = (index + 1) / config.num_sets
    return sets.aimed - share[:, None] * jnp.clip(sets.e, -most, most)


def remaining(
    scenario: Scenario,
    sets: Candidates,
    index: Array,
    aimed: Array,
    current: Array,
    better: Array,
    trace: Trace,
    residual: Residual,
    number: int,
) -> Candidates:
    """Return the candidates after the laps in `trace`, which drove `index` (batch,) with the offset `aimed`.

    `current` (batch,) [m/s] is the cornering speed that these laps aimed at.

    An entry that improved (`better`) gets new candidates around this lap; the others keep those that remain. This holds
    for every kind of speeds. `number` is that of the stage.
    """
    visited = sets.visited | jax.nn.one_hot(index, sets.visited.shape[1], dtype=bool)
    left = eqx.tree_at(lambda c: (c.visited, c.current), sets, (visited, current))
    return eqx.filter_jit(where_tree)(better, candidates(scenario, trace, residual, aimed, current, number), left)


def _offsets(config: ExploreConfig, keys: Array, number: int) -> Array:
    """Return the candidate speeds (batch, K) of the other kinds, as changes over the largest bound of the V-sets.

    The nearest to the planned speed comes first, as in nested sets, and has the smallest correction of the path.
    """
    K = config.num_sets
    if config.kind == "random":
        own = lambda key: jax.random.fold_in(jax.random.fold_in(key, SPEEDS), number)
        drawn = jax.vmap(lambda key: jax.random.uniform(own(key), (K,), minval=-1.0, maxval=1.0))(keys)
    else:
        even = jnp.linspace(-1.0, 1.0, K) if config.kind == "uniform" else jnp.zeros(K)
        drawn = jnp.broadcast_to(even, (len(keys), K))
    return jnp.take_along_axis(drawn, jnp.argsort(jnp.abs(drawn), axis=1), axis=1)


def speed_sets_batch(
    batch: tuple[Trace, Array, Array],
    table: ReferenceTable,
    shares: Array,
    most: Array,
    weights: tuple[Array, Array],
    V_b: Array,
    R: Array,
) -> Candidates:
    """Compute candidates for batch entries (lap, tracked offset, speed), whether or not a drift exists at their speeds.

    Lengths are over the radius `R` [m] and speeds over `V_b` [m/s]: the weights of Eq. 9 then mean the same on a car of
    any size, as the paper's, which are nearly equal for its two cars, suggest. Without units the minimum over curves
    is smooth over (w1/w2)^(1/4) = 2.1 radii, however many points it has. Their bounds are fractions `shares` of what
    the own error requires, at most `most` [m/s]: larger bounds would all give the same curve.
    """
    s = jnp.linspace(table.drift_start, table.drift_end, AIM_POINTS)
    origin, r_b = table.row(table.V, s), table.row(table.r, s)

    def one(trace: Trace, aimed: Array, current: Array) -> Candidates:
        at = jnp.where(trace.alive, trace.sensed.s, jnp.inf)
        order = jnp.argsort(at)  # the measured arc length may dip by its noise; interp needs it ascending
        e = jnp.interp(s, at[order], trace.sensed.e[order])
        widest = jnp.minimum(most, jnp.max(jnp.abs(r_b * e)))
        bounds = widest * jnp.stack([-shares, shares], axis=1)
        sets = v_sets(origin / V_b, s / R, r_b * R / V_b, e / R, w1=weights[0], w2=weights[1],
                      gamma_bounds=bounds / V_b, V_min=0.3, V_max=3.0)  # fmt: skip
        # the planned cornering speed is a mean over part of the section: curves count by their change only
        V_ep = V_b + V_b * sets.V_ep - jnp.mean(origin)
        return Candidates(s, origin, r_b * e, e, aimed, widest, V_b * sets.V, V_ep, ~sets.distinct, current)

    return vmap_batch(one)(*batch)


def _states(scenario: Scenario, sets: Candidates, residual: Residual) -> tuple[Array, Array]:
    """Return GP inputs (batch, K + 1, 5) of the drifts at the candidate speeds and the current one; which exist."""
    V = jnp.append(sets.V_ep, sets.current[:, None], axis=1)
    return scenario.executor.map(drift_states_batch, (V, residual), drifts(scenario))


def drift_states_batch(batch: tuple[Array, Residual], states: Drifts) -> tuple[Array, Array]:
    """Compute drift states for batch entries (speeds, residual)."""
    return vmap_batch(lambda V, d: jax.vmap(lambda one: states(one, d))(V))(*batch)


def choose(scenario: Scenario, sets: Candidates, residual: Residual) -> tuple[Array, Array, Array]:
    """Apply Algorithm 1 to every batch entry: index of the next candidate, its speed, and whether any remained."""
    options = scenario.config.explore
    if options.kind == "planned":  # scores differ by rounding only
        return jnp.argmax(~sets.visited, axis=1), sets.V_ep[:, 0], ~jnp.all(sets.visited, axis=1)
    z, _ = _states(scenario, sets, residual)
    batch = (sets.V_ep, sets.visited, z, residual)
    return scenario.executor.map(choose_batch, batch, jnp.asarray(options.P), jnp.asarray(options.lam))


def choose_batch(batch: tuple[Array, Array, Array, Residual], P: Array, lam: Array) -> tuple[Array, Array, Array]:
    """Choose by Algorithm 1 with these weights for batch entries (speeds, visited, drift states, residual)."""

    def one(V_ep: Array, visited: Array, z: Array, d: Residual):
        choice = select(z[:-1], visited, z[-1], d.gp, P, lam)
        return choice.candidate, V_ep[choice.candidate], ~choice.exhausted

    return vmap_batch(one)(*batch)
