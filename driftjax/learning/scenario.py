"""Set up an experiment: plants, path, sensors, seeds and controllers as one batch."""

import dataclasses
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.control.driver import Driver, SwitchConfig
from driftjax.control.estimator import Estimator, build_estimator
from driftjax.control.lqr import ScheduledLQR, schedule_lqr
from driftjax.control.mpc import DriftOCP, MPCConfig, Weights, drift_ocp
from driftjax.control.pursuit import pure_pursuit
from driftjax.control.table import ReferenceTable
from driftjax.core import RESULTS, BadInput, Control, State
from driftjax.equilibrium import Branch, Equilibrium, SlipRadius, solve_equilibrium, solve_steady
from driftjax.learning.config import LearnConfig
from driftjax.learning.reference import Corner, entry_horizon, plan_table, steady_corner
from driftjax.parallel import BatchExecutor
from driftjax.planner import Plan, load_plan_config, plan
from driftjax.sim import AnyPlant, batch_of, load_plants
from driftjax.sim.sensors import SensorConfig, load_sensors
from driftjax.solve import Options
from driftjax.track import Track, load_track
from driftjax.vehicle import (
    AnyCar,
    Residual,
    VehicleConfig,
    actuator_lags,
    build_car,
    draw_plants,
    load_vehicle,
)
from driftjax.vehicle.single_track import G

# Offsets folded into an entry's noise key, besides stage numbers for the noise of laps; the key itself draws nothing
LEARNING, SPEEDS, ACQUISITION = 1000, 2000, 3000


@dataclasses.dataclass(frozen=True)
class BatchEntry:
    """Plant, controller and noise seed of one batch entry."""

    plant: str
    controller: str
    seed: int


@dataclasses.dataclass(frozen=True)
class Scenario:
    """Constant data of a run."""

    config: LearnConfig
    vehicle: VehicleConfig
    nominal: AnyCar  # what is known before the first lap: the nominal car, with the effects that were named
    lags: Array  # (2,) of steering and drive that were named, 0 where none was [s]
    track: Track
    plan: Plan
    table: ReferenceTable  # the plan as reference
    corner: Corner
    x_eq: State  # nominal drift equilibrium of the corner
    u_eq: Control
    branch: Branch  # its kind
    batch: tuple[BatchEntry, ...]
    plants: AnyPlant  # one per entry
    keys: Array  # noise key of each entry, used as a parent only
    sensors: SensorConfig
    horizon: int  # stages of the entry problem
    executor: BatchExecutor  # evaluates the batch

    @property
    def batch_size(self) -> int:
        """Return the number of batch entries."""
        return len(self.batch)

    @property
    def margin(self) -> Array:
        """Return the least distance from the centre line to a border, less half the car's width [m]."""
        return jnp.minimum(jnp.min(self.track.w_left), jnp.min(self.track.w_right)) - self.vehicle.width / 2

    def amplitude(self, steering: float, drive: float) -> Array:
        """Return the amplitude (2,) of an excitation of steering [rad] and drive [share of the weight] in rad and N."""
        return jnp.array([steering, drive * self.vehicle.m * G])

    def over_batch(self, tree):
        """Repeat `tree` along a leading batch axis."""
        return repeated(tree, self.batch_size)


@eqx.filter_jit  # one program for all leaves
def repeated(tree, num: int):
    """Repeat `tree` `num` times along a leading axis."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (num, *jnp.shape(a))) if eqx.is_array(a) else a, tree)


class Route(NamedTuple):
    """Car, track and plan before any lap."""

    vehicle: VehicleConfig
    nominal: AnyCar  # with the effects that were named
    track: Track
    plan: Plan
    table: ReferenceTable  # the plan as reference
    corner: Corner
    steady: Equilibrium  # nominal drift equilibrium of the corner
    branch: Branch  # its kind


def route_of(config: LearnConfig, vehicle: VehicleConfig | None = None) -> Route:
    """Read the car and track that `config` names and plan the lap; raises `BadInput` for what does not fit.

    A given `vehicle` overrides the one in `config`, and keeps its own friction ellipse.
    """
    vehicle = load_vehicle(config.vehicle).with_combined_slip(config.combined_slip) if vehicle is None else vehicle
    track = load_track(config.track)
    lap = plan(track, vehicle, load_plan_config(config.plan, config.car))
    if not bool(lap.result == RESULTS.successful):
        raise BadInput(
            f"{config.track}: no minimum-time plan was found with the options {config.plan} "
            f"(violation {float(lap.violation):.2g}); ease its drift device or its speeds."
        )
    if not lap.drift_intervals():
        raise BadInput(f"{config.track}: the plan does not drift anywhere; set 'drift' and 'beta_d' in {config.plan}.")
    table = plan_table(lap)
    nominal, where = build_car(vehicle, config.gp.effects), steady_corner(table, config.drift_beta)
    return Route(vehicle, nominal, track, lap, table, where, *nominal_drift(nominal, where, config))


def build_scenario(
    config: LearnConfig, executor: BatchExecutor, route: Route | None = None, on: tuple[str, AnyPlant] | None = None
) -> Scenario:
    """Set up the batch of `config`, on a given `route` or its own; raises as `route_of` does.

    With `on` (name, plant) all entries use that plant.
    """
    vehicle, nominal, track, lap, table, where, steady, branch = route_of(config) if route is None else route
    batch, plants, keys = lay_out(config, on, float(track.length))
    return Scenario(
        config, vehicle, nominal, actuator_lags(vehicle), track, lap, table, where, steady.x, steady.u, branch,
        batch, plants, keys, load_sensors(config.sensors),
        entry_horizon(table, config.switch.lead, config.switch.trail, config.mpc.dt), executor,
    )  # fmt: skip


def lay_out(
    config: LearnConfig, on: tuple[str, AnyPlant] | None, lap: float
) -> tuple[tuple[BatchEntry, ...], AnyPlant, Array]:
    """Return all batch entries (controller, plant, seed), their plants and noise keys; `on` is one plant for all.

    `lap` is the length of the track [m].
    """
    drawn = (config.distribution, config.plants, config.seed, config.first_plant)
    plants = [] if on else load_plants(config.plant) or draw_plants(*drawn)
    names = [on[0]] if on else [plant.name for plant in plants]
    each = [
        (BatchEntry(name, controller, seed), index)
        for controller in config.controllers
        for index, name in enumerate(names)
        for seed in range(config.noise_seeds)
    ]
    noise = jax.random.key(config.seed)
    keys = [
        jax.random.fold_in(jax.random.fold_in(noise, config.first_plant + index), entry.seed) for entry, index in each
    ]
    if on:
        batch = repeated(on[1], len(each))
    else:
        batch = batch_of([plants[index] for _, index in each], lap, config.mpc.dt / config.lap.substeps)
    return tuple(entry for entry, _ in each), batch, jnp.stack(keys)


def nominal_drift(car: AnyCar, where: Corner, config: LearnConfig) -> tuple[Equilibrium, Branch]:
    """Return the steady state of the corner and its branch: a drift or, where there is none, a slide below the peak.

    Driven wheels at both ends can put the peak of the tyres above the sideslip of the corner.
    """
    fixed = SlipRadius(where.beta, where.R)
    steady = eqx.filter_jit(solve_steady)(car, fixed, branch=Branch.COUNTERSTEER)
    if bool(steady.result == RESULTS.successful):
        return steady, Branch.COUNTERSTEER
    grip = car.tyre.mu * G
    V = jnp.sqrt(grip * abs(where.R))
    guess = State(V, fixed.beta, V / where.R), Control(jnp.zeros(()), car.m * grip * jnp.sin(jnp.abs(fixed.beta)))
    steady = eqx.filter_jit(solve_equilibrium)(car, car, fixed, guess, branch=Branch.GRIP)
    if bool(steady.result == RESULTS.successful):
        return steady, Branch.GRIP
    raise BadInput(f"{config.vehicle}: no drift equilibrium at 'drift_beta' {config.drift_beta}; lower it.")


def problems(scenario: Scenario, residual: Residual) -> DriftOCP:
    """Build the MPC problem of every entry, with its own residual (leading axis) and its controller's weights."""
    config = scenario.config
    weights = [config.path if entry.controller == "path" else config.paper for entry in scenario.batch]
    return _problems(config.mpc, weights, scenario.vehicle, scenario.nominal, residual)


def entry_problems(scenario: Scenario, residual: Residual) -> DriftOCP:
    """Build every entry's corner planning problem: the path controller's, with a larger weight on lateral error."""
    config = scenario.config
    path = config.path
    weights = dataclasses.replace(path, Q_path=(config.entry_error * path.Q_path[0], path.Q_path[1]))
    mpc = dataclasses.replace(config.mpc, horizon=scenario.horizon)
    return _problems(mpc, [weights] * scenario.batch_size, scenario.vehicle, scenario.nominal, residual)


@eqx.filter_jit
def _problems(
    mpc: MPCConfig, weights: list[Weights], vehicle: VehicleConfig, nominal: AnyCar, residual: Residual
) -> DriftOCP:
    like = jax.tree.map(lambda a: a[0], residual)
    each = [drift_ocp(mpc, one, vehicle, like, nominal) for one in weights]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves) if eqx.is_array(leaves[0]) else leaves[0], *each)
    return eqx.tree_at(lambda o: o.residual, stacked, residual)


@eqx.filter_jit
def _gains(ocp: DriftOCP, table: ReferenceTable, num: int, lead: float, rate_factor: float) -> ScheduledLQR:
    """Compute the gains of every entry (leading axis)."""
    one = lambda of: schedule_lqr(of[0], of[1], num, jnp.asarray(lead), jnp.asarray(rate_factor))
    return jax.lax.map(one, (ocp, table))


def build_drivers(
    scenario: Scenario,
    kind: Literal["mpc", "lqr", "pursuit"],
    table: ReferenceTable,
    residual: Residual,
    dither: Array | None = None,
) -> Driver:
    """Build the drivers of the batch: `kind` drives the drift section along `table` (leading axis: batch).

    The drift MPC adds an excitation of amplitude `dither` (batch, 2) [rad, N] to its commands, none if omitted.
    """
    config, vehicle = scenario.config, scenario.vehicle
    ocp = problems(scenario, residual)
    gains = _gains(ocp, table, scenario.horizon, config.switch.lead, config.lqr_price) if kind == "lqr" else None
    options = Options(config.mpc.tolerance, 1.0, config.mpc.max_steps)
    switch: SwitchConfig = config.switch
    pursuit = scenario.over_batch(pure_pursuit(config.pursuit, vehicle))
    limits = scenario.over_batch(jnp.asarray([switch.lead, switch.trail, switch.handover_beta]))
    path, options = scenario.over_batch((scenario.plan.path, options))
    dither = jnp.zeros((scenario.batch_size, 2)) if dither is None else dither
    lead, trail, handover = limits.T
    estimator = scenario.over_batch(_estimator(scenario)) if config.estimator else None
    return Driver(kind, path, table, pursuit, gains, ocp, options, lead, trail, handover, estimator, dither)


def _estimator(scenario: Scenario) -> Estimator:
    car, sensors = scenario.vehicle, scenario.sensors
    noise = jnp.hypot(sensors.of_channels("sigma"), sensors.of_channels("slow"))
    size = scenario.corner.V_b, car.m * G, car.a, car.Iz
    return build_estimator(noise, sensors.delay, scenario.config.mpc.dt, *size)
