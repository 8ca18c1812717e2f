"""Catalogue of effects: `linear`, `tyre_curve`, and every module here that defines `EFFECT`, found by itself."""

import importlib
import pkgutil

from driftjax.core import BadInput
from driftjax.vehicle.effect.base import Effect as Effect
from driftjax.vehicle.effect.base import Parameter as Parameter
from driftjax.vehicle.effect.base import reference as reference
from driftjax.vehicle.effect.flow import Place as Place
from driftjax.vehicle.effect.linear import LINEAR
from driftjax.vehicle.effect.tyre_curve import TYRE_CURVES

_MODULES = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
_EFFECTS: list[Effect] = [*LINEAR, *TYRE_CURVES, *(module.EFFECT for module in _MODULES if hasattr(module, "EFFECT"))]
EFFECTS: dict[str, Effect] = {effect.name: effect for effect in sorted(_EFFECTS, key=lambda effect: effect.number)}


def default_catalogue(*names: str) -> tuple[Effect, ...]:
    """Return the effects that a diagnosis looks for: of those on request only the ones with these `names`.

    Raises `BadInput` for an unknown name.
    """
    requested = effects_by_name(names)
    return tuple(effect for effect in EFFECTS.values() if not effect.on_request or effect in requested)


def effects_by_name(names: tuple[str, ...]) -> tuple[Effect, ...]:
    """Return the effects of these names, in the catalogue's order; raises `BadInput` for an unknown name."""
    unknown = sorted(set(names) - set(EFFECTS))
    if unknown:
        raise BadInput(f"effect '{unknown[0]}': no such effect; the catalogue holds {', '.join(EFFECTS)}.")
    return tuple(effect for name, effect in EFFECTS.items() if name in names)
