"""Reference of the effects and of the stored variables as MyST Markdown, from the catalogue and the definitions."""

from options import cell
from tables import table

from driftjax.store import variables
from driftjax.vehicle import load_vehicle
from driftjax.vehicle.effect import EFFECTS, Effect
from driftjax.vehicle.effect.families import FAMILIES

STORED = {
    "Stages and `laps.nc`": variables.STAGE,
    "`plan.nc`": variables.PLAN,
    "`diagnosis.nc`": variables.DIAGNOSIS,
}


def effects_page() -> str:
    """Return the effects by family, each with its parameters and their range on the sedan."""
    car, parts = load_vehicle("sedan"), []
    for family, names in FAMILIES.items():
        parts.append(f"## {family.capitalize()}\n")
        for name in names:
            effect = EFFECTS[name]
            rows = []
            for one in effect.parameters:
                lower, upper = one.bounds(car)
                rows.append((f"`{one.name}`", "-" if one.unit == "1" else one.unit, f"{one.scale(car):.3g}",
                             f"{lower:.3g} to {upper:.3g}"))  # fmt: skip
            parts += [f"### {name}\n", f"{_sentence(effect)}\n",
                      table(("parameter", "unit", "typical size", "range"), rows)]  # fmt: skip
    return "\n".join(parts)


def variables_page() -> str:
    """Return every stored variable with its dimensions and units."""
    parts = []
    for heading, stored in STORED.items():
        rows = [(f"`{name}`", cell(one.long_name), "" if one.units == "1" else one.units, ", ".join(one.dims))
                for name, one in stored.items()]  # fmt: skip
        parts += [f"## {heading}\n", table(("variable", "meaning", "unit", "dimensions"), rows)]
    return "\n".join(parts)


def _sentence(effect: Effect) -> str:
    needs = f" Needs {' and '.join(f'`{one}`' for one in effect.needs)} in the log." if effect.needs else ""
    past = " Depends on the past, so steady states do not have it." if effect.transient else ""
    needs += " A diagnosis looks for it on request, `--beside`." if effect.on_request else ""
    sentence = effect.sentence[0].upper() + effect.sentence[1:]
    return f"{sentence}. Acts on: {effect.station}.{needs}{past}\n\n{effect.formula}"
