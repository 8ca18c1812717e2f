"""What does `diagnose` make of logs of a car that shares no code with driftjax? `experiments/independent` is that car.

`python -m experiments.independent_study --cases 40 --alarms 40` draws logs with nothing to six effects hidden, and logs
in which only sensors err, diagnoses each, and writes results.jsonl, alarms.jsonl (a line per case as soon as it is
done; started again it goes on), scores.json and scores.md.
"""

import dataclasses
import json
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tyro

import driftjax as dj
from driftjax.studies.hidden_effects.against_truth import nominal_scores, penalised_costs
from experiments.independent.cases import Case, draw_alarm, draw_case
from experiments.independent.record import write_csv
from experiments.independent.score import Result, alarm_table, effects_of_body, line, right_verdict, score, table


@dataclasses.dataclass(frozen=True)
class Config:
    """Hide effects in an independent car and see what `diagnose` makes of its logs."""

    cases: int = 40
    """Logs with nothing to six effects hidden, of sedan and RC car in turn."""
    alarms: int = 0
    """Logs in which only the sensors err."""
    first: int = 0
    """Number of the first case."""
    seed: int = 2026
    """Of the draw."""
    out: Path = Path("runs/independent")
    """Folder of the results; cases that are there are not diagnosed again."""


def run_case(case: Case) -> Result:
    """Record, log, read and diagnose one case; return plain values."""
    vehicle = dj.load_vehicle(case.car)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        write_csv(path, case.record())
        log = dj.read_log(path)
    start, used = time.perf_counter(), time.process_time()
    diagnosis = dj.diagnose(vehicle, log, dj.DiagnoseConfig(gp=False, seed=case.seed))
    seconds = {"seconds": time.perf_counter() - start, "seconds_cpu": time.process_time() - used}
    content = diagnosis.content()
    kept = {name: content[name] for name in ("verdict", "sentence", "causes", "explained", "answer", "unexplained")}
    kept |= {"ratio": content["gain"]["ratio"], "skill": content["gain"]["skill"]}
    result = {"case": dataclasses.asdict(case), "runs": len(log.runs)} | seconds | kept
    if diagnosis.evidence is None:
        return result
    costs = penalised_costs(diagnosis.evidence, case.hidden, effects_of_body(case.body))
    return result | {"looks": nominal_scores(diagnosis.evidence, set(case.hidden)), "prices": costs}


def read_results(path: Path) -> list[Result]:
    """Return the results so far."""
    return [json.loads(row) for row in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []


def run_all(cases: list[Case], path: Path, run: Callable[[Case], Result] = run_case) -> list[Result]:
    """Return the results of all `cases`, those in the file and the others, which are added to it one by one.

    Raises `BadInput` where the file holds other cases under these numbers.
    """
    plain = {case.number: json.loads(json.dumps(dataclasses.asdict(case))) for case in cases}
    results = [one for one in read_results(path) if one["case"]["number"] in plain]
    if any(one["case"] != plain[one["case"]["number"]] for one in results):
        raise dj.BadInput(f"{path}: holds the results of other cases; give another --out or the same --seed.")
    done = {one["case"]["number"] for one in results}
    for case in cases:
        if case.number in done:
            continue
        try:
            result = run(case)
        except Exception:  # counts as a failure
            result = {"case": plain[case.number], "error": traceback.format_exc()}
        with path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(result) + "\n")
        results.append(json.loads(json.dumps(result)))
        print(line(results[-1]), file=sys.stderr, flush=True)
    return sorted(results, key=lambda one: one["case"]["number"])


def main(cfg: Config) -> dict[str, Any]:
    """Run both studies; write and return the scores."""
    cfg.out.mkdir(parents=True, exist_ok=True)
    number = lambda num: range(cfg.first, cfg.first + num)
    main_results = run_all([draw_case(cfg.seed, i) for i in number(cfg.cases)], cfg.out / "results.jsonl")
    alarms = run_all([draw_alarm(cfg.seed, i) for i in number(cfg.alarms)], cfg.out / "alarms.jsonl")
    text = "\n\n".join([*([table(main_results)] if main_results else []), *([alarm_table(alarms)] if alarms else [])])
    scored = lambda results: [
        score(one) | {"number": one["case"]["number"], "right_verdict": right_verdict(one)}
        for one in results
        if "error" not in one
    ]
    content = {"seed": cfg.seed, "cases": scored(main_results), "alarms": scored(alarms)}
    (cfg.out / "scores.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    (cfg.out / "scores.md").write_text(text + "\n", encoding="utf-8")
    print(text)
    return content


if __name__ == "__main__":
    try:
        main(tyro.cli(Config, prog="python -m experiments.independent_study"))
    except dj.BadInput as error:
        sys.exit(f"independent_study: {error}")
