"""Interpret the name and unit of a column: which channel it may be, and its factor to SI."""

import re
from typing import NamedTuple

from driftjax.logs.unit_words import UNITS, Unit, parse_unit

FORCE = {"fx", "fxr", "fxcmd", "force"}
NO_SUFFIX = {"n", "c", "v", "w"}  # units that end many names as something else
PAIRS = {"m s": "mps", "km h": "kmh", "rad s": "radps", "deg s": "degps", "m s2": "mps2", "rad s2": "radps2"}
DIMENSIONS = {"t": "time", "V": "speed", "vx": "speed", "vy": "speed", "beta": "angle", "r": "rate", "psi": "angle",
              "x": "length", "y": "length", "e": "length", "ax": "acceleration", "ay": "acceleration", "delta": "angle",
              "Fxr": "force", "latitude": "angle", "longitude": "angle", "s": "length", "wfl": "rate", "wfr": "rate",
              "wrl": "rate", "wrr": "rate"}  # fmt: skip

_AHEAD, _ACROSS = r"(x|lon|long|longitudinal|inline|fwd|forward)", r"(y|lat|lateral)"
_VEL, _ACC = r"(v|u|vel|velocity|speed)", r"(a|acc|accel|acceleration|g force|linear acceleration|linacc)"
_GYRO = r"(gyro|gyr|gyroscope|angular velocity|angular|ang vel|omega|w|twist angular)"
_EARTH = r"((gps|gnss|ins|nav|fix|pos|position) )*"
_WHEEL = r"(w|wheel|wheel speed|ws|omega|enc|encoder|wheelspeed)"
# whole names with the score of each; words of a unit are taken off first
PATTERNS: dict[str, list[tuple[str, float]]] = {
    "t": [(r"t|time|timestamp|stamp|elapsed|elapsed time|sim time|time stamp", 1.0),
          (r"t \d+|(.* )?(time|stamp|timestamp)( .*)?", 0.5)],
    "V": [(r"v|speed|velocity|vel|ground ?speed|gps speed|vehicle speed|car v|car speed|v (abs|total|tot|norm)", 1.0),
          (r"(.* )?(speed|velocity|vel)", 0.6)],
    "vx": [(r"vx|ux|u|v ?" + _AHEAD, 1.0), (rf"{_VEL} {_AHEAD}", 1.0), (rf"{_AHEAD} {_VEL}", 1.0),
           (r".*(twist|velocity|vel)( linear)? x", 1.0), (r".* (vx|ux)", 0.9)],
    "vy": [(r"vy|uy|v ?" + _ACROSS, 1.0), (rf"{_VEL} {_ACROSS}", 1.0), (rf"{_ACROSS} {_VEL}", 1.0),
           (r".*(twist|velocity|vel)( linear)? y", 1.0), (r".* (vy|uy)", 0.9)],
    "beta": [(r"beta|side ?slip|slip|(side ?)?slip angle|attitude angle", 1.0),
             (r".* (beta|side ?slip( angle)?)", 0.9)],
    "r": [(r"r|yaw ?rate|yaw ?r|yaw velocity|psi ?dot|omega|omega z|wz|gyro yaw velocity|yaw speed", 1.0),
          (rf"(.* )?{_GYRO} z", 0.9), (r".* (yaw ?rate|yaw velocity|r)", 0.9),
          (r"(.* )?yaw|d ?psi", 0.6)],
    "psi": [(r"psi|heading|yaw|yaw angle|theta|heading angle", 1.0), (r".* (psi|heading|yaw|theta)", 0.9),
            (r"(psi|heading|yaw) .*", 0.7)],
    "x": [(r"x|px|pos x|position x|x pos|east|easting|pos ?e|e pos|pos east", 1.0),
          (r".*(pose|position|pos)( position)? x|car( fr1)? tx", 1.0), (r".* (x|east|tx)", 0.5)],
    "y": [(r"y|py|pos y|position y|y pos|north|northing|pos ?n|n pos|pos north", 1.0),
          (r".*(pose|position|pos)( position)? y|car( fr1)? ty", 1.0), (r".* (y|north|ty)", 0.5)],
    "ax": [(r"ax|a ?" + _AHEAD, 1.0), (rf"(.* )?{_ACC} {_AHEAD}", 1.0), (rf"(.* )?{_AHEAD} {_ACC}", 1.0),
           (r"(.* )?inline ?acc", 1.0), (r".* ax", 0.9), (r"(lon|long) ?acc", 1.0)],
    "ay": [(r"ay|a ?" + _ACROSS, 1.0), (rf"(.* )?{_ACC} {_ACROSS}", 1.0), (rf"(.* )?{_ACROSS} {_ACC}", 1.0),
           (r"(.* )?lateral ?acc", 1.0), (r".* ay", 0.9), (r"lat ?acc", 1.0)],
    "delta": [(r"delta|steer(ing|ed)? angle|road ?wheel( angle)?|(.* )?steer(ing)? ang(le)?", 1.0),
              (r"steer|steering", 0.95),
              (r"(.* )?(delta|steer|steering)( .*)?", 0.7)],
    "Fxr": [(r"fxr?|fxcmd|(drive|longitudinal|rear|traction) ?force|fx r(ear)?|force", 1.0), (r".* (fxr?|force)", 0.8)],
    "latitude": [(rf"{_EARTH}lat|(.* )?latitude", 1.0)],
    "longitude": [(rf"{_EARTH}(lon|long|lng)|(.* )?longitude", 1.0)],
    "s": [(r"(.* )?s|arc ?length|station", 1.0)],
    "e": [(r"(.* )?e|lateral (error|offset|deviation)", 1.0)],
    **{f"w{corner}": [(rf"w{corner}|{_WHEEL} ?({corner}|{corner[::-1]})|({corner}|{corner[::-1]}) {_WHEEL}", 1.0)]
       for corner in ("fl", "fr", "rl", "rr")},
}  # fmt: skip
COMPILED = {
    role: [(re.compile(one), name_score) for one, name_score in patterns] for role, patterns in PATTERNS.items()
}
DOUBTS = {"filt": 0.8, "filtered": 0.8, "raw": 0.9, "ref": 0.3, "reference": 0.3, "des": 0.3, "desired": 0.3,
          "target": 0.3, "sim": 0.6, "est": 0.9, "std": 0.2, "cov": 0.1, "covariance": 0.1, "sigma": 0.2, "error": 0.2,
          "err": 0.2, "status": 0.1, "imu": 0.9, "gps": 0.95, "fl": 0.7, "fr": 0.7, "max": 0.3, "min": 0.3,
          "acc": 0.3, "feedforward": 0.4, "fb": 0.4, "ff": 0.4, "cmd": 0.4, "command": 0.4, "commanded": 0.4,
          "setpoint": 0.4}  # fmt: skip
COMMANDED = {"cmd", "command", "commanded", "setpoint"}
NEVER_DOUBT = {"ax": {"acc", "raw"}, "ay": {"acc", "raw"}, "wfl": {"fl"}, "wfr": {"fr"},
               "delta": {"des", "raw", *COMMANDED}, "Fxr": COMMANDED}  # fmt: skip
ASIDES = {"cmd", "command", "meas", "measured", "data", "filt", "filtered", "raw", "imu", "int", "map", "out", "value",
          "cg", "cog", "com"}  # fmt: skip
OF_GPS = ("r", "ax", "ay")  # what a GPS computes from the course, and measures not at all
UNKNOWN = 0.05  # score of a name without information, for every channel


class Meaning(NamedTuple):
    """Meaning of the name and unit of a column."""

    unit: Unit | None
    name_score: dict[str, float]
    """How well each channel fits, from 0 to 1; `UNKNOWN` where name and unit say nothing against it."""


def meaning(name: str, unit: str = "") -> Meaning:
    """Interpret the `name` and, if the file states one, the `unit` of a column."""
    words, in_name = _split_unit(name)
    last, _ = _split_unit(re.sub(r"\.\d+$", "", name).rpartition(".")[2])  # without the struct or topic that it is in
    known = parse_unit(unit) or in_name
    name_score = {}
    for role, dimension in DIMENSIONS.items():
        if known is not None and known.dimension != dimension:
            name_score[role] = 0.0
            continue
        derived = role in OF_GPS and "gps" in words
        of_vector = len("".join(last)) < 2 and role != "t"  # the x of a vector says little, but none has a t
        alone = 0.0 if of_vector else _pattern_score(last, role)
        named = max(_pattern_score(words, role), alone)
        named **= 1.0 if known is None else 0.5  # a unit that fits makes up for much
        name_score[role] = 0.0 if derived else max(named, UNKNOWN)
    if known is None:  # wheel speeds are in rad/s or in m/s: the name alone does not tell
        name_score |= {role: 0.0 for role in ("wfl", "wfr", "wrl", "wrr")}
    return Meaning(known, name_score)


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case: `Car.YawRate` has car, yaw and rate."""
    apart = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    return re.findall(r"[a-z]+\d*|\d+", apart.lower())


def _split_unit(name: str) -> tuple[list[str], Unit | None]:
    """Return the words of a name without its unit, and that."""
    if bracket := re.search(r"[\[(]([^\[\]()]+)[\])]\s*$", name):
        if (unit := parse_unit(bracket[1])) is not None:
            return words_of(name[: bracket.start()]), unit
    words = words_of(re.sub(r"\.\d+$", "", name))  # the number of a column in a matrix
    if len(words) > 2 and (pair := PAIRS.get(" ".join(words[-2:]))):
        return words[:-2], UNITS[pair]
    if len(words) > 1 and words[-1] in UNITS and (words[-1] not in NO_SUFFIX or FORCE & set(words)):
        return words[:-1], UNITS[words[-1]]
    return words, None


def _pattern_score(words: list[str], role: str) -> float:
    """Return how well words name a channel; commanded steering and force are what the log format wants."""
    doubt = 1.0
    for word in words:
        if word not in NEVER_DOUBT.get(role, ()):
            doubt *= DOUBTS.get(word, 1.0)
    text = " ".join([word for word in words if word not in ASIDES] or words)
    return doubt * max((name_score for pattern, name_score in COMPILED[role] if pattern.fullmatch(text)), default=0.0)
