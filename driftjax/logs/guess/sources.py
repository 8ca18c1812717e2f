"""Channels that belong together: position and heading of one source, and the two axes of an accelerometer."""

from collections.abc import Sequence

from driftjax.logs.guess.relations import RelationFit, Signal, Values, fast, fit_relation, kinematic_relations

ABOUT = 0.9  # of the best score is about as good
ACROSS, ALONG = 0.75, 0.4  # correlations from which an axis follows a relation, and up to which it does not
TURNED = 1.5  # correlation of the axis to the left with ax, over that with ay


def source_of(name: str) -> str:
    """Return topic, file or struct that a column comes from; empty if its name has none."""
    return name.partition(".")[0] if "." in name else ""


def heading_beside(position: str, scores: Sequence[tuple[str, float]], best: float) -> str | None:
    """Return the heading from the source of `position` among columns and scores, if it is about as good as the best."""
    source = source_of(position)
    there = [(score, name) for name, score in scores if source and source_of(name) == source and score >= ABOUT * best]
    return max(there)[1] if there else None


def turned_axes(ahead: Signal, left: Signal, v: Values, dt: float) -> tuple[RelationFit, RelationFit] | None:
    """Return how column `left` is ax and column `ahead` is ay; None if they are not, or their names are right.

    So it is where a sensor is mounted a quarter turn to the side. `ahead` and `left` are as named, in their own unit.
    """
    mask = fast(v, len(ahead.y))
    others = {role: one for role, one in v.items() if role not in ("ax", "ay")}

    def best(role: str, column: Signal) -> RelationFit | None:
        fits = [
            one
            for rule in kinematic_relations(role, others, dt)
            if (one := fit_relation(rule, column, mask)) is not None
        ]
        return max(fits, key=lambda one: abs(one.correlation), default=None)

    along, across, named = best("ax", left), best("ay", ahead), best("ay", left)
    if along is None or across is None or named is None:
        return None
    turned = abs(across.correlation) > ACROSS and abs(named.correlation) < ALONG
    return (along, across) if turned and abs(along.correlation) > TURNED * abs(named.correlation) else None
