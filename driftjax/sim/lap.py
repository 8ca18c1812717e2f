"""Drive closed-loop laps of a batch of plants and noise seeds, each with its own driver, in one scan."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from driftjax.core import Control, as_float, require_positive
from driftjax.parallel import vmap_batch
from driftjax.sim.sensors import SensorConfig, first_slow_errors, measure, next_slow_errors
from driftjax.sim.travel import Travel
from driftjax.sim.universal_plant import AnyPlant
from driftjax.track import Track
from driftjax.vehicle import Motion, PlantState


class LapCode(IntEnum):
    """How a lap ended; every code but `RUNNING` and `COMPLETED` is a failure."""

    RUNNING = 0
    COMPLETED = 1
    SPUN = 2
    OFF_TRACK = 3
    STALLED = 4
    TIMEOUT = 5
    NON_FINITE = 6


@dataclass(frozen=True)
class LapConfig:
    """Failure criteria of a lap and integration step of the plant."""

    time_limit: float = 14.0
    """Longest lap [s]."""
    substeps: int = 50
    """Plant steps per control step."""
    spin_beta: float = 1.5
    """Sideslip beyond which the car has spun [rad]."""
    stall_speed: float = 1.5
    """Speed below which the car has stalled [m/s]."""
    lost_error: float = 8.0
    """Distance from the planned path at which the lap is lost [m]."""

    def __post_init__(self) -> None:
        require_positive(self, "time_limit", "substeps", "spin_beta", "lost_error")


class Sensed(NamedTuple):
    """Measurements available to a driver, and their projection onto the planned path."""

    V: Array  # [m/s]
    beta: Array  # [rad]
    r: Array  # [rad/s]
    x: Array  # [m]
    y: Array  # [m]
    psi: Array  # [rad]
    s: Array  # arc length along the planned path [m]
    e: Array  # offset from it, left positive [m]
    theta: Array  # heading less that of the path, in (-pi, pi] [rad]


class Trace(NamedTuple):
    """One control step of each batch entry; a lap is a stack of these, valid where `alive`."""

    alive: Array  # whether the lap was still running
    sensed: Sensed
    V: Array  # true values from here
    beta: Array
    r: Array
    x: Array
    y: Array
    psi: Array
    s: Array
    e: Array
    delta: Array  # actual road-wheel angle [rad]
    Fxr: Array  # actual axle force [N]
    command: Control
    decision: Any  # the policy's own record of the step


class Laps(eqx.Module):
    """Laps of a batch: traces (batch, steps) and how each lap ended."""

    trace: Trace
    code: Array  # (batch,) of LapCode
    dt: Array


class _Carry(NamedTuple):
    plant: PlantState | Travel
    command: Control  # acting now
    pending: tuple[Control, ...]  # commands on their way to the actuators, the oldest first
    slow: Array  # (batch, 6) slow errors of the sensors
    s: Array
    true_s: Array
    code: Array
    memory: Any


Policy = Callable[[Sensed, Any, Array], tuple[Control, Any, Any]]


def wrap(angle: Array) -> Array:
    """Wrap an angle to (-pi, pi]."""
    return -jnp.mod(jnp.pi - angle, 2 * jnp.pi) + jnp.pi


def where_tree(flag: Array, new: Any, old: Any) -> Any:
    """Select `new` in the batch entries where `flag` holds and `old` in the others, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(flag.reshape(flag.shape + (1,) * (a.ndim - 1)), a, b), new, old)


def _judge(plant: AnyPlant, state: Any, command: Control, path: Track, s: Array, config: LapConfig):
    """Return true arc length, offset, motion and lap code of one batch entry after a step."""
    motion = plant.motion(state, command)
    s, e = path.project(motion.x, motion.y, s)
    code = jnp.where(s >= path.length - 0.5 * path.spacing, int(LapCode.COMPLETED), int(LapCode.RUNNING))
    code = jnp.where(motion.V < config.stall_speed, int(LapCode.STALLED), code)
    code = jnp.where(jnp.abs(e) > config.lost_error, int(LapCode.OFF_TRACK), code)
    code = jnp.where(jnp.abs(motion.beta) > config.spin_beta, int(LapCode.SPUN), code)
    finite = jnp.isfinite(motion.V) & jnp.isfinite(s) & jnp.isfinite(motion.r)
    return s, e, motion, jnp.where(finite, code, int(LapCode.NON_FINITE))


def _at_start(
    plants: AnyPlant, paths: Track, speed: Array, memory: Any, sensors: SensorConfig, pending: int, keys: Array
) -> _Carry:
    """Return the initial states: every car rolls at `speed` [m/s] along the start of its path."""
    x0, y0, psi0, _ = vmap_batch(lambda p: p.pose(0.0))(paths)
    state = vmap_batch(lambda p, *start: p.rolling(*start))(plants, speed, x0, y0, psi0)
    zero = jnp.zeros_like(speed)
    slow, none = vmap_batch(lambda key: first_slow_errors(sensors, key=key))(keys), Control(zero, zero)
    code = jnp.full(speed.shape, int(LapCode.RUNNING))
    return _Carry(state, none, pending * (none,), slow, zero, zero, code, memory)


def sensed_on(path: Track, s: Array, V: Array, beta: Array, r: Array, x: Array, y: Array, psi: Array) -> Sensed:
    """Return a motion with its place along `path`; `s` [m] is a first guess of its arc length."""
    s, e = path.project(x, y, s)
    return Sensed(V, beta, r, x, y, psi, s, e, wrap(psi - path.pose(s)[2]))


def _sense(
    sensors: SensorConfig, plant: AnyPlant, state: Any, command: Control, path: Track, s: Array, slow: Array, key: Array
) -> tuple[Motion, Sensed]:
    """Return the true motion and the measurements of one batch entry; `s` [m] is its last arc length."""
    motion = plant.motion(state, command)
    m = measure(plant.sensor_reading(state, motion), sensors, key=key, slow=slow)
    return motion, sensed_on(path, s, *m)


def _scan_laps(step: Callable[[_Carry, Array], tuple[_Carry, Trace]], carry: _Carry, num: int) -> tuple[_Carry, Trace]:
    """Scan over `num` steps; those after the end of the last lap are skipped and their rows are zeros."""
    steps = jnp.arange(num)
    shapes = jax.eval_shape(lambda c: step(c, steps[0])[1], carry)
    blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)

    def step_or_rest(carry: _Carry, k: Array) -> tuple[_Carry, Trace]:
        anyone = jnp.any(carry.code == int(LapCode.RUNNING))
        return jax.lax.cond(anyone, step, lambda c, _: (c, blank), carry, k)

    return jax.lax.scan(step_or_rest, carry, steps)


class _Delay(NamedTuple):
    """Delay of the commands: whole control steps, and plant steps into the next one."""

    whole: int
    part: int

    @property
    def pending(self) -> int:
        """Return the number of commands that are on their way at the start of a step."""
        return self.whole + (self.part > 0)


def _delay(sensors: SensorConfig, config: LapConfig, dt: float) -> _Delay:
    return _Delay(*divmod(round(sensors.delay * config.substeps / dt), config.substeps))


def _advance(
    plant: AnyPlant, state: Any, commands: tuple[Control, ...], dt: Array, substeps: int, part: int
) -> Any:  # fmt: skip
    """Advance one batch entry by a control step: the first command acts for `part` plant steps, the second after."""
    if part:
        state = plant.advance(state, commands[0], dt * part / substeps, part)
    return plant.advance(state, commands[-1], dt * (substeps - part) / substeps, substeps - part)


def drive(
    plants: AnyPlant,
    paths: Track,
    speed: Array,
    policy: Policy,
    memory: Any,
    sensors: SensorConfig,
    config: LapConfig,
    *,
    dt: float,
    keys: Array,
) -> Laps:
    """Drive one lap per batch entry (leading axis of `plants`, `paths`, `speed` [m/s], `memory`, `keys`).

    `policy` maps measurements, its memory and the flags of the running laps to commands, new memory and a record of
    the decision. Commands act after the `delay` of the sensors, rounded to steps of the plant. An entry that spins,
    stalls, leaves the path or becomes non-finite is frozen with its code; the others continue. The noise of an entry
    depends on its own key only, so that a batch equals its single laps.
    """
    step_time, delay = as_float(dt), _delay(sensors, config, dt)
    advance = lambda p, x, u: _advance(p, x, u, step_time, config.substeps, delay.part)
    sense: Callable[..., tuple[Motion, Sensed]] = vmap_batch(partial(_sense, sensors))

    @jax.jit  # traced once for its shapes and for the scan
    def step(carry: _Carry, k: Array) -> tuple[_Carry, Trace]:
        alive = carry.code == int(LapCode.RUNNING)
        key = vmap_batch(lambda one: jax.random.fold_in(one, k))(keys)
        motion, sensed = sense(plants, carry.plant, carry.command, paths, carry.s, carry.slow, key)
        command, memory, decision = policy(sensed, carry.memory, alive)
        queue = (*carry.pending, command)
        acting = queue[: len(queue) - delay.whole]  # those that act during this step
        after = vmap_batch(advance)(plants, carry.plant, acting)
        judged = vmap_batch(lambda p, x, u, path, s: _judge(p, x, u, path, s, config))
        true_s, _, _, code = judged(plants, after, acting[-1], paths, carry.true_s)
        now_s, now_e, _, _ = judged(plants, carry.plant, acting[-1], paths, carry.true_s)
        slow = vmap_batch(lambda c, key: next_slow_errors(sensors, c, step_time, key=key))(carry.slow, key)
        later = _Carry(after, acting[-1], queue[1:] if carry.pending else (), slow, sensed.s, true_s, code, memory)
        new = where_tree(alive, later, carry)
        trace = Trace(alive, sensed, *motion[:6], now_s, now_e, motion.delta, motion.Fxr, command, decision)
        return new, trace

    num = max(1, round(config.time_limit / dt))  # 0.3 / 0.1 is below 3
    last, trace = _scan_laps(step, _at_start(plants, paths, speed, memory, sensors, delay.pending, keys), num)
    code = jnp.where(last.code == int(LapCode.RUNNING), int(LapCode.TIMEOUT), last.code)
    return Laps(jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), trace), code, step_time)
