"""Damaged logs of loggers are read or refused in one sentence: never a traceback, a hang or a crash."""

import struct
import sys
from collections.abc import Callable
from pathlib import Path

import loggers
import numpy as np
import pytest
from damage import mutated

from driftjax.core import BadInput
from driftjax.logs import aim, guess_columns, isolated, read_log
from driftjax.logs.carmaker import info_path
from driftjax.logs.series import pick_channels

HEADERS = {"lap.ld": 0x3448 + 8 * 124, "lap.vbo": 600, "lap.erg": 16, "lap.xrk": 800}  # bytes before the samples
CASES = 100


def one_sentence(path: Path, columns: Path) -> str | None:
    """What a file is refused with, None if it is read."""
    try:
        read_log(path, str(columns))
    except BadInput as error:
        said = str(error)
        assert said.startswith(str(path)) and said.endswith(".") and "\n" not in said, said
        return said
    return None


def refused(folder: Path, name: str, cases: int, part: Callable[[Path], Path] = lambda path: path) -> int:
    """How many of so many mutations of a lap (of one `part` of it) are refused."""
    path, columns = loggers.logged(folder, name)
    victim = part(path)
    content, rng = victim.read_bytes(), np.random.default_rng(20261125)
    header = HEADERS[name] if victim == path else len(content)
    said = []
    for _ in range(cases):
        victim.write_bytes(mutated(content, header, rng))
        said.append(one_sentence(path, columns))
    return sum(one is not None for one in said)


@pytest.mark.parametrize("name", ["lap.ld", "lap.vbo", "lap.erg"])
def test_mutated_files_are_read_or_refused(tmp_path, name):
    assert CASES // 4 < refused(tmp_path, name, CASES) < CASES


def test_mutated_descriptions_of_results_are_read_or_refused(tmp_path):
    assert CASES // 4 < refused(tmp_path, "lap.erg", CASES, info_path) < CASES


@pytest.mark.slow
def test_mutated_aim_logs_are_read_or_refused(tmp_path):
    assert 0 < refused(tmp_path, "lap.xrk", CASES) < CASES


def test_an_aim_log_that_cannot_be_read(tmp_path, monkeypatch):
    path, columns = loggers.logged(tmp_path, "lap.xrk")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 3].replace(b"CHS", b"CHX"))
    assert "is no readable AiM file (" in (one_sentence(path, columns) or "")
    path.write_bytes(content)
    monkeypatch.setattr(aim, "SCRIPT", script := tmp_path / "script.py")
    script.write_text("while True: pass")
    monkeypatch.setattr(isolated, "TIMEOUT", 0.2)
    assert "takes over 0.2 s" in (one_sentence(path, columns) or "")
    script.write_text("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    monkeypatch.setattr(isolated, "TIMEOUT", 60)
    assert "(its library crashed, exit -11)" in (one_sentence(path, columns) or "")
    monkeypatch.setitem(sys.modules, "libxrk", None)
    assert "pip install 'driftjax[aim]'" in (one_sentence(path, columns) or "")


def changed(path: Path, old: bytes, new: bytes) -> Path:
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return path


BAD: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "a list that leads back": ("lap.ld", lambda path: changed(path, struct.pack("<II", 0x3448, 0x3448 + 2 * 124),
                               struct.pack("<II", 0x3448, 0x3448)), "list of channels leads to byte 13384"),
    "samples of no known kind": ("lap.ld", lambda path: changed(path, b"\xe1\x2e\x07\0\x04\0", b"\xe1\x2e\x06\0\x04\0"),
                                 r"'Ground Speed' has samples of kind \(6, 4\), 50 Hz"),
    "cut off": ("lap.ld", lambda path: path.write_bytes(path.read_bytes()[:-100]), "ends before the samples of"),
    "a name twice": ("lap.ld", lambda path: changed(path, b"G Force Lat\0", b"Slip Angle\0\0"),
                     "'Slip Angle' is there 2 times"),
    "no such channel": ("lap.ld", lambda path: changed(path, b"Slip Angle", b"Slap Angle"),
                        "has no channel 'Slip Angle'; it has 'Slap Angle'"),
    "a cell too few": ("lap.vbo", lambda path: changed(path, b" +0100.00", b""), "row 30: has 10 cells for 11"),
    "no number": ("lap.vbo", lambda path: changed(path, b" +0100.00 1", b" +0100.00 x"), "row 30: column 'yaw' holds"),
    "no time of day": ("lap.vbo", lambda path: changed(path, b"235958.05", b"236158.05"), "row 31: 'time' is 236158"),
    "no rows": ("lap.vbo", lambda path: path.write_text(loggers.VBO), r"no rows under \[data\]"),
    "degrees for minutes": ("lap.vbo", lambda path: changed(path, b" +2959.8", b" +9959.8"), "no angle in minutes"),
    "no description": ("lap.erg", lambda path: info_path(path).unlink(), "cannot be read without lap.erg.info"),
    "another description": ("lap.erg", lambda path: changed(info_path(path), b"= Float", b"= Double"),
                            "has records of 49 bytes where lap.erg.info describes 53"),
    "no type": ("lap.erg", lambda path: changed(info_path(path), b"= Float", b"= Text"), "'Car.v' has the type 'Text'"),
    "no factor": ("lap.erg", lambda path: changed(info_path(path), b"1e-4", b"small"), "has factor 'small'"),
    "no byte order": ("lap.erg", lambda path: changed(info_path(path), b"LittleEndian", b"?"), "'File.ByteOrder' is"),
    "no quantities": ("lap.erg", lambda path: info_path(path).write_text("#\n"), "describes no quantity"),
    "a filler": ("lap.erg", lambda path: changed(path.with_name("map.yaml"), b"Car.Fx", b"$none$"), "holds no number"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_named(tmp_path, case):
    name, damage, sentence = BAD[case]
    path, columns = loggers.logged(tmp_path, name)
    damage(path)
    with pytest.raises(BadInput, match=sentence):
        read_log(path, str(columns))


def test_channels_that_share_one_block_of_samples_are_refused(tmp_path):
    """A chain of a thousand descriptions would otherwise fill the memory with copies."""
    path = loggers.write_ld(tmp_path / "lap.ld")
    content = path.read_bytes()
    first, size = 0x3448, 124
    *_, at = (first + k * size for k in range(8))
    previous, _, *rest = struct.unpack_from("<IIII", content, at)
    copies = [struct.pack("<IIII", previous, len(content) + (k + 1) * size if k < 999 else 0, *rest)
              + content[at + 16 : at + size] for k in range(1000)]  # fmt: skip
    linked = content[: at + 4] + struct.pack("<I", len(content)) + content[at + 8 :]
    path.write_bytes(linked + b"".join(copies))
    with pytest.raises(BadInput, match=r"lap\.ld: ends before the samples of its channels do"):
        guess_columns(path)


def test_many_channels_are_picked_in_little_time():
    names = [f"c{k}" for k in range(60_000)]
    assert len(pick_channels(Path("log.erg"), names, [(name, name) for name in names])) == len(names)


def test_a_log_without_a_column_map(tmp_path):
    path, _ = loggers.logged(tmp_path, "lap.ld")
    with pytest.raises(BadInput, match="needs a column map that says what is what; it holds 'Drive Force',"):
        read_log(path)
