"""Write the page of a diagnosis, from the run folder alone."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import xarray as xr

from driftjax.core import write_text
from driftjax.logs.columns import MEASURED
from driftjax.report.diagnosis import (
    TITLES,
    closed_loop_notes,
    closed_loop_rows,
    diagnosis_figures,
    gain_rows,
    nominal_error_rows,
    parity_statement,
    residual_force_rows,
)
from driftjax.report.drives import diagnosis_drives, shown_vehicle
from driftjax.report.error_share import waterfall
from driftjax.report.evidence import best_scores
from driftjax.report.html import (
    Cell,
    collapsible,
    document,
    figures,
    html_heading,
    image,
    paragraph,
    quantities,
    quantity,
    section,
    stage_for,
    table,
)
from driftjax.report.player import player_data
from driftjax.report.predictions import drawn_models
from driftjax.report.style import save
from driftjax.report.table import with_interval
from driftjax.store import RunFolder
from driftjax.vehicle.effect import EFFECTS

NEXT = {
    "NOTHING": "Nothing: these data show no error of the simulation. A log that excites the car more may.",
    "NAMED": "Nothing more, to name these causes. Use extended.yaml, the corrected car, where a vehicle is asked for.",
    "SET": "These data do not tell the effects of the set apart; drive a run in which they differ.",
    "UNKNOWN": "Look at the variables that the rest goes with, below, and add the physics that is missing.",
    "DATA_INSUFFICIENT": "Record more: longer runs, with stronger steering and drive.",
}  # where no manoeuvre is proposed
MODELS = {
    "nominal": "nominal car",
    "retuned": "re-tuned tyres",
    "extended": "extended car",
    "gp": "Gaussian process",
    "extended_gp": "extended car with a Gaussian process",
    "noise_floor": "a right model: noise floor",
}  # in the words of the legends


def write_diagnosis(folder: RunFolder | str | Path) -> Path:
    """Write figures/*.png and .pdf and report.html of a diagnosis from its folder alone; return the page's path."""
    run = RunFolder.open(folder)
    pictures = [save(figure, run.path / "figures", name) for name, figure in diagnosis_figures(run)]
    page, text = run.path / "report.html", diagnosis_page(run, pictures)
    write_text(page, text)
    return page


def diagnosis_page(run: RunFolder, pictures: list[Path]) -> str:
    """Return the page of a diagnosis, with the PNGs `pictures` at its end."""
    content = run.read_json("diagnosis")
    data = run.read_dataset("diagnosis.nc") if run.has("diagnosis.nc") else None
    parts, shown = [_verdict(content)], content.get("show")
    page: dict[str, Any] = {
        "waterfall": waterfall(content),
        "explained": content.get("explained"),
        "causes": [cause_errors(cause, content["gain"]) for cause in content.get("causes", ())],
    }
    if page["waterfall"]:
        parts.append(
            section("Share of each cause in the error", [stage_for("waterfall", "Shares of the excess error")])
        )
    if content.get("causes"):
        parts.append(section("Causes", [_cause(k, cause, content) for k, cause in enumerate(content["causes"])]))
    if data is not None:
        page |= {
            "player": player_data(shown_vehicle(run), diagnosis_drives(data)),
            "curves": horizon_data(data),
            "forces": force_data(data),
            "score_threshold": data.attrs["score_threshold"],
        }
        parts += list(_data_sections(data, shown))
    if shown:
        parts.append(section("Gain on held-out runs", _gain(content["gain"])))
    if driven := content.get("closed_loop"):
        rows = closed_loop_rows(driven)
        words = f"{' '.join(closed_loop_notes(driven))} Source: diagnosis.json, closed_loop."
        parts.append(
            section("Closed loop", [table(rows[0], quantities(rows[1:], "diagnosis.json: closed_loop"), words)])
        )
    parts += figures([image(path, *TITLES[path.stem]) for path in pictures])
    named = (
        ("Data and noise (diagnosis.json, data)", content["data"]),
        ("Configuration (config.yaml)", run.config),
        ("Versions (versions.json)", run.read_json("versions")),
    )
    parts.append(section("How this was made", [collapsible(title, one) for title, one in named]))
    car = run.config.get("vehicle", {}).get("name", "")
    return document(f"driftjax diagnose: {car}".rstrip(": "), run.created, parts, {"diagnosis": page})


def _verdict(content: dict[str, Any]) -> str:
    """Return verdict, sentence and what to drive next."""
    verdict, proposal = content["verdict"], content.get("next_manoeuvre")
    joint = _joint_error_share(content)
    parts = [
        *([paragraph(joint, "lead")] if joint else []),
        paragraph(content["sentence"], "" if joint else "lead"),
        paragraph("Source: diagnosis.json, verdict, sentence and explained.", "source"),
        html_heading("What to drive next"),
    ]
    if not proposal:
        return section(f"Verdict: {verdict}", [*parts, paragraph(NEXT.get(verdict, ""))])
    parts.append(paragraph(proposal.get("sentence") or f"Drive {proposal['manoeuvre']}."))
    if others := proposal.get("others"):
        rows = [
            [name, Cell(f"{share:.2f}", f"diagnosis.json: next_manoeuvre.others.{name}", share)]
            for name, share in others.items()
        ]
        parts.append(
            table(
                ("manoeuvre", "expected"),
                rows,
                "What each manoeuvre should bring the least sure probability "
                "to. Source: diagnosis.json, next_manoeuvre.others.",
            )
        )
    return section(f"Verdict: {verdict}", parts)


def cause_errors(cause: dict[str, Any], gain: dict[str, Any]) -> dict[str, Any]:
    """Return the held-out error per channel over that of a right model: nominal, without the cause, with all causes.

    1 is the noise floor. Without the cause: value and 95 % interval, the others refitted.
    """
    rmse, name = gain["rmse"], cause["effect"]
    without = gain.get("without", {}).get(name, {})
    if "noise_floor" not in rmse or "extended" not in rmse:
        return {"effect": name, "channels": {}}
    at = min(range(len(gain["horizons_s"])), key=lambda i: abs(gain["horizons_s"][i] - gain["skill_horizon_s"]))
    channels = {}
    for channel in MEASURED:
        nominal, extended, floor = (rmse[model][channel][at] for model in ("nominal", "extended", "noise_floor"))
        if None in (nominal, extended, floor):
            continue
        grown = [None if v is None else v * extended / floor for v in without.get(channel, ())]
        channels[channel] = {"nominal": nominal / floor, "extended": extended / floor, "without": grown}
    return {"effect": name, "channels": channels, "horizon": gain["horizons_s"][at]}


def _joint_error_share(content: dict[str, Any]) -> str:
    """Return what several named effects explain together; empty for one, whose sentence says it, or without a share."""
    names, explained = [cause["effect"] for cause in content.get("causes", ())], content.get("explained") or {}
    if len(names) < 2 or explained.get("share") is None:
        return ""
    share, (low, high) = 100 * explained["share"], (100 * end for end in explained["ci95"])
    words = f"{share:.0f} % [{low:.0f}, {high:.0f}] of the error {explained['horizon']:.2g} s ahead that is not noise"
    return f"{', '.join(names[:-1])} and {names[-1]} together explain {words}."


def _parameter_rows(cause: dict[str, Any], key: str) -> list[list[str | Cell]]:
    """Return a row per parameter: value, interval, and whether it is at its bound."""
    rows: list[list[str | Cell]] = []
    for parameter, one in cause["parameters"].items():
        words = with_interval(one["value"], one["ci95"], ".4g")
        rows.append(
            [
                f"{parameter} [{one['unit']}]" if one["unit"] != "1" else parameter,
                Cell(words, f"{key}.parameters.{parameter}", one["value"]),
                "yes" if one.get("at_bound") else "no",
            ]
        )
    return rows


def _cause(place: int, cause: dict[str, Any], content: dict[str, Any]) -> str:
    """Return the section of a named effect: description, parameters, probability, and confusable effects."""
    name, key = cause["effect"], f"diagnosis.json: causes[{place}]"
    known = EFFECTS.get(name)
    parts = (
        [paragraph(f"{known.sentence[0].upper()}{known.sentence[1:]}."), paragraph(known.formula, "note")]
        if known
        else []
    )
    rows = _parameter_rows(cause, key)
    rows.append(["probability", Cell(f"{cause['probability']:.2f}", f"{key}.probability", cause["probability"]), ""])
    rows.append(["p-value", Cell(f"{cause['p_value']:.2g}", f"{key}.p_value", cause["p_value"]), ""])
    if "share" in cause:
        low, high = cause["share_ci95"]
        words = f"{100 * cause['share']:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"
        rows.append(["share of what is explained", Cell(words, f"{key}.share", cause["share"]), ""])
        rows.append(
            [
                f"probability of its family, {cause['family']}",
                Cell(f"{cause['family_probability']:.2f}", f"{key}.family_probability"),
                "",
            ]
        )
    for channel, grown in content["gain"].get("without", {}).get(name, {}).items():
        rows.append(
            [
                f"error of {channel} without it, over that with all causes",
                quantity(with_interval(grown[0], grown[1:]), f"diagnosis.json: gain.without.{name}.{channel}"),
                "",
            ]
        )
    rows += [
        [f"instead: {rival}", Cell(f"{p:.2f}", f"{key}.rivals.{rival}", p), ""]
        for rival, p in (cause.get("rivals") or {}).items()
    ]
    parts.append(table(("", "value, 95 % interval", "at its bound"), rows, f"{name}. Source: {key}."))
    if confusable := cause.get("confusable_with"):
        parts.append(paragraph(f"Looks alike in these data: {', '.join(confusable)}."))
    if cause_errors(cause, content["gain"])["channels"]:
        parts.append(stage_for(f"cause-{place}", f"Error of the predictions without {name}, over the noise floor"))
    return "\n".join([html_heading(name), *parts])


def _data_sections(data: xr.Dataset, shown: dict[str, Any] | None) -> Iterator[str]:
    """Yield the evidence against the nominal model: runs, residual forces, errors over the horizon, scores."""
    yield section(
        "Measured against predicted", [stage_for("player", "Player of measured runs and predictions")], "runs"
    )
    if data.sizes["driver"]:
        parts = [stage_for("forces", "Residual forces")]
        if shown:
            rows = residual_force_rows(shown)
            parts += [
                paragraph(shown["worst"]),
                table(
                    rows[0],
                    quantities(rows[1:], "diagnosis.json: show.residual_forces"),
                    "RMS of the residual forces. Source: diagnosis.json, show.residual_forces.",
                ),
            ]
        yield section("What the data say against the model", parts)
    parts = [stage_for("curves", "Error over the horizon")]
    if shown:
        rows = nominal_error_rows(shown)
        parts += [
            paragraph(parity_statement(shown["kinematic_parity"])),
            table(
                rows[0],
                quantities(rows[1:], "diagnosis.json: show.open_loop"),
                "Open-loop error of the nominal car on all runs, in units of the measurement "
                "noise. Source: diagnosis.json, show.open_loop.in_noises.",
            ),
        ]
    yield section("Error over the horizon", parts)
    yield _scores(data)


def _scores(data: xr.Dataset) -> str:
    """Return the section with the score of every effect, closed at first."""
    rows = [
        [
            name,
            Cell(f"{fall:.4g}", f"diagnosis.nc: promise, {name}", fall),
            Cell(f"{score:.2f}", f"diagnosis.nc: score, largest of {name}", score),
            "named" if named else "",
        ]
        for name, fall, score, named in best_scores(data)
    ]
    head = ("effect", "predicted fall of the cost", "largest |score|", "named")
    words = (
        f"What the nominal car's errors say of each effect by itself; by chance 5 % exceed a score of "
        f"{data.attrs['score_threshold']:.2f}. Source: diagnosis.nc, promise and score."
    )
    return section(
        "Scores of all effects", ["<details><summary>Show the table</summary>", table(head, rows, words), "</details>"]
    )


def _gain(gain: dict[str, Any]) -> list[str]:
    """Return the table of errors on held-out runs."""
    if not gain["held_out_runs"]:
        return [paragraph("Not measured, for want of runs to hold out.")]
    head, *rows = gain_rows(gain)
    cells = [
        [
            MODELS.get(row[0], row[0]),
            quantity(row[1], "diagnosis.json: gain.horizons_s"),
            *(
                quantity(text, f"diagnosis.json: gain.rmse.{row[0]}.{c}")
                for c, text in zip(MEASURED, row[2:5], strict=True)
            ),
            quantity(row[5], f"diagnosis.json: gain.ratio.{row[0]}"),
            quantity(row[6], f"diagnosis.json: gain.skill.{row[0]}"),
        ]
        for row in rows
    ]
    words = f"RMS error of open-loop predictions on the runs held out ({', '.join(gain['held_out_runs'])})."
    return [table(head, cells, f"{words} Source: diagnosis.json, gain.")]


def horizon_data(data: xr.Dataset) -> dict[str, Any]:
    """Return RMS errors of every model over the time ahead, with noise floor and measurement noise."""
    named = bool(data["named"].values.any())
    models = [str(name) for name in data["compared"].values if named or name != "extended"]
    return {
        "horizon": data["horizon"].values,
        "floor": data["floor"].values.T,
        "sigma": data["sigma"].values,
        "rmse": {name: data["rmse"].sel(compared=name).values.T for name in models},
        "predicted_on": data.attrs["predicted_on"],
    }


def force_data(data: xr.Dataset) -> dict[str, Any]:
    """Return the binned residual forces over every driver, with standard errors, per model."""
    return {
        str(driver): {
            model: {
                key: data[f"bin_{key}"].sel(driver=driver, model=model).values.T for key in ("value", "mean", "error")
            }
            | {"explained": data["explained"].sel(driver=driver, model=model).values}
            for model in drawn_models(data)
        }
        for driver in data["driver"].values
    }
