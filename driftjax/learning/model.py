"""Learn the residual of one batch entry: dictionary of informative rows, GP on it, and trust factor."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.gp import (
    GP,
    condition,
    data_scales,
    fit_masked,
    predict_known_effects,
    project_out,
    select_dictionary,
    zero_gp,
)
from driftjax.learning.config import GPConfig
from driftjax.learning.tuning import left_over, tune_parameters
from driftjax.vehicle import AnyCar, Extended, Residual, no_residual

KnownEffectBasis = Callable[[Array], Array]  # of inputs (N, 5): derivatives by known effect parameters (N, 3, k)

FOLDS = 4  # stretches of time, each held out once
GAP = 5  # rows excluded next to a stretch: smoothing over so many samples correlates their noise


class ModelState(eqx.Module):
    """Dictionary rows and the residual learnt from them, for one batch entry."""

    Z: Array  # (M, 5)
    Y: Array  # (M, 3)
    mask: Array  # (M,)
    order: Array  # (M,) when each row was driven: a number that grows by 1 per sample, and by more between laps
    residual: Residual


def empty(config: GPConfig, lags: Array | None = None, nominal: AnyCar | None = None) -> ModelState:
    """Return the model before the first lap; known actuator `lags` (2,) [s] may be given.

    `nominal` is the car whose effects `config` names, if any.
    """
    M = config.size
    gp = zero_gp(M, 5, 3, config.kernel)
    num_parameters = 0
    if config.effects:
        assert isinstance(nominal, Extended), "free effects need a car that has them"
        num_parameters = len(nominal.scale)
    residual = no_residual(gp, lags, config.bounded, num_parameters)
    return ModelState(jnp.zeros((M, 5)), jnp.zeros((M, 3)), jnp.zeros(M, bool), jnp.zeros(M), residual)


def update_model(
    model_state: ModelState,
    Z: Array,
    Y: Array,
    mask: Array,
    lags: Array,
    config: GPConfig,
    key: Array,
    known_basis: KnownEffectBasis | None = None,
    shortest: Array | None = None,
    car: tuple[AnyCar, Array] | None = None,
) -> ModelState:
    """Update dictionary, GP and trust factor with a lap's rows, in driving order, and its actuator `lags` (2,) [s].

    Where `config` names effects, `car` is the nominal car with the time step of the rows [s]; its parameters are fitted
    first, and the GP to what they leave. One lap of data does not say what that is where the next lap goes: the GP is
    used from the second on.

    The trust factor of an output is the factor in 0..1 on the mean that minimises the squared error at held-out rows
    (Breiman 1996, Stacked Regressions, of one model): noise of the rows does not lower it, an exaggerated or wrong mean
    does. The GP leaves to the known effects what `known_basis` spans. `shortest` overrides that of `config`: a number
    that need not be known at compile time.
    """
    Z, Y = jnp.concatenate([model_state.Z, Z]), jnp.concatenate([model_state.Y, Y])
    mask = jnp.concatenate([model_state.mask, mask])
    begun = jnp.max(jnp.where(model_state.mask, model_state.order, 0.0)) + 2 * GAP
    order = jnp.concatenate([model_state.order, begun + jnp.arange(len(mask) - len(model_state.mask))])
    tuning, left, used = _fit_car(model_state, Z, Y, mask, config, car)
    # extra columns that the selection of rows ignores
    columns = jnp.column_stack([left, Y, order])
    inputs, columns, valid = select_dictionary(Z, columns, mask, config.size, kernel=config.kernel)
    kept = inputs, columns[:, :3], valid
    fitted = fit_masked(
        *kept, num_restarts=config.restarts, max_iterations=config.max_iterations, num_fit=config.num_fit,
        kernel=config.kernel, shortest=config.shortest if shortest is None else shortest,
        basis=None if known_basis is None else known_basis(kept[0]), key=key,
    )  # fmt: skip
    trust_factor = trust_factors(fitted.gp, Z, left, mask, order, config, known_basis)
    enough = jnp.sum(kept[2]) >= 20
    lags = jnp.where(enough, lags, model_state.residual.lags)
    tuning = jnp.where(enough, tuning, model_state.residual.tuning)
    trust_factor = jnp.where(enough & used & jnp.isfinite(trust_factor), trust_factor, 0.0)
    residual = Residual(fitted.gp, trust_factor, lags, config.bounded, tuning)
    return ModelState(inputs, columns[:, 3:6], valid, columns[:, -1], residual)


def _fit_car(
    model_state: ModelState, Z: Array, Y: Array, mask: Array, config: GPConfig, car: tuple[AnyCar, Array] | None
) -> tuple[Array, Array, Array]:
    """Return the parameters to add, the residual rates that they leave, and whether the GP of these is used."""
    if not config.effects:
        return model_state.residual.tuning, Y, jnp.asarray(True)
    nominal, dt = car or (None, None)
    assert isinstance(nominal, Extended) and dt is not None, "free effects need a car that has them"
    tuning = tune_parameters(nominal, config.effects, Z, Y, mask, dt)
    return tuning, left_over(nominal, tuning, Z, Y, mask, dt), jnp.any(model_state.mask)


def trust_factors(
    gp: GP, Z: Array, Y: Array, mask: Array, order: Array, config: GPConfig, known_basis: KnownEffectBasis | None = None
) -> Array:
    """Return the least-squares factors (3,) in 0..1 on means at held-out rows.

    Rows are held out in `FOLDS` stretches of time (by `order`) of equally many rows, and the GP that predicts a stretch
    is conditioned on the others, without the rows next to it. Rows selected for being far apart are neighbours in no
    other order, and neighbours in time carry the same information. Only the part of the targets outside the known
    effects counts; that part is estimated from the other stretches. The hyper-parameters are those of all rows, the
    same for every stretch: some twenty numbers from hundreds of rows, while a fit per stretch would cost four times as
    much as `update_model` in total.
    """
    last = jnp.where(mask, order, jnp.inf)
    place = jnp.argsort(jnp.argsort(last))  # among the rows that are data, which come first
    fold = place * FOLDS // jnp.maximum(jnp.sum(mask), 1)

    def held_out(index: Array) -> tuple[Array, Array]:
        """Return means and targets (N, 3) at the rows of one stretch, 0 elsewhere."""
        test = mask & (fold == index)
        first, end = jnp.min(jnp.where(test, order, jnp.inf)), jnp.max(jnp.where(test, order, -jnp.inf))
        away = (order < first - GAP) | (order > end + GAP)
        train = select_dictionary(Z, Y, mask & away, config.size, kernel=config.kernel)
        left = Y
        if known_basis is None:
            rest = condition(*train, gp.hyper, *data_scales(*train), config.kernel)
        else:
            inputs, targets, kept = train
            basis = known_basis(inputs)
            left = Y - predict_known_effects(targets, basis, kept, known_basis(Z))
            scale = data_scales(inputs, project_out(targets, basis, kept), kept)
            rest = condition(*train, gp.hyper, *scale, config.kernel, basis)
        values = (jax.vmap(rest.bounded_mean)(Z), left)
        return tuple(jnp.where(test[:, None], one, 0.0) for one in values)  # pyright: ignore[reportReturnType]

    # one after the other: batched factorisations are slow on a CPU
    mean, left = jax.lax.map(held_out, jnp.arange(FOLDS))
    power = jnp.sum(mean**2, axis=(0, 1))
    return jnp.clip(jnp.sum(mean * left, axis=(0, 1)) / jnp.where(power > 0, power, jnp.inf), 0.0, 1.0)
