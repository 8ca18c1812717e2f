"""Cases of the study: which car, what is hidden in it, how it is driven and measured, all drawn from one seed."""

from dataclasses import dataclass
from typing import Any

import numpy as np

import driftjax as dj
from experiments.independent.car import PARAMETERS, Car, Size
from experiments.independent.driver import CAMPAIGN, Limits
from experiments.independent.record import STEP, Sensors, record
from experiments.independent.score import family_of

COUNTS = (1, 2, 4, 1, 3, 0, 2, 5, 1, 6)  # effects hidden in one case after another, so that every prefix is a sample
CARS = ("sedan", "rc")
TRACK = 0.85  # distance of left and right wheels over the width of the car [-]
RUN = 10.0  # length of a run [s]
OF_SENSORS = tuple(name for name in PARAMETERS if family_of(name) in ("sensor", "time base"))


@dataclass(frozen=True)
class Case:
    """One log with its truth."""

    number: int
    car: str
    """Shipped car whose numbers the plant has, but for what is hidden."""
    hidden: dict[str, dict[str, float]]
    """Effect -> parameter -> value, SI."""
    body: float
    """Strength of what the catalogue has no word for: track width in the slip, inertia of a body that rolls [-]."""
    sensors: Sensors
    manoeuvres: tuple[str, ...]
    seed: int

    def record(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the columns of each run by its name."""
        vehicle = dj.load_vehicle(self.car)
        plant = Car(size_of(vehicle), self.hidden, self.body)
        return record(plant, Limits(*vehicle.command_limits()), self.manoeuvres, self.sensors, self.seed, RUN)


def size_of(vehicle: dj.VehicleConfig) -> Size:
    """Return the numbers of the nominal car."""
    v = vehicle
    return Size(v.m, v.Iz, v.a, v.b, v.mu, v.B, v.C, TRACK * v.width)


def hidden_parameters(name: str) -> list[Any]:
    """Return the parameters of the effect `name` that the plant hides; others of the catalogue follow from these."""
    (effect,) = dj.effects_by_name((name,))
    return [p for p in effect.parameters if p.name in PARAMETERS[name]]


def draw_effect(name: str, vehicle: dj.VehicleConfig, rng: np.random.Generator) -> dict[str, float]:
    """Return the parameters of an effect, SI: 0.5 to 1.5 of their typical sizes, either sign where there are two."""
    values = {}
    for parameter in hidden_parameters(name):
        both = parameter.lower < 0 and name != "combined_slip"  # of which the published car has none to take away
        size = rng.uniform(0.5, 1.5) * (rng.choice([-1, 1]) if both else 1)
        values[parameter.name] = float(size * parameter.scale(vehicle))
    if name == "steer_delay":
        values["d"] = round(values["d"] / STEP) * STEP
    if name == "channel_delay":  # one clock: of the satellite receiver, the gyroscope or both
        late = [("d_V", "d_beta"), ("d_r",), ("d_V", "d_beta", "d_r")][rng.integers(3)]
        values = {one: values["d_r"] if one in late else 0.0 for one in values}
    return values


def draw_names(num: int, rng: np.random.Generator) -> list[str]:
    """Draw `num` effects; friction of both axles and of one axle exclude each other."""
    while True:
        names = [str(name) for name in rng.choice(list(PARAMETERS), num, replace=False)]
        if not ("friction" in names and {"friction_front", "friction_rear"} & set(names)):
            return names


def draw_runs(rng: np.random.Generator) -> tuple[str, ...]:
    """Return the manoeuvres of 60 or of 120 s in random order."""
    return tuple(rng.permutation(CAMPAIGN[: rng.choice([6, 12])]).tolist())


def draw_case(seed: int, number: int) -> Case:
    """Return a case of the main study."""
    rng, car = np.random.default_rng((seed, number)), CARS[number % 2]
    num = COUNTS[number // 2 % len(COUNTS)]
    vehicle = dj.load_vehicle(car)
    hidden = {name: draw_effect(name, vehicle, rng) for name in draw_names(num, rng)}
    sensors = Sensors(
        noise=rng.uniform(0.5, 1.2), coloured=rng.uniform(0.2, 0.8), correlation=rng.uniform(0.1, 0.5),
        gusts=rng.uniform(0.2, 1.0), dropouts=rng.choice([0.0, 0.02]), further=bool(rng.integers(2)),
    )  # fmt: skip
    body = 1.0 if num > 2 else float(rng.integers(2))
    return Case(number, car, hidden, body, sensors, draw_runs(rng), int(rng.integers(2**31)))


def draw_alarm(seed: int, number: int) -> Case:
    """Return a case in which the simulation is right, and the sensors are coloured, biased and dropping out."""
    rng, car = np.random.default_rng((seed, 1, number)), CARS[number % 2]
    vehicle, wrong = dj.load_vehicle(car), rng.choice(OF_SENSORS, rng.integers(0, 3), replace=False)
    hidden = {str(name): draw_effect(str(name), vehicle, rng) for name in wrong}
    sensors = Sensors(
        noise=rng.uniform(0.5, 2.0), coloured=rng.uniform(0.5, 0.95), correlation=rng.uniform(0.1, 1.0),
        gusts=rng.uniform(0.2, 1.0), dropouts=rng.uniform(0.0, 0.1), further=bool(rng.integers(2)),
    )  # fmt: skip
    return Case(number, car, hidden, 0.0, sensors, draw_runs(rng), int(rng.integers(2**31)))
