"""What does a diagnosis lose without sideslip, drive force, both, or a yaw rate?

`python -m experiments.missing_channels --cases 8` hides one effect (and, in every fifth case, none) in a simulated car,
diagnoses its log with all channels and with some taken out, and writes `missing_channels.json` with a line per case and
`missing_channels.md` with the table.
"""

import dataclasses
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import driftjax as dj
from driftjax.studies.hidden_effects.case import Case
from driftjax.studies.hidden_effects.draw import CaseNumbers, draw_cases
from driftjax.studies.hidden_effects.trial import measured_runs, nominal_vehicle

POSE = ("x", "y", "psi", "s", "e")  # which gives sideslip and yaw rate
MASKS = {
    "all channels": (),
    "no sideslip": ("beta", *POSE),
    "no force": ("Fxr",),
    "neither": ("beta", "Fxr", *POSE),
    "no yaw rate": ("r",),
}
NOTHING_IN = 5  # every so-many-th case hides nothing
HEAD = (
    "| channels | cases | hidden effect first | another claimed beside it | in a set | without it "
    "| nothing hidden: named |"
)


@dataclasses.dataclass(frozen=True)
class Config:
    """Diagnose simulated logs with channels taken out."""

    cases: int = 8
    """Cases of each car."""
    cars: tuple[str, ...] = ("sedan", "rc")
    """Shipped cars."""
    seed: int = 24
    """Of the cases."""
    masks: tuple[str, ...] = tuple(MASKS)
    """Sets of channels."""
    out: Path = Path("runs/missing-channels")
    """Folder for results; cases that it holds are not driven again."""

    def __post_init__(self) -> None:
        if self.cases < 1:
            raise dj.BadInput(f"key 'cases' is {self.cases}; give 1 or more.")
        if unknown := sorted(set(self.masks) - set(MASKS)):
            raise dj.BadInput(f"key 'masks' has '{unknown[0]}'; choose from {', '.join(MASKS)}.")


def main(cfg: Config) -> list[dict[str, Any]]:
    """Diagnose all cases, and write the results after each."""
    cfg.out.mkdir(parents=True, exist_ok=True)
    lines = cfg.out / "missing_channels.jsonl"
    rows = [json.loads(line) for line in lines.read_text().splitlines()] if lines.is_file() else []
    if any("exploratory" not in row for row in rows):
        raise dj.BadInput(f"{lines}: an older version wrote it; choose another folder with --out.")
    done = {(json.dumps(row["case"]), row["channels"]) for row in rows}
    for case in draw_study(cfg):
        runs = None
        for name in cfg.masks:
            if (case.line(), name) in done:
                continue
            runs = measured_runs(case, nominal_vehicle(case)) if runs is None else runs
            rows.append(result_of(case, name, tuple(masked(run, MASKS[name]) for run in runs)))
            print(case.car, case.names or "nothing", "|", name, "|", rows[-1]["verdict"], rows[-1]["named"], flush=True)
            with lines.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(rows[-1]) + "\n")
            (cfg.out / "missing_channels.md").write_text(table(rows), encoding="utf-8")
    print(table(rows))
    return rows


def draw_study(cfg: Config) -> list[Case]:
    """Return the cases of each car: one effect, or none in every `NOTHING_IN`-th."""
    none = cfg.cases // NOTHING_IN
    zero = CaseNumbers(**{field.name: 0 for field in dataclasses.fields(CaseNumbers)})
    return draw_cases(dataclasses.replace(zero, none=none, single=cfg.cases - none), cfg.cars, cfg.seed)


def masked(run: dj.Run, channels: tuple[str, ...]) -> dj.Run:
    """Return `run` as a log without the `channels`."""
    extra = {name: values for name, values in run.extra.items() if name not in channels}
    absent = {name: np.full_like(run.t, np.nan) for name in channels if name not in POSE}
    return dataclasses.replace(run, extra=extra, **absent)


def result_of(case: Case, name: str, runs: tuple[dj.Run, ...]) -> dict[str, Any]:
    """Diagnose `runs`, and compare what is named with the truth."""
    start = time.perf_counter()
    diagnosis = dj.diagnose(nominal_vehicle(case), dj.Log(runs), dj.DiagnoseConfig(0, gp=False, seed=case.seed))
    causes = {cause.effect: [cause.effect, *cause.rivals] for cause in diagnosis.causes}
    return {
        "case": json.loads(case.line()), "channels": name, "verdict": str(diagnosis.verdict), "named": list(causes),
        "hidden": list(case.names), "sets": list(causes.values()), "sentence": diagnosis.sentence,
        "exploratory": [cause.effect for cause in diagnosis.causes if cause.exploratory],
        "seconds": time.perf_counter() - start,
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Return counts per set of channels as a Markdown table."""
    text = [HEAD, "|---|---|---|---|---|---|---|"]
    for name in dict.fromkeys(row["channels"] for row in rows):
        count = Counter(outcome for row in rows if row["channels"] == name for outcome in outcomes(row))
        one, none = count["one hidden"], count["nothing hidden"]
        shares = [f"{count[key]}/{one}" for key in ("first", "beside", "in a set", "false")]
        text.append(f"| {name} | {one + none} | {' | '.join(shares)} | {count['named']}/{none} |")
    return "\n".join(text) + "\n"


def outcomes(row: dict[str, Any]) -> list[str]:
    """Return what happened in one case."""
    if not row["hidden"]:
        return ["nothing hidden"] + ["named"] * bool(row["named"])
    (hidden,), named = row["hidden"], row["named"]
    inside = any(hidden in one for one in row["sets"])
    claimed = row["verdict"] in ("NAMED", "SET")
    beside = {*named} - {hidden, *row["exploratory"]}
    outcomes = {"first": named[:1] == [hidden], "beside": hidden in named and bool(beside), "in a set": inside,
            "false": claimed and not inside}  # fmt: skip
    return ["one hidden", *(key for key, true in outcomes.items() if true)]


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, prog="python -m experiments.missing_channels"))
    except dj.BadInput as error:
        sys.exit(f"missing_channels: {error}")
