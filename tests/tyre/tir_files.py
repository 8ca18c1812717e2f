"""A tyre property file whose coefficients are all different from 0, made up for these tests."""

from pathlib import Path

SECTIONS = {
    "VERTICAL": "FNOMIN 4000",
    "OPERATING_CONDITIONS": "INFLPRES 220000 NOMPRES 200000",
    "DIMENSION": "UNLOADED_RADIUS 0.32",
    "STRUCTURAL": "LONGITUDINAL_STIFFNESS 350000 LATERAL_STIFFNESS 150000 PCFX1 0.1 PCFX2 0.02 PCFX3 0.05 PCFY1 0.15 "
    "PCFY2 0.01 PCFY3 0.04",
    "SCALING_COEFFICIENTS": "LFZO 0.95 LCX 1.02 LMUX 0.9 LEX 1.1 LKX 1.05 LHX 0.8 LVX 1.2 LCY 0.98 LMUY 0.92 LEY 1.15 "
    "LKY 0.97 LHY 1.3 LVY 0.7 LKYC 1.1 LKZC 0.9 LTR 1.04 LRES 1.1 LXAL 1.06 LYKA 0.94 LVYKA 1.2 LS 1.1",
    "LONGITUDINAL_COEFFICIENTS": "PCX1 1.65 PDX1 1.15 PDX2 -0.08 PDX3 2.1 PEX1 0.3 PEX2 0.1 PEX3 0.05 PEX4 0.02 "
    "PKX1 21.5 PKX2 0.8 PKX3 0.2 PHX1 0.0012 PHX2 0.0006 PVX1 0.004 PVX2 0.002 PPX1 -0.3 PPX2 0.2 PPX3 -0.1 PPX4 0.05 "
    "RBX1 12.5 RBX2 -11.2 RBX3 0.6 RCX1 1.08 REX1 0.4 REX2 -0.1 RHX1 0.005",
    "LATERAL_COEFFICIENTS": "PCY1 1.35 PDY1 1.02 PDY2 -0.12 PDY3 1.5 PEY1 -0.4 PEY2 -0.2 PEY3 0.1 PEY4 -1.5 PEY5 0.8 "
    "PKY1 -20.5 PKY2 1.9 PKY3 0.6 PKY4 1.95 PKY5 0.3 PKY6 -0.9 PKY7 -0.2 PHY1 0.0027 PHY2 0.0011 PVY1 0.03 PVY2 -0.012 "
    "PVY3 -0.25 PVY4 -0.3 PPY1 -0.4 PPY2 -0.6 PPY3 -0.08 PPY4 0.03 PPY5 -0.5 RBY1 10.1 RBY2 8.3 RBY3 0.02 RBY4 0.5 "
    "RCY1 1.05 REY1 0.3 REY2 0.12 RHY1 0.008 RHY2 0.004 RVY1 0.04 RVY2 0.02 RVY3 -0.3 RVY4 15 RVY5 1.8 RVY6 11",
    "ALIGNING_COEFFICIENTS": "QBZ1 9.5 QBZ2 -1.2 QBZ3 -0.4 QBZ4 0.1 QBZ5 0.3 QBZ9 8 QBZ10 0.1 QCZ1 1.15 QDZ1 0.1 "
    "QDZ2 -0.01 QDZ3 -0.1 QDZ4 0.5 QDZ6 -0.005 QDZ7 0.003 QDZ8 -0.15 QDZ9 0.02 QDZ10 0.05 QDZ11 0.01 QEZ1 -1.4 "
    "QEZ2 0.3 QEZ3 0.05 QEZ4 0.2 QEZ5 -1.1 QHZ1 0.004 QHZ2 0.002 QHZ3 0.1 QHZ4 0.05 PPZ1 0.2 PPZ2 0.1 SSZ1 0.02 "
    "SSZ2 -0.01 SSZ3 0.3 SSZ4 0.1",
}  # fmt: skip


def tir_text(fittyp: int = 61, **changes: float | str) -> str:
    """The file's text; a change replaces a number or adds one, None leaves the line's value blank."""
    lines = ["[UNITS]", "LENGTH = 'meter'", "FORCE = 'newton'", "ANGLE = 'radians'", "MASS = 'kg'", "TIME = 'second'"]
    lines += [
        "! a comment = with a sign",
        "[MODEL]",
        f"FITTYP                   = {fittyp} $version",
        "TYRESIDE = 'LEFT'",
    ]
    for section, text in SECTIONS.items():
        words = text.split()
        lines += [f"${'-' * 40}", f"[{section}]"]
        lines += [
            f"{key:<24} = {changes.pop(key, value)}  $ {key.lower()}"
            for key, value in zip(words[::2], words[1::2], strict=True)
        ]
        lines.append("MASS                     = ")
    lines += ["[SHAPE]", "{radial width}", " 1.0 0.0", " 0.9 1.0"]
    lines += [f"{key} = {value}" for key, value in changes.items()]
    return "\n".join(lines) + "\n"


def tir_file(folder: Path, fittyp: int = 61, **changes: float | str) -> Path:
    """Write the file."""
    path = folder / "test.tir"
    path.write_text(tir_text(fittyp, **changes))
    return path
