"""Reference of the Python interface as MyST Markdown: signatures and docstrings as they stand in the sources."""

import re
from functools import cache

import griffe

import driftjax

HEADINGS = {
    "environment": "Set up",
    "vehicle": "Cars and plants",
    "tyre": "Tyre property files",
    "track": "Tracks",
    "planner": "Minimum-time plans",
    "equilibrium": "Steady states",
    "sim": "Simulation",
    "control": "Drift MPC",
    "gp": "Gaussian processes",
    "learning": "Learning to drift",
    "tune": "Tuning",
    "sweep": "Sweeps",
    "logs": "Measured logs",
    "manoeuvres": "Simulated logs",
    "diagnosis": "Diagnosis",
    "report": "Files and figures",
    "export": "Export to other tools",
    "store": "Run folders",
    "core": "Records, outcomes and errors",
}


@cache
def package() -> griffe.Module:
    """Load the sources of the package, without importing it."""
    loaded = griffe.load("driftjax", resolve_aliases=True)
    assert isinstance(loaded, griffe.Module)
    return loaded


def definition(cls: type) -> griffe.Object:
    """Return the definition of a class or function in the sources."""
    definition = package()[f"{cls.__module__.removeprefix('driftjax.')}.{cls.__qualname__}"]
    return definition.final_target if isinstance(definition, griffe.Alias) else definition


def api_page() -> str:
    """Return every public name by topic; a public name without a topic is an error."""
    lines = ["```{py:currentmodule} driftjax\n```\n"]
    topics = {name: driftjax.PUBLIC.get(name, "driftjax.environment").split(".")[1] for name in driftjax.__all__}
    topics |= {name: "sweep" for name, folder in topics.items() if folder == "studies"}
    for topic, heading in HEADINGS.items():
        lines.append(f"## {heading}\n")
        lines += [_entry(name) for name in driftjax.__all__ if topics[name] == topic]
    missing = sorted(set(topics.values()) - set(HEADINGS))
    assert not missing, f"docs/_ext/api.py has no heading for {missing}"
    return "\n".join(lines)


def markdown(docstring: str) -> str:
    """Return a docstring as Markdown: examples that begin with >>> become blocks of code."""
    return re.sub(r"(?m)((?:^>>> .*\n?)+)", lambda match: f"```pycon\n{match[1].rstrip()}\n```\n", docstring)


def _entry(name: str) -> str:
    item = definition(getattr(driftjax, name))
    if item.is_function:
        return _block("function", f"{name}{_signature(item)}", _doc(item), 4)
    exception = any(str(base) == "Exception" or str(base).endswith("Error") for base in item.bases)
    kind = "exception" if exception else "class"
    return _block(kind, f"{name}{_constructor(item)}", "\n\n".join([_doc(item), *_members(item)]), 5)


def _block(kind: str, head: str, body: str, colons: int) -> str:
    fence = ":" * colons
    return f"{fence}{{py:{kind}}} {head}\n{body}\n{fence}\n"


def _doc(item: griffe.Object) -> str:
    return markdown(item.docstring.value) if item.docstring else ""


def _constructor(item: griffe.Object) -> str:
    options = item.name.endswith("Config") or len(item.parameters) > 9
    return "(...)" if options else _signature(item) if len(item.parameters) else ""


def _signature(item: griffe.Object) -> str:
    words, star = [], False
    for one in item.parameters:
        if one.name == "self":
            continue
        if one.kind is griffe.ParameterKind.keyword_only and not star:
            words.append("*")
            star = True
        default = "" if one.default is None else f" = {_short(str(one.default))}"
        words.append(f"{one.name}{f': {one.annotation}' if one.annotation else ''}{default}")
    returns = getattr(item, "returns", None)
    return f"({', '.join(words)}){f' -> {returns}' if returns else ''}"


def _short(default: str) -> str:
    return "..." if default.startswith(("lambda", "field(")) else default


def _members(item: griffe.Object) -> list[str]:
    if item.name.endswith("Config"):
        return ["Its fields are the keys of [the configuration](configuration.md)."]
    blocks = []
    for name, one in item.members.items():
        if name.startswith("_") or one.is_alias:
            continue
        if one.is_function and one.docstring:
            blocks.append(_block("method", f"{name}{_signature(one)}", _doc(one), 4))
        elif one.is_attribute and (one.docstring or item.name == "RESULTS"):
            value = f":value: {one.value}\n" if item.name == "RESULTS" else ""
            kind = f":type: {one.annotation}\n" if one.annotation else ""
            blocks.append(_block("attribute", f"{name}\n{kind}{value}", _doc(one), 4))
    return blocks
